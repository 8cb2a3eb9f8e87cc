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
    z = np.full((along_size, across_size), np.nan, np.float32)
    sigma = np.full((along_size, across_size), np.nan, np.float32)
    if len(points):
        _fill(points, is_vertical, z, sigma)
    if not is_vertical:
        z, sigma = z.T, sigma.T
    window = (slice(y, y + height), slice(x, x + width))
    return SurfaceMap(
        np.ascontiguousarray(z[window]), np.ascontiguousarray(sigma[window]), np.array([x, y, width, height], np.int32)
    )


def _fill(points: F32, is_vertical: bool, z_map: F32, sigma_map: F32) -> None:
    along_size = z_map.shape[0]
    line = np.rint(points[:, 0]).astype(np.int64)
    along = np.rint(points[:, 1 if is_vertical else 2]).astype(np.int64)
    inside = (along >= 0) & (along < along_size) & np.isfinite(points).all(axis=1) & (line >= 0)
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
    for k in range(len(gap)):
        columns = np.flatnonzero(joined[k])
        if len(columns):
            _fill_interval(k, columns, across, z, sigma, gap, slope, tangent, z_map, sigma_map)


def _steps(gap: F32, rise: F32, sigma: F32) -> NDArray[np.bool_]:
    """Where the height jumps between two lines: [line - 1, along]."""
    size = np.abs(rise)
    with np.errstate(invalid="ignore", divide="ignore"):
        beside = np.zeros_like(size)
        beside[1:] = np.fmax(beside[1:], np.nan_to_num(size[:-1]))
        beside[:-1] = np.fmax(beside[:-1], np.nan_to_num(size[1:]))
        # How far a line moves per mm is read from the frame: neighbours that jump also change their distance.
        usual = np.nanmedian(gap, axis=0, keepdims=True) if gap.size else gap
        moved = np.abs(gap - usual)
        floor = np.maximum(6.0 * np.maximum(sigma[1:], sigma[:-1]), 0.02)
        return np.asarray((size > _STEP_RATIO * beside + floor) & (moved > _STEP_SHARE * usual))


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


def _fill_interval(
    k: int, columns: NDArray[np.int64], across: F32, z: F32, sigma: F32, gap: F32, slope: F32, tangent: F32,
    z_map: F32, sigma_map: F32,
) -> None:  # fmt: skip
    """Pixels from line k up to, and without, line k + 1 (with it where the surface ends there)."""
    top, below = across[k, columns], across[k + 1, columns]
    first = np.ceil(top).astype(np.int64)
    reach = int(np.ceil(below - first).max()) + 1
    width = gap[k, columns]
    t = (np.arange(reach, dtype=np.float32)[None, :] + (first - top).astype(np.float32)[:, None]) / width[:, None]
    is_inside = (t <= 1.0) & (first[:, None] + np.arange(reach) < z_map.shape[1]) & (first >= 0)[:, None]
    m0, m1 = tangent[k, columns] * width, tangent[k + 1, columns] * width
    chord = slope[k, columns] * width
    c2, c3 = 3.0 * chord - 2.0 * m0 - m1, m0 + m1 - 2.0 * chord
    value = ((c3[:, None] * t + c2[:, None]) * t + m0[:, None]) * t + z[k, columns][:, None]
    v0, v1 = sigma[k, columns] ** 2, sigma[k + 1, columns] ** 2
    # What a cubic may miss is a share of what it adds to the chord.
    bulge = 0.15 * (np.abs(m0 - chord) + np.abs(m1 - chord))
    u = t * (1.0 - t)
    variance = v0[:, None] + (v1 - v0)[:, None] * t + (np.float32(4.0) * bulge[:, None] * u) ** 2
    target = (columns * z_map.shape[1] + first)[:, None] + np.arange(reach)
    chosen = target[is_inside]
    z_map.reshape(-1)[chosen] = value[is_inside]
    sigma_map.reshape(-1)[chosen] = np.sqrt(variance[is_inside])
