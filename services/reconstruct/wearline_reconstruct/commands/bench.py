"""``wearline bench``: the thesis' tables on simulated parts, ours beside its own method and its printed figures."""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline.artifact import Calibration
from wearline.cli import main, progress
from wearline.errors import UsageError
from wearline.recipe import Limits, Recipe, dump_recipe
from wearline.scene import (
    DEFAULT_HEAD,
    Flake,
    Head,
    Light,
    Plane,
    StampedPart,
    Surface,
    Truth,
    mm_per_pixel,
    render,
    trace,
)
from wearline.surface import dense_map
from wearline_reconstruct.commands.bench_peers import PeerResult, compare_peers
from wearline_reconstruct.config import ReconstructSettings
from wearline_reconstruct.core.calibration import Shot, calibrate
from wearline_reconstruct.core.chain import ChainSettings, Prepared, prepare, reconstruct
from wearline_reconstruct.core.stripes import Scale
from wearline_reconstruct.core.thesis import ThesisSettings, spatial_kalman

_PLATES_MM = (0.0, 2.0, 4.0, 6.0, 8.0)
_SHOTS = 3
_DARK = Light()
_BRIGHT = Light(ambient_dn=60.0)
_HEAD = Head(rows=720, cols=840, lines=15)
"""The thesis' region of table 5.4."""

TABLE_5_3: dict[float, float] = {0.0: -0.0184, 2.0: 0.0964, 3.0: -0.0400, 4.0: 0.1383}
"""Plate height: mean error of five measurements. [mm]"""
TABLE_5_4: dict[str, tuple[float, ...]] = {
    "paper, dark": (0.3842, 0.3144, 0.4285, 0.5674, 0.5599),
    "paper, bright": (0.3405, 0.4702, 0.5247, 0.3170, 0.3538),
    "no paper, dark": (0.2182, 0.1594, 0.1757, 0.2367, 0.1735),
    "no paper, bright": (0.1321, 0.1685, 0.2290, 0.2256, 0.2183),
}
"""Mean error of single measurements. [mm]"""
TABLE_5_5: dict[tuple[int, int], dict[int, float]] = {
    (400, 300): {1: 86, 3: 136, 5: 192, 15: 719},
    (500, 400): {1: 227, 3: 306, 5: 364, 15: 1368},
    (800, 600): {1: 358, 3: 592, 5: 733, 15: 1731},
    (720, 840): {1: 452, 3: 764, 5: 1045, 15: 2620},
    (800, 900): {1: 577, 3: 936, 5: 1326, 15: 3354},
}
"""Region (width, height): time by iterations. [ms]"""
FIGURE_5_13: dict[str, tuple[float, ...]] = {
    "dull board": (0.2226, 0.2195, 0.5696, 0.4983, 0.3424, 0.4060, 0.6522, 0.7130, 0.2231, 0.0),
    "polished steel": (0.2552, 0.0, 0.3667, 0.3638, 0.3606, 0.3506, 0.3455, 0.3767, 0.3075, 0.2220),
}
"""Mean error of ten measurements, the first two and the last two of the unchanged object. [mm]"""
_CHANGED = (2, 8)
_FLAKE_MM = 0.2


@dataclass
class Report:
    """All that was measured, in the order of the thesis."""

    planes: list[dict[str, Any]] = field(default_factory=list)
    verdicts: list[dict[str, Any]] = field(default_factory=list)
    speed: list[dict[str, Any]] = field(default_factory=list)
    stages: dict[str, float] = field(default_factory=dict)
    variance: dict[str, list[float]] = field(default_factory=dict)
    series: list[dict[str, Any]] = field(default_factory=list)
    peers: list[PeerResult] = field(default_factory=list)
    pictures: dict[str, NDArray[Any]] = field(default_factory=dict)
    """For the picture alone: a frame, its points, its map."""


def run_bench(frames: int, seed: int, as_json: bool, picture: Path | None) -> int:
    """Render, measure, print, draw."""
    cv2.setNumThreads(1)
    report = Report()
    calibration = _calibrated(_HEAD, seed)
    _planes(report, calibration, frames, seed + 1000)
    if _has_judge():
        with tempfile.TemporaryDirectory(prefix="wearline-bench-") as folder:
            judges = [_Judge(Path(folder), method, calibration, seed + 2000) for method in ("wearline", "thesis")]
            _table_5_4(report, judges, frames, seed + 3000)
            _figure_5_13(report, judges, seed + 4000)
    _iterations(report, calibration, seed + 5000)
    _speed(report, seed + 6000)
    if picture is not None:
        from wearline_reconstruct.commands.bench_picture import draw_report

        if not cv2.imwrite(str(picture), draw_report(report)):
            raise UsageError("cannot be written", f"--picture {picture}", "name a .png file in an existing folder")
    if as_json:
        entries = asdict(report)
        entries.pop("pictures")
        print(json.dumps(entries))
    else:
        _print(report)
    return 0


