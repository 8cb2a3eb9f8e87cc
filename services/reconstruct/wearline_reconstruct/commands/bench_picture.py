"""The bench's results as one picture, drawn by OpenCV alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from wearline_reconstruct.commands.bench import Report

U8 = NDArray[np.uint8]
_WIDTH, _HEIGHT = 1800, 1240
_INK, _FAINT, _PAPER = (40, 40, 40), (215, 215, 215), (255, 255, 255)
_OURS, _THEIRS, _PRINTED = (160, 90, 20), (40, 110, 220), (130, 130, 130)
"""Blue, orange, grey (BGR)."""


def draw_report(report: Report) -> U8:
    """Six panels: a frame with its points, its map, tables 5.3 and 5.5, figures 5.12 and 5.13."""
    canvas = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
    boxes = [(x, y, 570, 570) for y in (40, 650) for x in (20, 610, 1200)]
    _frame_panel(canvas, boxes[0], report)
    _map_panel(canvas, boxes[1], report)
    _planes_panel(canvas, boxes[2], report)
    _variance_panel(canvas, boxes[3], report)
    _series_panel(canvas, boxes[4], report)
    _speed_panel(canvas, boxes[5], report)
    _text(canvas, "wearline bench: rendered parts, known truth", (20, 26), 0.65)
    for k, (name, colour) in enumerate(
        (("wearline", _OURS), ("thesis' method, same frames", _THEIRS), ("thesis, printed", _PRINTED))
    ):
        cv2.rectangle(canvas, (900 + 290 * k, 12), (918 + 290 * k, 28), colour, -1)
        _text(canvas, name, (926 + 290 * k, 26), 0.55)
    return canvas


def _text(canvas: U8, text: str, at: tuple[int, int], size: float = 0.45, colour: Sequence[int] = _INK) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def _fitted(picture: U8, box: tuple[int, int, int, int]) -> tuple[U8, float]:
    scale = min(box[2] / picture.shape[1], (box[3] - 30) / picture.shape[0])
    return np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8), scale


def _paste(canvas: U8, picture: U8, box: tuple[int, int, int, int]) -> None:
    rows, cols = picture.shape[:2]
    canvas[box[1] + 25 : box[1] + 25 + rows, box[0] : box[0] + cols] = picture


def _frame_panel(canvas: U8, box: tuple[int, int, int, int], report: Report) -> None:
    _text(canvas, "frame, with its points coloured by line number", (box[0], box[1] + 14), 0.5)
    if not report.pictures:
        return
    frame = cv2.cvtColor(np.asarray(report.pictures["frame"], np.uint8), cv2.COLOR_GRAY2BGR)
    points = report.pictures["points"]
    row, col = np.rint(points[:, 1]).astype(int), np.rint(points[:, 2]).astype(int)
    hue = (points[:, 0].astype(int) * 67 % 180).astype(np.uint8)
    colours = cv2.cvtColor(np.stack([hue, np.full_like(hue, 230), np.full_like(hue, 255)], 1)[None], cv2.COLOR_HSV2BGR)
    for shift in (0, 1):
        frame[np.clip(row + shift, 0, frame.shape[0] - 1), col] = colours[0]
    _paste(canvas, _fitted(np.asarray(frame, np.uint8), box)[0], box)


def _map_panel(canvas: U8, box: tuple[int, int, int, int], report: Report) -> None:
    if not report.pictures:
        return
    z = report.pictures["map"]
    low, high = float(np.nanmin(z)), float(np.nanmax(z))
    _text(canvas, f"height map, {low:.1f} to {high:.1f} mm", (box[0], box[1] + 14), 0.5)
    level = np.nan_to_num((z - low) / max(high - low, 1e-6) * 255.0).astype(np.uint8)
    coloured = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS)
    coloured[~np.isfinite(z)] = 235
    _paste(canvas, _fitted(np.asarray(coloured, np.uint8), box)[0], box)


class _Axes:
    """A plot area with a linear or logarithmic vertical axis."""

    def __init__(
        self, canvas: U8, box: tuple[int, int, int, int], title: str, x: tuple[float, float], y: tuple[float, float],
        is_log: bool = False,
    ) -> None:  # fmt: skip
        self.canvas, self._x, self._is_log = canvas, x, is_log
        self._y = (math.log10(y[0]), math.log10(y[1])) if is_log else y
        self.left, self.top = box[0] + 60, box[1] + 30
        self.right, self.bottom = box[0] + box[2] - 10, box[1] + box[3] - 60
        _text(canvas, title, (box[0], box[1] + 14), 0.5)
        cv2.rectangle(canvas, (self.left, self.top), (self.right, self.bottom), _INK, 1)

    def at(self, x: float, y: float) -> tuple[int, int]:
        value = math.log10(max(y, 1e-9)) if self._is_log else y
        across = (x - self._x[0]) / (self._x[1] - self._x[0])
        up = min(max((value - self._y[0]) / (self._y[1] - self._y[0]), 0.0), 1.0)
        return (
            round(self.left + across * (self.right - self.left)), round(self.bottom - up * (self.bottom - self.top)),
        )  # fmt: skip

    def grid(self, values: Sequence[float], form: str = "{:g}") -> None:
        for value in values:
            _, y = self.at(self._x[0], value)
            cv2.line(self.canvas, (self.left + 1, y), (self.right - 1, y), _FAINT, 1)
            _text(self.canvas, form.format(value), (self.left - 52, y + 5))

    def label(self, x: float, text: str, drop: int = 18) -> None:
        px, _ = self.at(x, 1.0)
        width = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)[0][0]
        _text(self.canvas, text, (px - width // 2, self.bottom + drop), 0.42)

    def bar(self, x: float, width: float, y: float, colour: Sequence[int], base: float = 0.0) -> None:
        cv2.rectangle(
            self.canvas, self.at(x - width / 2, max(y, base)), self.at(x + width / 2, min(y, base)), colour, -1
        )

    def line(self, values: Sequence[float], colour: Sequence[int], is_thin: bool = False) -> None:
        places = np.array([self.at(k, v) for k, v in enumerate(values)], np.int32)
        cv2.polylines(self.canvas, [places], False, colour, 1 if is_thin else 2, cv2.LINE_AA)


def _planes_panel(canvas: U8, box: tuple[int, int, int, int], report: Report) -> None:
    axes = _Axes(canvas, box, "table 5.3: mean error of flat plates [um]", (-0.5, 3.5), (-60.0, 160.0))
    axes.grid([-50, 0, 50, 100, 150])
    for k, name in enumerate(("plane 0 mm", "plane 2 mm", "plane 3 mm", "plane 4 mm")):
        rows = {row["method"]: row for row in report.planes if row["scene"] == name}
        axes.label(k, name)
        values = (rows["wearline"]["bias_um"], rows["thesis"]["bias_um"], rows["wearline"]["thesis_bias_um"])
        for n, (value, colour) in enumerate(zip(values, (_OURS, _THEIRS, _PRINTED), strict=True)):
            axes.bar(k - 0.25 + 0.25 * n, 0.22, value, colour)
        axes.label(k, f"sd {rows['wearline']['point_um']:.0f} / {rows['thesis']['point_um']:.0f} um", 36)


def _variance_panel(canvas: U8, box: tuple[int, int, int, int], report: Report) -> None:
    axes = _Axes(
        canvas, box, "figure 5.12: error variance [um^2] by iterations", (0.0, 15.0), (10.0, 2.0e5), is_log=True
    )
    axes.grid([10, 100, 1000, 10000, 100000])
    for n in (0, 3, 5, 10, 15):
        axes.label(n, str(n))
    for name, values in report.variance.items():
        colour = _OURS if "wearline" in name else _PRINTED if "itself" in name else _THEIRS
        axes.line(values, colour, is_thin="plane" in name)
        place = axes.at(3.2, values[4])
        _text(canvas, name, (place[0], place[1] - 7), 0.42, colour)


def _series_panel(canvas: U8, box: tuple[int, int, int, int], report: Report) -> None:
    half = (box[3] - 10) // 2
    for k, name in enumerate(("dull board", "polished steel")):
        area = (box[0], box[1] + k * (half + 10), box[2], half)
        axes = _Axes(canvas, area, f"figure 5.13, {name}: mean error [mm], F = failed", (0.3, 10.7), (0.0, 0.75))
        axes.grid([0, 0.2, 0.4, 0.6])
        rows = {row["method"]: row for row in report.series if row["object"] == name}
        if not rows:
            _text(canvas, "needs wearline-judge", (area[0] + 80, area[1] + 60))
            continue
        for n in range(10):
            good = "good" if n < 2 or n > 7 else "changed"
            axes.label(n + 1, good, 30)
            kinds = (
                (rows["wearline"]["mean_error_mm"], _OURS, rows["wearline"]["decisions"]),
                (rows["thesis"]["mean_error_mm"], _THEIRS, rows["thesis"]["decisions"]),
                (rows["wearline"]["printed_mm"], _PRINTED, None),
            )
            for m, (values, colour, decisions) in enumerate(kinds):
                x = n + 0.75 + 0.25 * m
                value = values[n] if values[n] is not None else 0.0
                axes.bar(x, 0.22, value, colour)
                if decisions is not None and decisions[n] != "PASSED":
                    px, py = axes.at(x, value)
                    _text(canvas, decisions[n][0], (px - 4, py - 4), 0.4, colour)


def _speed_panel(canvas: U8, box: tuple[int, int, int, int], report: Report) -> None:
    axes = _Axes(canvas, box, "table 5.5: frame to points and map [ms]", (-0.5, 4.5), (5.0, 3000.0), is_log=True)
    axes.grid([10, 30, 100, 300, 1000, 3000])
    row: dict[str, Any]
    for k, row in enumerate(report.speed):
        axes.label(k, f"{row['width']}x{row['height']}")
        axes.label(k, "5 iterations", 36)
        values = (row["ms"]["wearline"], row["ms"]["thesis 5"], row["printed_ms"][5])
        for n, (value, colour) in enumerate(zip(values, (_OURS, _THEIRS, _PRINTED), strict=True)):
            axes.bar(k - 0.25 + 0.25 * n, 0.22, value, colour, base=5.0)
