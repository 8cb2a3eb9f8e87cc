"""A template made ready for comparison: its map, what the map misses on the lines, and its slopes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline.artifact import Template
from wearline.errors import TemplateError
from wearline_judge.core.line_grid import BLOCK, F64, Bool, block_mean

_SLOPE_SMOOTHING_PX = 3.0
_SLOPE_STEP_PX = 3
_COVERED = 0.5
"""Share of the golden frames that must have shown a point for it to be expected."""


@dataclass(frozen=True)
class Golden:
    """What comparison needs of one template; made once per template, it takes some 50 ms."""

    z_mm: F64
    """(line, along): height on the lines; NaN = not expected. [mm]"""
    across_px: F64
    """(line, along); NaN = not expected. [px]"""
    variance_mm2: F64
    """(line, along): of the height itself, without the spread among parts. [mm^2]"""
    spread_mm: F64
    """(line, along): standard deviation among golden parts, noise included. [mm]"""
    map_offset_mm: F64
    """(line, along): height on the line minus the map there; NaN where the map has no height. [mm]"""
    slope_x: F64
    slope_y: F64
    """(line, along): rise per sensor pixel towards larger x and y; 0 where it is not known. [mm/px]"""
    pitch_px: F64
    """(line, along): distance that a line stands for, across. [px]"""
    map_mm: NDArray[np.float32]
    """(row, col) within the ROI. [mm]"""
    roi: tuple[int, int, int, int]
    is_vertical: bool
    mm_per_pixel: float | None
    """Lateral scale; None = not known. [mm/px]"""
    calibration_hash: str

    @property
    def is_expected(self) -> Bool:
        """(line, along)."""
        return np.isfinite(self.z_mm)

    @property
    def along_px(self) -> F64:
        """(line, along): coordinate along the lines. [px]"""
        lines, along = self.z_mm.shape
        return np.broadcast_to(np.arange(along, dtype=np.float64), (lines, along))

    @property
    def x_px(self) -> F64:
        return self.across_px if self.is_vertical else self.along_px

    @property
    def y_px(self) -> F64:
        return self.along_px if self.is_vertical else self.across_px

    @property
    def block_area_px(self) -> F64:
        """(line, block): sensor area that one cell stands for. [px]"""
        pitch = block_mean(self.pitch_px, np.isfinite(self.pitch_px))
        return np.where(np.isfinite(pitch), pitch, 0.0) * BLOCK


def sample(field: NDArray[np.float32], x: F64, y: F64) -> F64:
    """Bilinear values of a map at (x, y), in the map's own pixels; NaN outside and next to NaN."""
    shape = x.shape
    # OpenCV reads positions in steps of 1/32 px; far finer than any slope here can show in heights,
    # but float32 maps go through its exact path only up to 32767 rows: flatten to rows of 2048.
    flat_x, flat_y = (np.where(np.isfinite(v), v, -9.0).astype(np.float32).ravel() for v in (x, y))
    width = 2048
    rows = -(-flat_x.size // width)
    padded = np.full((2, rows * width), -9.0, np.float32)
    padded[0, : flat_x.size], padded[1, : flat_y.size] = flat_x, flat_y
    out = cv2.remap(
        field,
        padded[0].reshape(rows, width),
        padded[1].reshape(rows, width),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    )
    return out.ravel()[: flat_x.size].reshape(shape).astype(np.float64)


def _slopes(field: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Rise per pixel in x and y of a smoothed map; NaN where the map is not known on both sides."""
    known = np.isfinite(field).astype(np.float32)
    filled = np.where(known > 0, field, np.float32(0.0)).astype(np.float32)
    weight = cv2.GaussianBlur(known, (0, 0), _SLOPE_SMOOTHING_PX)
    smooth = cv2.GaussianBlur(filled, (0, 0), _SLOPE_SMOOTHING_PX) / np.maximum(weight, 1e-3)
    smooth = np.where(known > 0, smooth, np.nan).astype(np.float32)
    slopes: list[NDArray[np.float32]] = []
    for axis in (1, 0):
        rise = np.full_like(smooth, np.nan)
        ahead = np.roll(smooth, -_SLOPE_STEP_PX, axis)
        behind = np.roll(smooth, _SLOPE_STEP_PX, axis)
        inner = [slice(None), slice(None)]
        inner[axis] = slice(_SLOPE_STEP_PX, -_SLOPE_STEP_PX)
        where = tuple(inner)
        rise[where] = (ahead - behind)[where] / (2.0 * _SLOPE_STEP_PX)
        slopes.append(rise.astype(np.float32))
    return slopes[0], slopes[1]


def _pitch(across: F64) -> F64:
    """(line, along): half the distance between the neighbours of each line; the median where they are missing."""
    gap = np.diff(across, axis=0)
    if not np.isfinite(gap).any():
        return np.where(np.isfinite(across), 1.0, np.nan)
    usual = float(np.nanmedian(gap))
    gap = np.where(np.isfinite(gap), np.clip(gap, 0.0, 2.0 * usual), usual)
    edge = np.full((1, across.shape[1]), usual)
    both = np.concatenate([edge, gap, edge], axis=0)
    return np.where(np.isfinite(across), 0.5 * (both[:-1] + both[1:]), np.nan)


def make_golden(template: Template, mm_per_pixel: float | None) -> Golden:
    """Make a template ready.

    Args:
        template: as stored.
        mm_per_pixel: lateral scale where the template has none, from the recipe. [mm/px]

    Raises:
        TemplateError: arrays that do not fit each other, or no point to compare with.
    """
    shapes = {
        a.shape
        for a in (
            template.line_across_px, template.line_z_mm, template.line_sigma_mm,
            template.line_spread_mm, template.line_coverage,
        )
    }  # fmt: skip
    roi = tuple(int(v) for v in np.ravel(template.roi))
    if len(shapes) != 1 or template.line_z_mm.ndim != 2 or len(roi) != 4 or template.z_map_mm.shape != (roi[3], roi[2]):
        raise TemplateError("its arrays do not fit each other", "template", "make it anew with 'wearline template'")
    z, across = (a.astype(np.float64) for a in (template.line_z_mm, template.line_across_px))
    is_vertical = bool(template.meta.get("is_vertical", False))
    expected = np.isfinite(z) & np.isfinite(across) & (template.line_coverage >= _COVERED)
    if not expected.any():
        raise TemplateError("it holds no point", "template", "make it anew with 'wearline template'")
    z, across = np.where(expected, z, np.nan), np.where(expected, across, np.nan)
    along = np.broadcast_to(np.arange(z.shape[1], dtype=np.float64), z.shape)
    x, y = (across, along) if is_vertical else (along, across)
    x, y = x - roi[0], y - roi[1]
    field = np.ascontiguousarray(template.z_map_mm, np.float32)
    slope_x, slope_y = (sample(s, x, y) for s in _slopes(field))
    known = np.isfinite(slope_x) & np.isfinite(slope_y)
    sigma, spread = (np.nan_to_num(a.astype(np.float64)) for a in (template.line_sigma_mm, template.line_spread_mm))
    scale = template.meta.get("mm_per_pixel") or mm_per_pixel
    return Golden(
        z_mm=z,
        across_px=across,
        variance_mm2=sigma * sigma,
        spread_mm=spread,
        map_offset_mm=z - sample(field, x, y),
        slope_x=np.where(known, slope_x, 0.0),
        slope_y=np.where(known, slope_y, 0.0),
        pitch_px=_pitch(across),
        map_mm=field,
        roi=(roi[0], roi[1], roi[2], roi[3]),
        is_vertical=is_vertical,
        mm_per_pixel=float(scale) if scale and np.isfinite(scale) else None,
        calibration_hash=str(template.calibration_hash),
    )