def _calibrated(head: Head, seed: int) -> Calibration:
    settings = ReconstructSettings()
    shots = [
        Shot(z, render(head, Plane(z), _DARK, seed + 10 * k + s)[0], f"plate {z:g} mm")
        for k, z in progress(list(enumerate(_PLATES_MM)), "plates")
        for s in range(_SHOTS)
    ]
    return calibrate(
        shots, lines=head.lines, is_vertical=head.vertical, mm_per_pixel=mm_per_pixel(head),
        settings=settings.calibration, stripes=settings.stripes, line_settings=settings.lines,
    )  # fmt: skip


def _planes(report: Report, calibration: Calibration, frames: int, seed: int) -> None:
    """Table 5.3, and the same for a stamped part."""
    scenes: list[tuple[str, float | None, Surface, Light]] = [
        *((f"plane {z:g} mm", z, Plane(z), _DARK) for z in TABLE_5_3),
        *((f"plane {z:g} mm, bright", None, Plane(z), _BRIGHT) for z in (3.0,)),
        ("stamped part", None, StampedPart(), _DARK),
        ("stamped part, bright", None, StampedPart(), _BRIGHT),
    ]
    chains = {method: prepare(calibration, Recipe(method=method), None) for method in ("wearline", "thesis")}
    for k, (name, printed, surface, light) in progress(list(enumerate(scenes)), "table 5.3"):
        still = trace(_HEAD, surface).row_px
        rendered = [render(_HEAD, surface, light, seed + 100 * k + n) for n in range(frames)]
        for method, chain in chains.items():
            report.planes.append(
                {"scene": name, "method": method, **_precision(rendered, still, chain),
                 "thesis_bias_um": None if printed is None else 1e3 * TABLE_5_3[printed]}
            )  # fmt: skip


def _precision(
    rendered: Sequence[tuple[NDArray[np.uint8], Truth]], still: NDArray[np.float64], chain: Prepared
) -> dict[str, Any]:
    errors, scores, shifts, vibrations = [], [], [], []
    mm_per_px = float(chain.calibration.meta["mm_per_line_px"])
    visible = found_points = wrong = 0
    for pixels, truth in rendered:
        found = reconstruct(pixels, chain)
        error, sigma, bad = _compared(found.points, truth)
        errors.append(error - float(np.mean(error)))
        shifts.append(float(np.mean(error)))
        vibrations.append(mm_per_px * float(np.nanmean(truth.row_px - still)))
        scores.append(error / sigma)
        visible += int(np.isfinite(truth.z_mm).sum())
        found_points += len(error)
        wrong += bad
    return {
        "bias_um": 1e3 * float(np.mean(np.array(shifts) - np.array(vibrations))),
        "vibration_um": 1e3 * float(np.sqrt(np.mean(np.square(vibrations)))),
        "point_um": 1e3 * float(np.std(np.concatenate(errors))),
        "score_std": float(np.std(np.concatenate(scores))),
        "seen": found_points / max(visible, 1),
        "wrong": wrong,
    }


