"""Time and error of the comparison beside py4dgeo's M3C2, on the same points, in the same run.

``python -m tests.metrology.judge_peer``; py4dgeo is no dependency: without it only our own figures are printed.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.metrology.parts import Bench, bench
from wearline.messages import LinePoints
from wearline.scene import Flake, StampedPart, mm_per_pixel
from wearline_judge.core.judgement import JudgingSettings, judge_points

FLAKE = Flake(StampedPart(), 25.0, 8.0, 14.0, 0.2)
LAPS = 15


def timed(work: Callable[[], Any], laps: int) -> tuple[Any, float, float]:
    """Result, and median wall and processor time. [ms]"""
    wall, own, result = [], [], None
    for _ in range(laps):
        begun, begun_own = time.perf_counter(), time.process_time()
        result = work()
        wall.append(1e3 * (time.perf_counter() - begun))
        own.append(1e3 * (time.process_time() - begun_own))
    return result, float(np.median(wall)), float(np.median(own))


def clouds(taught: Bench, measured: LinePoints) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Template (its map on every other pixel) and part as points x, y, z. [mm]"""
    scale = mm_per_pixel(taught.head)
    surface = taught.golden.map_mm[::2, ::2]
    row, col = np.nonzero(np.isfinite(surface))
    template = np.column_stack([2.0 * col * scale, 2.0 * row * scale, surface[row, col]])
    points = measured.points.astype(np.float64)
    return template, np.column_stack([points[:, 2] * scale, points[:, 1] * scale, points[:, 3]])


def errors(x_mm: NDArray[np.float64], y_mm: NDArray[np.float64], found: NDArray[np.float64]) -> tuple[float, float]:
    """Standard deviation off the flake, and mean on it (true: 0.2). [mm]"""
    middle_x, middle_y = 0.1 * 811.5 + FLAKE.x_mm, 0.1 * 611.5 + FLAKE.y_mm
    away = np.maximum(np.abs(x_mm - middle_x), np.abs(y_mm - middle_y))
    seen = np.isfinite(found)
    return float(np.std(found[seen & (away > 12.0)])), float(np.mean(found[seen & (away < 4.0)]))


def main() -> None:
    """Print."""
    cv2.setNumThreads(1)
    taught = bench()
    measured = taught.measure(FLAKE, "dark", 77)
    setup, settings = taught.setup(), JudgingSettings()
    judged, wall, own = timed(lambda: judge_points(measured, setup, settings), LAPS)
    cells = setup.cells
    spread, height = errors(0.1 * cells.x_px, 0.1 * cells.y_px, judged.comparison.deviation_mm)
    print(f"{'':34} {'wall ms':>8} {'cpu ms':>8} {'sd um':>7} {'flake um':>9}")
    name = f"judge_points, {len(measured.points)} points"
    print(f"{name:34} {wall:8.1f} {own:8.1f} {1e3 * spread:7.1f} {1e3 * height:9.1f}")
    try:
        py4dgeo = importlib.import_module("py4dgeo")
    except ImportError:
        print("py4dgeo is not installed: no peer measured")
        return
    py4dgeo.set_num_threads(1)
    template, part = clouds(taught, measured)
    for every in (1, 10):
        core = part[::every]

        def m3c2(core: NDArray[np.float64] = core) -> NDArray[np.float64]:
            first, second = py4dgeo.Epoch(template), py4dgeo.Epoch(part)
            method = py4dgeo.M3C2(
                epochs=(first, second), corepoints=core, cyl_radius=1.0, normal_radii=(3.0,), max_distance=5.0,
                orientation_vector=np.array([0.0, 0.0, 1.0]),
            )  # fmt: skip
            return np.asarray(method.run()[0])

        found, wall, own = timed(m3c2, 3)
        spread, height = errors(core[:, 0], core[:, 1], found)
        name = f"py4dgeo M3C2, {len(core)} core points"
        print(f"{name:34} {wall:8.1f} {own:8.1f} {1e3 * spread:7.1f} {1e3 * height:9.1f}")


if __name__ == "__main__":
    main()
