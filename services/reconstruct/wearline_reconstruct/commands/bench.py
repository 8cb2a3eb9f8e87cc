"""``wearline bench``: speed of each stage and precision on simulated parts, beside the thesis' printed figures."""

from __future__ import annotations

import json
import time
from typing import Any

import cv2
import numpy as np

from wearline.artifact import Calibration
from wearline.cli import progress
from wearline.recipe import Recipe
from wearline.scene import DEFAULT_HEAD, Head, Light, Plane, StampedPart, Surface, Truth, render, trace
from wearline.surface import dense_map
from wearline_reconstruct.config import ReconstructSettings
from wearline_reconstruct.core.calibration import Shot, calibrate
from wearline_reconstruct.core.chain import Prepared, prepare, reconstruct

_PLATES_MM = (0.0, 2.0, 4.0, 6.0, 8.0)
_SHOTS = 5
_BRIGHT = Light(ambient_dn=60.0)

THESIS_MM: dict[str, float] = {
    "plane 0 mm": -0.0184,
    "plane 2 mm": 0.0964,
    "plane 3 mm": -0.0400,
    "plane 4 mm": 0.1383,
}
"""Mean error of five measurements of each plate (table 5.3). [mm]"""
THESIS_MS = {1: 452.0, 3: 764.0, 5: 1045.0}
"""Whole chain of the thesis at 720 x 840, by its iterations (table 5.5). [ms]"""


def run_bench(frames: int, seed: int, as_json: bool) -> int:
    """Render, measure, print."""
    cv2.setNumThreads(1)
    head = DEFAULT_HEAD
    settings = ReconstructSettings()
    shots = [
        Shot(z, render(head, Plane(z), Light(), seed + 10 * k + s)[0], f"plate {z:g} mm")
        for k, z in progress(list(enumerate(_PLATES_MM)), "plates")
        for s in range(_SHOTS)
    ]
    calibration = calibrate(
        shots, lines=head.lines, is_vertical=head.vertical, mm_per_pixel=None, settings=settings.calibration,
        stripes=settings.stripes, line_settings=settings.lines,
    )  # fmt: skip
    scenes: list[tuple[str, Surface, Light]] = [
        *((f"plane {z:g} mm", Plane(z), Light()) for z in (0.0, 2.0, 3.0, 4.0)),
        ("plane 3 mm, bright", Plane(3.0), _BRIGHT),
        ("stamped part", StampedPart(), Light()),
        ("stamped part, bright", StampedPart(), _BRIGHT),
    ]
    rows = []
    for method in ("wearline", "thesis"):
        prepared = prepare(calibration, Recipe(method=method), None)
        rows += [
            _precision(name, method, surface, light, head, prepared, frames, seed + 1000 + 50 * k)
            for k, (name, surface, light) in progress(list(enumerate(scenes)), f"precision, {method}")
        ]
    speed = _speed(head, prepare(calibration, Recipe(), None), calibration, seed)
    if as_json:
        print(json.dumps({"precision": rows, "speed_ms": speed}))
    else:
        _print(rows, speed)
    return 0


def _precision(
    name: str, method: str, surface: Surface, light: Light, head: Head, prepared: Prepared, frames: int, seed: int
) -> dict[str, Any]:
    errors, scores, shifts, vibrations = [], [], [], []
    still = trace(head, surface).row_px
    mm_per_px = float(prepared.calibration.meta["mm_per_line_px"])
    visible = found_points = wrong = 0
    for k in range(frames):
        pixels, truth = render(head, surface, light, seed + k)
        found = reconstruct(pixels, prepared)
        error, sigma, bad = _compared(found.points, truth)
        errors.append(error - float(np.mean(error)))
        shifts.append(float(np.mean(error)))
        vibrations.append(mm_per_px * float(np.nanmean(truth.row_px - still)))
        scores.append(error / sigma)
        visible += int(np.isfinite(truth.z_mm).sum())
        found_points += len(error)
        wrong += bad
    return {
        "scene": name,
        "method": method,
        "bias_um": 1e3 * float(np.mean(np.array(shifts) - np.array(vibrations))),
        "vibration_um": 1e3 * float(np.sqrt(np.mean(np.square(vibrations)))),
        "point_um": 1e3 * float(np.std(np.concatenate(errors))),
        "score_std": float(np.std(np.concatenate(scores))),
        "seen": found_points / max(visible, 1),
        "wrong": wrong,
    }


def _compared(points: np.ndarray, truth: Truth) -> tuple[np.ndarray, np.ndarray, int]:
    """Error and sigma of the points with the right number, and how many have a wrong one."""
    line = points[:, 0].astype(int)
    place = np.rint(points[:, 2]).astype(int)
    off = np.abs(points[:, 1] - truth.row_px[line, place])
    right = off < 6.0
    return (points[:, 3] - truth.z_mm[line, place])[right], points[right, 4], int((~right).sum())


def _speed(head: Head, prepared: Prepared, calibration: Calibration, seed: int) -> dict[str, float]:
    """Median times of a curved part. [ms]"""
    pixels, _ = render(head, StampedPart(), Light(), seed + 900)
    laps: dict[str, list[float]] = {}
    for _ in range(15):
        start = time.perf_counter()
        pixels.copy()
        copied = time.perf_counter()
        cv2.blur(pixels, (5, 5))
        blurred = time.perf_counter()
        found = reconstruct(pixels, prepared, time.perf_counter)
        reconstructed = time.perf_counter()
        dense_map(found.points, (head.rows, head.cols), is_vertical=calibration.is_vertical)
        mapped = time.perf_counter()
        times = {
            "memcpy of the frame": copied - start, "cv2.blur 5 x 5": blurred - copied,
            **{name: 1e-3 * value for name, value in found.timings_ms.items() if name != "total"},
            "frame to line points": reconstructed - blurred, "dense map": mapped - reconstructed,
        }  # fmt: skip
        for name, value in times.items():
            laps.setdefault(name, []).append(1e3 * value)
    return {name: float(np.median(values)) for name, values in laps.items()}


def _print(rows: list[dict[str, Any]], speed: dict[str, float]) -> None:
    print("Precision on the simulated head (speckle contrast 0.35, vibration 0.05 px, streaky sheet);")
    print("bias: mean error without the vibration that was rendered; point: spread about the mean of the frame.\n")
    print(
        f"{'scene':22} {'method':9} {'bias um':>8} {'vibr. um':>9} {'point um':>9} {'z-score':>8}"
        f" {'seen':>7} {'wrong':>6} {'thesis bias':>12}"
    )
    for row in rows:
        thesis = THESIS_MM.get(row["scene"])
        beside = f"{1e3 * thesis:+12.1f}" if thesis is not None else " " * 12
        print(
            f"{row['scene']:22} {row['method']:9} {row['bias_um']:8.1f} {row['vibration_um']:9.1f}"
            f" {row['point_um']:9.1f}"
            f" {row['score_std']:8.2f} {row['seen']:7.3f} {row['wrong']:6d} {beside}"
        )
    print("\nSpeed, one thread, median of 15\n")
    for name, value in speed.items():
        print(f"{name:22} {value:8.2f} ms")
    for turns, value in THESIS_MS.items():
        print(f"{f'thesis, {turns} iterations':22} {value:8.0f} ms (720 x 840)")
