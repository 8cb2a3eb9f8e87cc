"""Where on the part errors are frequent and where wear grows: running sums on a coarse grid, one update per part.

The slope of each square is the least-squares slope of its deviation against the stroke counter. Sums
are kept about the mean (Welford's form), so that millions of strokes lose no digits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wearline_judge.core.comparison import Comparison, TemplateCells
from wearline_judge.core.line_grid import F64


@dataclass(frozen=True)
class WearMap:
    """Sums since the last service; arrays are (row, col) of the coarse grid."""

    square_px: int
    """Sensor pixels along the side of a square."""
    origin_px: tuple[int, int]
    """Sensor x, y of the grid's corner."""
    count: F64
    """Parts that showed the square."""
    errors: F64
    """Of those, parts with a significant region in it."""
    mean_stroke: F64
    mean_mm: F64
    strokes2: F64
    """Sum of squares of the stroke counter about its mean."""
    cross: F64
    """Sum of products of stroke and deviation about their means."""
    deviations2: F64
    """Sum of squares of the deviation about its mean."""

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """What is to be stored; `restored` takes it back."""
        names = ("count", "errors", "mean_stroke", "mean_mm", "strokes2", "cross", "deviations2")
        return {name: getattr(self, name) for name in names}

    @property
    def error_share(self) -> F64:
        """How often a part had an error there, 0-1; NaN where no part was seen."""
        return np.where(self.count > 0, self.errors / np.maximum(self.count, 1.0), np.nan)

    def slope(self) -> tuple[F64, F64]:
        """Slope and its standard uncertainty [mm per 1000 strokes]; NaN below three parts or one stroke."""
        enough = (self.count >= 3) & (self.strokes2 > 0)
        strokes2 = np.where(enough, self.strokes2, 1.0)
        slope = self.cross / strokes2
        rest = np.maximum(self.deviations2 - slope * self.cross, 0.0) / np.maximum(self.count - 2.0, 1.0)
        # Heights are known to a micrometre at best: a perfect line is not perfectly known.
        sigma = np.sqrt(np.maximum(rest, 1e-12) / strokes2)
        return np.where(enough, 1e3 * slope, np.nan), np.where(enough, 1e3 * sigma, np.nan)

    def significance(self) -> F64:
        """Slope over its standard uncertainty; NaN where there is none."""
        slope, sigma = self.slope()
        return slope / sigma


def empty_map(roi: tuple[int, int, int, int], square_px: int = 32) -> WearMap:
    """A map of nothing over a template's ROI (x, y, width, height)."""
    x, y, width, height = roi
    shape = (-(-height // square_px), -(-width // square_px))
    return WearMap(square_px, (x, y), *(np.zeros(shape) for _ in range(7)))


def restored(square_px: int, origin_px: tuple[int, int], arrays: dict[str, NDArray[np.float64]]) -> WearMap:
    """From what `WearMap.arrays` gave.

    Raises:
        KeyError: an array is missing.
    """
    names = ("count", "errors", "mean_stroke", "mean_mm", "strokes2", "cross", "deviations2")
    return WearMap(square_px, origin_px, *(np.array(arrays[name]) for name in names))


def updated(wear: WearMap, stroke: int, comparison: Comparison, cells: TemplateCells) -> WearMap:
    """The map with one more part.

    Args:
        wear: the map so far.
        stroke: of the part.
        comparison: of the part with its template.
        cells: the template that it was compared with.
    """
    rows, cols = wear.count.shape
    seen = np.isfinite(comparison.deviation_mm) & np.isfinite(cells.x_px) & (cells.area_px > 0)
    col = ((cells.x_px[seen] - wear.origin_px[0]) // wear.square_px).astype(np.int64)
    row = ((cells.y_px[seen] - wear.origin_px[1]) // wear.square_px).astype(np.int64)
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    index = (row * cols + col)[inside]
    weight = cells.area_px[seen][inside]
    size = rows * cols
    total = np.bincount(index, weight, size)
    value = np.bincount(index, weight * comparison.deviation_mm[seen][inside], size)
    errors = np.bincount(index, (comparison.label[seen][inside] > 0).astype(np.float64), size) > 0
    has = (total > 0).reshape(rows, cols)
    deviation = np.where(has, value.reshape(rows, cols) / np.maximum(total.reshape(rows, cols), 1e-12), 0.0)

    count = wear.count + has
    share = np.where(has, 1.0 / np.maximum(count, 1.0), 0.0)
    from_stroke, from_mean = stroke - wear.mean_stroke, deviation - wear.mean_mm
    mean_stroke, mean_mm = wear.mean_stroke + share * from_stroke, wear.mean_mm + share * from_mean
    return replace(
        wear,
        count=count,
        errors=wear.errors + errors.reshape(rows, cols),
        mean_stroke=mean_stroke,
        mean_mm=mean_mm,
        strokes2=wear.strokes2 + has * from_stroke * (stroke - mean_stroke),
        cross=wear.cross + has * from_stroke * (deviation - mean_mm),
        deviations2=wear.deviations2 + has * from_mean * (deviation - mean_mm),
    )