def _compared(points: NDArray[Any], truth: Truth) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Error and sigma of the points with the right number, and how many have a wrong one."""
    line = points[:, 0].astype(int)
    place = np.rint(points[:, 2]).astype(int)
    off = np.abs(points[:, 1] - truth.row_px[line, place])
    right = off < 6.0
    return (points[:, 3] - truth.z_mm[line, place])[right], points[right, 4].astype(float), int((~right).sum())


def _has_judge() -> bool:
    return bool(entry_points(group="wearline.commands", name="judge"))


class _Judge:
    """The commands ``template`` and ``judge`` for one method of measuring, on files as a user runs them."""

    def __init__(self, folder: Path, method: str, calibration: Calibration, seed: int) -> None:
        self.method = method
        self._folder = folder / method
        self._folder.mkdir()
        # The thesis decides on the mean error alone (0.3 mm).
        limits = Limits(mean_error_mm=0.3) if method == "thesis" else Limits()
        recipe = Recipe(method="thesis" if method == "thesis" else "wearline", limits=limits)
        (self._folder / "R.yaml").write_text(dump_recipe(recipe))
        calibration.save(self._folder / "C.npz")
        # The thesis has one standard object, and its frames scatter too much to be averaged without complaint.
        count = 1 if method == "thesis" else 3
        golden = [self._written(f"golden{k}", render(_HEAD, StampedPart(), _DARK, seed + k)[0]) for k in range(count)]
        self._said("template", *golden, "--out", str(self._folder / "T.npz"))

    def judged(self, pictures: Sequence[NDArray[np.uint8]]) -> list[dict[str, Any]]:
        """What ``judge --json`` says of each."""
        files = [self._written(f"part{k}", pixels) for k, pixels in enumerate(pictures)]
        text = self._said("judge", *files, "--template", str(self._folder / "T.npz"), "--json")
        return [json.loads(line) for line in text.splitlines()]

    def _written(self, stem: str, pixels: NDArray[np.uint8]) -> str:
        path = self._folder / f"{stem}.bmp"
        cv2.imwrite(str(path), pixels)
        return str(path)

    def _said(self, *arguments: str) -> str:
        with contextlib.redirect_stdout(io.StringIO()) as said:
            references = ["--calibration", str(self._folder / "C.npz"), "--recipe", str(self._folder / "R.yaml")]
            code = main([*arguments, *references])
        if code != 0:
            raise UsageError(f"ended with {code}", f"wearline {arguments[0]}", "run its own tests")
        return said.getvalue()


def _table_5_4(report: Report, judges: Sequence[_Judge], frames: int, seed: int) -> None:
    """With a flake at a random place, and without, in the dark and in bright light."""
    rng = np.random.default_rng(seed)
    for k, (name, printed) in progress(list(enumerate(TABLE_5_4.items())), "table 5.4"):
        light = _BRIGHT if "bright" in name else _DARK
        pictures = []
        for n in range(frames):
            part: Surface = StampedPart()
            if not name.startswith("no"):
                x, y = rng.uniform(-18.0, 18.0), rng.uniform(-12.0, 12.0)
                part = Flake(part, float(x), float(y), 12.0, _FLAKE_MM)
            pictures.append(render(_HEAD, part, light, seed + 100 * k + n)[0])
        for judge in judges:
            said = judge.judged(pictures)
            report.verdicts.append(
                {
                    "conditions": name, "method": judge.method,
                    "mean_error_mm": [one["mean_error_mm"] for one in said],
                    "decisions": [one["decision"] for one in said],
                    "ms": float(np.median([one["timings_ms"]["total"] for one in said])),
                    "printed_mm": printed[:frames] if frames < len(printed) else printed,
                }
            )  # fmt: skip


def _figure_5_13(report: Report, judges: Sequence[_Judge], seed: int) -> None:
    """Two good, six changed, two good."""
    for k, (name, printed) in progress(list(enumerate(FIGURE_5_13.items())), "figure 5.13"):
        pictures = []
        for n in range(10):
            is_changed = _CHANGED[0] <= n < _CHANGED[1]
            part: Surface = Flake(StampedPart(), 4.0, 3.0, 12.0, _FLAKE_MM) if is_changed else StampedPart()
            pixels, _ = render(_HEAD, part, _DARK, seed + 100 * k + n)
            pictures.append(_polished(pixels, seed + 100 * k + n) if "polished" in name else pixels)
        for judge in judges:
            said = judge.judged(pictures)
            report.series.append(
                {"object": name, "method": judge.method, "printed_mm": printed,
                 "mean_error_mm": [one["mean_error_mm"] for one in said],
                 "decisions": [one["decision"] for one in said]}
            )  # fmt: skip


def _polished(pixels: NDArray[np.uint8], seed: int) -> NDArray[np.uint8]:
    """A mirror-like sheet: glare, a stray copy of the pattern, and light and dark patches."""
    rng = np.random.default_rng(seed)
    rows, cols = pixels.shape
    image = pixels.astype(np.float32)
    ghost = np.roll(cv2.flip(image, 1), (int(rng.integers(8, 14)), 31), (0, 1))
    patches = cv2.resize(rng.uniform(0.6, 1.6, (9, 11)).astype(np.float32), (cols, rows), interpolation=cv2.INTER_CUBIC)
    y, x = np.mgrid[0:rows, 0:cols].astype(np.float32)
    glare = 150.0 * np.exp(-0.5 * (((x - 0.7 * cols) / 45.0) ** 2 + ((y - 0.3 * rows) / 30.0) ** 2))
    return np.asarray(np.clip(np.rint(image * patches + 0.12 * ghost + glare), 0, 255), np.uint8)


def _iterations(report: Report, calibration: Calibration, seed: int) -> None:
    """Figure 5.12: what the filter says of itself, and what the truth says of it."""
    none = ChainSettings(thesis=ThesisSettings(iterations=0))
    ours = prepare(calibration, Recipe(), None)
    theirs = prepare(calibration, Recipe(method="thesis"), None, none)
    for name, surface in (("plane", Plane(3.0)), ("stamped part", StampedPart())):
        pixels, truth = render(_HEAD, surface, _DARK, seed)
        found = reconstruct(pixels, theirs)
        grid = np.full(truth.z_mm.shape, np.nan)
        line, place = found.points[:, 0].astype(int), found.points[:, 2].astype(int)
        grid[line, place] = found.points[:, 3]
        noise = float(np.median(found.points[:, 4]))
        measured = []
        for count in range(16):
            error = spatial_kalman(grid, noise, count).z_mm - truth.z_mm
            measured.append(1e6 * float(np.nanvar(error)))
        report.variance[f"{name}: thesis' method, by the truth"] = measured
        report.variance["thesis' filter, by itself"] = [
            1e6 * v for v in (noise**2, *spatial_kalman(grid, noise, 15).variance_mm2)
        ]
        mine = reconstruct(pixels, ours)
        error, _, _ = _compared(mine.points, truth)
        report.variance[f"{name}: wearline, by the truth"] = [1e6 * float(np.var(error))] * 16
        report.pictures = {
            "frame": pixels, "points": mine.points,
            "map": dense_map(mine.points, pixels.shape[:2]).z_mm,
        }  # fmt: skip


def _window(calibration: Calibration, width: int, height: int) -> Calibration:
    """The middle of a sensor as a sensor of its own."""
    rows, cols = (int(v) for v in calibration.image_shape)
    top, left = (rows - height) // 2, (cols - width) // 2
    along = slice(left, left + width)
    return replace(
        calibration, a_mm_per_px=calibration.a_mm_per_px[:, along], z_sigma_mm=calibration.z_sigma_mm[:, along],
        across0_px=calibration.across0_px[:, along] - top, spot_px=calibration.spot_px - (top, left),
        image_shape=np.array([height, width]),
    )  # fmt: skip


def _speed(report: Report, seed: int) -> None:
    """Table 5.5, the stages of a whole frame, and the peers on it."""
    head = DEFAULT_HEAD
    calibration = _calibrated(replace(head, speckle_contrast=0.1), seed)
    pixels, truth = render(head, StampedPart(), _DARK, seed + 900)
    for (width, height), printed in progress(list(TABLE_5_5.items()), "table 5.5"):
        top, left = (head.rows - height) // 2, (head.cols - width) // 2
        part = np.ascontiguousarray(pixels[top : top + height, left : left + width])
        window = _window(calibration, width, height)
        times: dict[str, float] = {"wearline": _ms(part, prepare(window, Recipe(), None), repeats=5)}
        for count in printed:
            settings = ChainSettings(thesis=ThesisSettings(iterations=count))
            chain = prepare(window, Recipe(method="thesis"), None, settings)
            times[f"thesis {count}"] = _ms(part, chain, repeats=2)
        report.speed.append({"width": width, "height": height, "ms": times, "printed_ms": printed})
    report.stages = _stages(pixels, head, prepare(calibration, Recipe(), None), calibration)
    scale = Scale(calibration.stripe_width_px, float(calibration.meta["pitch_px"]))
    report.peers = compare_peers(pixels, truth, scale)


def _ms(pixels: NDArray[np.uint8], chain: Prepared, repeats: int) -> float:
    """Raw buffer to line points and dense map, median."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        found = reconstruct(pixels, chain)
        dense_map(found.points, (pixels.shape[0], pixels.shape[1]))
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times))


