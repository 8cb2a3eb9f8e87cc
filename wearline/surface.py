"""Line points to a dense height map.

Between two neighbouring lines the surface is a cubic through the four nearest lines of the same
cross section (Catmull-Rom, unequal distances); where a line is missing, where the height jumps and
in shadows nothing is drawn. The uncertainty grows between the lines by what a cubic may miss.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
_STEP_RATIO = 2.0
"""A rise this many times steeper than on both sides of it is a step, not a slope."""
_STEP_SHARE = 0.06
"""And it is at least this share of the height that moves a line by the pitch."""
_STEP_SHARE_AT_RIM = 0.35
"""Where there are lines on one side only."""


@dataclass(frozen=True)
class SurfaceMap:
    """Heights on every sensor pixel of a region."""

    z_mm: F32
    """(row, col), NaN = not measured. [mm]"""
    sigma_mm: F32
    """(row, col), one standard uncertainty, NaN where z_mm is. [mm]"""
    roi: NDArray[np.int32]
    """x, y, width, height on the sensor. [px]"""


def dense_map(
    points: F32,
    shape: tuple[int, int],
    *,
    is_vertical: bool = False,
    roi: tuple[int, int, int, int] | None = None,
) -> SurfaceMap:
    """The surface through line points.

    Args:
        points: float32 [n, 5]: line, row_px, col_px, z_mm, sigma_mm, one per line and integer
            position along it, as `messages.LinePoints` carries them.
        shape: rows, cols of the sensor.
        is_vertical: the lines run along the sensor's rows axis.
        roi: x, y, width, height of the wanted part of the sensor; None = all of it. [px]
    """
    rows, cols = shape
    x, y, width, height = roi or (0, 0, cols, rows)
    along_size, across_size = (rows, cols) if is_vertical else (cols, rows)
    z = np.full((across_size, along_size), np.nan, np.float32)
    sigma = np.full((across_size, along_size), np.nan, np.float32)
    if len(points):
        _fill(points, is_vertical, z, sigma)
    if is_vertical:
        z, sigma = z.T, sigma.T
    window = (slice(y, y + height), slice(x, x + width))
    return SurfaceMap(
        np.ascontiguousarray(z[window]), np.ascontiguousarray(sigma[window]), np.array([x, y, width, height], np.int32)
    )


def _fill(points: F32, is_vertical: bool, z_map: F32, sigma_map: F32) -> None:
    """Draw into maps [across, along]."""
    along_size = z_map.shape[1]
    line = np.rint(points[:, 0]).astype(np.int64)
    along = np.rint(points[:, 1 if is_vertical else 2]).astype(np.int64)
    inside = (along >= 0) & (along < along_size) & np.isfinite(points.sum(axis=1)) & (line >= 0)
    line, along = line[inside], along[inside]
    grid = np.full((3, int(line.max(initial=-1)) + 1, along_size), np.nan, np.float32)
    for k, column in enumerate((2 if is_vertical else 1, 3, 4)):
        grid[k, line, along] = points[inside, column]
    across, z, sigma = grid
    gap = np.diff(across, axis=0)
    rise = np.diff(z, axis=0)
    is_open = np.isfinite(gap) & (gap > 0.5)
    slope = np.where(is_open, rise / np.where(is_open, gap, 1.0), np.nan)
    joined = is_open & ~_steps(gap, rise, sigma)
    slope[~joined] = np.nan
    tangent = _tangents(gap, slope)
    # Hermite's cubic over t = 0 .. 1: z0 + chord t + u (bend - twist t), u = t (1 - t).
    chord = slope * gap
    bend = tangent[:-1] * gap - chord
    bend_after = tangent[1:] * gap - chord
    # What a cubic may miss is a share of what it adds to the chord.
    bulge = np.float32(0.6) * (np.abs(bend) + np.abs(bend_after))
    intervals = np.stack([
        np.where(joined, across[:-1], np.nan), 1.0 / gap, z[:-1], chord, bend, bend + bend_after,
        sigma[:-1] ** 2, sigma[1:] ** 2 - sigma[:-1] ** 2, bulge * bulge,
    ])  # fmt: skip
    edges = np.arange(0, along_size, _CHUNK)
    first = np.ceil(np.fmin.reduceat(intervals[0], edges, axis=1))
    last = np.floor(np.fmax.reduceat(np.where(joined, across[1:], np.nan), edges, axis=1))
    buffers = np.empty((4, 0), np.float32)
    for chunk, edge in enumerate(edges.tolist()):
        columns = slice(edge, edge + _CHUNK)
        for k in np.flatnonzero(np.isfinite(first[:, chunk])).tolist():
            rows = slice(max(int(first[k, chunk]), 0), min(int(last[k, chunk]) + 1, len(z_map)))
            size = (rows.stop - rows.start) * _CHUNK
            if buffers.shape[1] < size:
                buffers = np.empty((4, 2 * size), np.float32)
            if size > 0:
                _fill_interval(intervals[:, k, columns], rows, buffers, z_map[rows, columns], sigma_map[rows, columns])


_CHUNK = 512
"""Columns that are drawn at once: what one step touches stays in the cache. [px]"""


def _fill_interval(mine: F32, rows: slice, buffers: F32, z_part: F32, sigma_part: F32) -> None:
    """Pixels between two lines; ``mine`` is what `_fill` stacks: [9, along]."""
    top, per_px, start, chord, bend, twist, variance, more, bulge2 = mine
    t, u, value, spread = (buffer[: z_part.size].reshape(z_part.shape) for buffer in buffers)
    np.subtract(np.arange(rows.start, rows.stop, dtype=np.float32)[:, None], top, out=t)
    t *= per_px
    np.multiply(t, t, out=u)
    np.subtract(t, u, out=u)
    # u is negative outside and NaN where nothing is drawn.
    inside = u >= 0.0
    np.multiply(t, twist, out=value)
    np.subtract(bend, value, out=value)
    value *= u
    np.multiply(t, chord, out=spread)
    value += spread
    value += start
    np.copyto(z_part, value, where=inside)
    u *= u
    u *= bulge2
    t *= more
    u += t
    u += variance
    with np.errstate(invalid="ignore"):
        np.sqrt(u, out=u)
    np.copyto(sigma_part, u, where=inside)


def _steps(gap: F32, rise: F32, sigma: F32) -> NDArray[np.bool_]:
    """Where the height jumps between two lines: [line - 1, along]."""
    size = np.abs(rise)
    with np.errstate(invalid="ignore", divide="ignore"):
        beside = np.zeros_like(size)
        beside[1:] = np.fmax(beside[1:], np.nan_to_num(size[:-1]))
        beside[:-1] = np.fmax(beside[:-1], np.nan_to_num(size[1:]))
        # At the rim of what is seen a wall has nothing on its other side: only a clear jump is a step there.
        is_rim = np.ones_like(size, bool)
        is_rim[1:-1] = ~(np.isfinite(size[:-2]) & np.isfinite(size[2:]))
        share = np.where(is_rim, np.float32(_STEP_SHARE_AT_RIM), np.float32(_STEP_SHARE))
        # How far a line moves per mm is read from the frame: neighbours that jump also change their distance.
        usual = np.full_like(gap[:1], np.nan)
        # Beyond a region of interest there is no line at all.
        known = np.isfinite(gap).any(axis=0)
        if known.any():
            usual[:, known] = np.nanmedian(gap[:, known], axis=0)
        moved = np.abs(gap - usual)
        floor = np.maximum(6.0 * np.maximum(sigma[1:], sigma[:-1]), 0.02)
        return np.asarray((size > _STEP_RATIO * beside + floor) & (moved > share * usual))


def _tangents(gap: F32, slope: F32) -> F32:
    """Slope of the surface across the lines at each point: [line, along]."""
    lines = len(gap) + 1
    tangent = np.full((lines, gap.shape[1]), np.nan, np.float32)
    if not len(gap):
        return tangent
    before = np.concatenate([np.full_like(slope[:1], np.nan), slope])
    after = np.concatenate([slope, np.full_like(slope[:1], np.nan)])
    gap_before = np.concatenate([gap[:1], gap])
    gap_after = np.concatenate([gap, gap[-1:]])
    both = (before * gap_after + after * gap_before) / (gap_before + gap_after)
    # At the rim of a surface the parabola through three lines gives the outer tangent.
    inner_after = np.concatenate([both[1:], both[-1:]])
    inner_before = np.concatenate([both[:1], both[:-1]])
    rim = np.where(np.isfinite(after), 2.0 * after - inner_after, 2.0 * before - inner_before)
    chord = np.where(np.isfinite(after), after, before)
    tangent = np.where(np.isfinite(both), both, np.where(np.isfinite(rim), rim, chord))
    return tangent.astype(np.float32)
