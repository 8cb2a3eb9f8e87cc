"""Line points on the grid (line, along) that template and part share, and means over short blocks of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

BLOCK = 8
"""Points along a line that make one cell; shorter than the smoothing along a line, so nothing is lost. [px]"""
BLOCK_SEEN = 3
"""A cell with fewer points than this was not seen."""


@dataclass(frozen=True)
class LineGrid:
    """What one frame showed, NaN where nothing was seen."""

    across_px: F64
    """(line, along). [px]"""
    z_mm: F64
    """(line, along). [mm]"""
    sigma_mm: F64
    """(line, along). [mm]"""

    @property
    def is_seen(self) -> Bool:
        """(line, along)."""
        return np.isfinite(self.z_mm)


def line_grid(points: NDArray[np.float32], lines: int, along: int, is_vertical: bool) -> LineGrid:
    """Put line points [n, 5] (line, row_px, col_px, z_mm, sigma_mm) on the grid.

    Points outside the grid and points that are not finite are left out.
    """
    keep = np.isfinite(points).all(axis=1) if len(points) else np.zeros(0, bool)
    rows = points[keep].astype(np.float64)
    line = np.rint(rows[:, 0]).astype(np.int64)
    place = np.rint(rows[:, 1 if is_vertical else 2]).astype(np.int64)
    inside = (line >= 0) & (line < lines) & (place >= 0) & (place < along)
    line, place, rows = line[inside], place[inside], rows[inside]
    grids = [np.full((lines, along), np.nan) for _ in range(3)]
    for grid, column in zip(grids, (2 if is_vertical else 1, 3, 4), strict=True):
        grid[line, place] = rows[:, column]
    return LineGrid(*grids)


def block_sum(values: NDArray[np.generic]) -> F64:
    """Sums over blocks of `BLOCK` along the last axis; (line, along) -> (line, block)."""
    lines, along = values.shape
    blocks = -(-along // BLOCK)
    padded = np.zeros((lines, blocks * BLOCK))
    padded[:, :along] = values
    return np.asarray(padded.reshape(lines, blocks, BLOCK).sum(axis=2))


def block_mean(values: F64, is_valid: Bool) -> F64:
    """Means over blocks of the valid points; NaN where fewer than `BLOCK_SEEN` are valid."""
    count = block_sum(is_valid)
    total = block_sum(np.where(is_valid, values, 0.0))
    return np.where(count >= BLOCK_SEEN, total / np.maximum(count, 1.0), np.nan)