def _stages(pixels: NDArray[np.uint8], head: Head, chain: Prepared, calibration: Calibration) -> dict[str, float]:
    """Median times of a curved part. [ms]"""
    laps: dict[str, list[float]] = {}
    for _ in range(25):
        start = time.perf_counter()
        pixels.copy()
        copied = time.perf_counter()
        cv2.blur(pixels, (5, 5))
        blurred = time.perf_counter()
        found = reconstruct(pixels, chain, time.perf_counter)
        reconstructed = time.perf_counter()
        dense_map(found.points, (head.rows, head.cols), is_vertical=calibration.is_vertical)
        mapped = time.perf_counter()
        times = {
            "memcpy of the frame": copied - start, "cv2.blur 5 x 5": blurred - copied,
            **{name: 1e-3 * value for name, value in found.timings_ms.items() if name != "total"},
            "dense map": mapped - reconstructed, "frame to points and map": mapped - blurred,
        }  # fmt: skip
        for name, value in times.items():
            laps.setdefault(name, []).append(1e3 * value)
    return {name: float(np.median(values)) for name, values in laps.items()}


def _print(report: Report) -> None:
    print("Simulated head: speckle contrast 0.35, vibration 0.05 px, streaky sheet (8 %), 720 x 840.\n")
    print("Table 5.3. bias: mean error without the vibration that was rendered; point: spread about the frame's mean.")
    print(
        f"{'scene':22} {'method':9} {'bias um':>8} {'vibr. um':>9} {'point um':>9} {'z-score':>8}"
        f" {'seen':>7} {'wrong':>6} {'thesis printed':>15}"
    )
    for row in report.planes:
        printed = row["thesis_bias_um"]
        print(
            f"{row['scene']:22} {row['method']:9} {row['bias_um']:8.1f} {row['vibration_um']:9.1f}"
            f" {row['point_um']:9.1f} {row['score_std']:8.2f} {row['seen']:7.3f} {row['wrong']:6d}"
            + ("" if printed is None else f" {printed:+15.1f}")
        )
    if report.verdicts:
        print(f"\nTable 5.4. Flake of {_FLAKE_MM:g} mm; mean error [mm] and decision of each part (P, F, ? unsure, -)")
        for row in report.verdicts:
            print(f"{row['conditions']:17} {row['method']:9} {_errors(row)}   {row['ms']:6.0f} ms")
            if row["method"] == "thesis":
                values = " ".join(f"{v:6.3f} " for v in row["printed_mm"])
                print(f"{'':17} {'printed':9} {values}   {'~750':>6} ms")
    else:
        print("\nTable 5.4 and figure 5.13 need wearline-judge, which is not installed here.")
    print("\nTable 5.5. Raw buffer to points and map [ms], one thread; printed figures in brackets")
    print(f"{'region':>9} {'wearline':>9}" + "".join(f"{f'thesis, {n} it.':>20}" for n in (1, 3, 5, 15)))
    for row in report.speed:
        times = "".join(f"{row['ms'][f'thesis {n}']:11.0f} {f'({v:g})':>8}" for n, v in row["printed_ms"].items())
        print(f"{row['width']:4d}x{row['height']:<4d} {row['ms']['wearline']:9.1f}{times}")
    print("\nWhole sensor, 1624 x 1224, median of 25")
    blur = report.stages["cv2.blur 5 x 5"]
    for name, value in report.stages.items():
        print(f"  {name:24} {value:8.2f} ms {value / blur:8.1f} x blur")
    print("\nFigure 5.12. Variance of the error [um^2] after 0, 1, 3, 5, 10, 15 iterations")
    for name, course in report.variance.items():
        print(f"  {name:42}" + "".join(f"{course[n]:9.0f}" for n in (0, 1, 3, 5, 10, 15)))
    if report.series:
        print("\nFigure 5.13. Two good, six changed, two good: mean error [mm] and decision")
        for row in report.series:
            print(f"{row['object']:15} {row['method']:9} {_errors(row)}")
            if row["method"] == "thesis":
                print(f"{'':15} {'printed':9} " + " ".join(f"{v:6.3f} " for v in row["printed_mm"]))
    print("\nStripe extraction on one frame")
    print(f"  {'':24} {'ms':>7} {'recall':>7} {'rms px':>7} {'junk':>6}")
    for peer in report.peers:
        print(f"  {peer.name:24} {peer.ms:7.1f} {peer.recall:7.3f} {peer.rms_px:7.3f} {peer.junk:6d}")


_LETTERS = {"PASSED": "P", "FAILED": "F", "UNSURE": "?", "NOT_MEASURED": "-"}


def _errors(row: dict[str, Any]) -> str:
    return " ".join(
        f"{'  none' if value is None else f'{value:6.3f}'}{_LETTERS[decision]}"
        for value, decision in zip(row["mean_error_mm"], row["decisions"], strict=True)
    )
