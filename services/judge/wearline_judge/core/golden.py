"""A template made ready for comparison: heights between its lines, their uncertainty, and slopes.

The template's own map is for the eye: it leaves steps open. A part that lies somewhat elsewhere shows
the template at places between its lines, so comparison needs a height there too, with an uncertainty
that says how much was guessed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline.artifact import Calibration, Template
from wearline.errors import TemplateError
from wearline_judge.core.line_grid import BLOCK, F64, Bool, block_mean

_SLOPE_SMOOTHING_PX = 3.0
_SLOPE_STEP_PX = 3
_COVERED = 0.5
"""Share of the golden frames that must have shown a point for it to be expected."""
_BEYOND_PX = 16
"""The outermost lines are carried on by this much, straight. [px]"""
_CURVE_DOUBT = 0.9
"""Standard uncertainty of a height between two lines, as a share of what slopes from five and from three lines make
of it..."""
_BEND_DOUBT = 0.04
"""... and, halfway, as a share of how much the slope changes there."""


@dataclass(frozen=True)
class Golden:
    """What comparison needs of one template; made once per template, it takes some 100 ms."""

    z_mm: F64
    """(line, along): height on the lines; NaN = not expected. [mm]"""
    across_px: F64
    """(line, along); NaN = not expected. [px]"""
    variance_mm2: F64
    """(line, along): of the height itself, without the spread among parts. [mm^2]"""
    natural_mm2: F64
    """(line, along): variance among good parts beyond what noise explains. [mm^2]"""
    pitch_px: F64
    """(line, along): distance that a line stands for, across. [px]"""
    map_mm: NDArray[np.float32]
    """(row, col) within the ROI, for the eye. [mm]"""
    near_mm: NDArray[np.float32]
    """(row, col) within the ROI, for comparison: also where neighbouring lines lie far apart. [mm]"""
    doubt_mm: NDArray[np.float32]
    """(row, col): standard uncertainty of `near_mm` by what lies between the lines, 0 on them. [mm]"""
    slope_x: NDArray[np.float32]
    slope_y: NDArray[np.float32]
    """(row, col): rise of `near_mm` per sensor pixel towards larger x and y. [mm/px]"""
    roi: tuple[int, int, int, int]
    is_vertical: bool
    mm_per_pixel: float | None
    """Lateral scale; None = not known. [mm/px]"""
    camera_distance_mm: float
    """From the camera to the part; infinite when the template does not say. [mm]"""
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


_STEP_RATIO = 2.0
"""A rise between two lines this many times steeper than on both sides of it may be a step..."""
_STEP_MM = 0.3
"""... unless it is smaller than this. [mm]"""


def camera_distance_mm(calibration: Calibration) -> float:
    """Distance from the camera to the datum, from z = A d / (1 + B d) with A / B = s; infinite without a curve. [mm]"""
    steps = calibration.a_mm_per_px[np.isfinite(calibration.a_mm_per_px)]
    if not steps.size or abs(calibration.b_per_px) < 1e-9:
        return float("inf")
    return abs(float(np.median(steps)) / calibration.b_per_px)


def _line_slopes(z: F64, across: F64) -> F64:
    """(line, along): rise per pixel across the lines, from each line's neighbours (three-point formula)."""
    gap, rise = np.diff(across, axis=0), np.diff(z, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        secant = np.where(gap > 1.0, rise / gap, np.nan)
    before = np.concatenate([np.full((1, z.shape[1]), np.nan), secant])
    after = np.concatenate([secant, np.full((1, z.shape[1]), np.nan)])
    gap_before = np.concatenate([np.ones((1, z.shape[1])), gap])
    gap_after = np.concatenate([gap, np.ones((1, z.shape[1]))])
    both = (before * gap_after + after * gap_before) / (gap_before + gap_after)
    return np.where(np.isfinite(both), both, np.where(np.isfinite(before), before, after))


def _wide_slopes(z: F64, across: F64, narrow: F64) -> F64:
    """(line, along): rise per pixel from five lines (derivative of the quartic through them), else `narrow`."""
    slope = narrow.copy()
    inner = slice(2, z.shape[0] - 2)
    if z.shape[0] < 5:
        return slope
    nodes = [across[2 + k : across.shape[0] - 2 + k] - across[inner] for k in (-2, -1, 1, 2)]
    rises = [z[2 + k : z.shape[0] - 2 + k] - z[inner] for k in (-2, -1, 1, 2)]
    total = np.zeros(nodes[0].shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        for i in range(4):
            weight = 1.0 / nodes[i]
            for j in range(4):
                if j != i:
                    weight = weight * nodes[j] / (nodes[j] - nodes[i])
            total += weight * rises[i]
    slope[inner] = np.where(np.isfinite(total), total, narrow[inner])
    return slope


def _may_be_step(z: F64, across: F64, line: int) -> Bool:
    """(along,): whether the rise from `line` to the next may be a step."""
    steepness = []
    for first in (line - 1, line, line + 1):
        if 0 <= first < z.shape[0] - 1:
            steepness.append(np.abs((z[first + 1] - z[first]) / (across[first + 1] - across[first])))
        else:
            steepness.append(np.full(z.shape[1], np.nan))
    beside = np.fmax(steepness[0], steepness[2])
    is_steep = steepness[1] > _STEP_RATIO * np.nan_to_num(beside)
    return np.asarray(is_steep & (np.abs(z[line + 1] - z[line]) > _STEP_MM))


def _near_map(
    z: F64, across: F64, shape: tuple[int, int], origin_across: int, origin_along: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Heights and their doubt, (across, along) within the ROI; cubic between lines, straight beyond the outermost."""
    field = np.full(shape, np.nan, np.float32)
    doubt = np.zeros(shape, np.float32)
    along = slice(origin_along, origin_along + shape[1])
    z, across = z[:, along], across[:, along] - origin_across
    columns = z.shape[1]
    narrow = _line_slopes(z, across)
    slope = _wide_slopes(z, across, narrow)
    for line in range(z.shape[0]):
        for is_after in (False, True):
            # Half a pitch at most beyond a line that has no neighbour there; overwritten where it has.
            reach = across[line] + (_BEYOND_PX if is_after else -_BEYOND_PX)
            if not np.isfinite(reach).any():
                continue
            low = np.nanmin(np.minimum(across[line], reach))
            high = np.nanmax(np.maximum(across[line], reach))
            rows = np.arange(max(int(np.ceil(low)), 0), min(int(high) + 1, shape[0]))[:, None]
            away = rows - across[line]
            with np.errstate(invalid="ignore"):
                inside = (away >= 0) & (away <= _BEYOND_PX) if is_after else (away <= 0) & (away >= -_BEYOND_PX)
            value = z[line] + np.nan_to_num(slope[line]) * away
            part = field[rows[:, 0], :columns] if rows.size else field[:0, :columns]
            inside &= np.isnan(part)
            part[inside] = value[inside]
            if rows.size:
                field[rows[:, 0], :columns] = part
    for line in range(z.shape[0] - 1):
        a0, a1 = across[line], across[line + 1]
        gap = a1 - a0
        good = np.isfinite(gap) & (gap > 1.0)
        if not good.any():
            continue
        rows = np.arange(max(int(np.ceil(np.min(a0[good]))), 0), min(int(np.max(a1[good])) + 1, shape[0]))[:, None]
        if not rows.size:
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            t = (rows - a0) / gap
            inside = good & (t >= 0.0) & (t <= 1.0)
            straight = z[line] * (1.0 - t) + z[line + 1] * t
            m0, m1 = slope[line] * gap, slope[line + 1] * gap
            rise = z[line + 1] - z[line]
            curved = straight + t * (1.0 - t) * ((1.0 - t) * (m0 - rise) - t * (m1 - rise))
            bend = np.maximum(np.abs(m0 - rise), np.abs(m1 - rise))
            off0, off1 = (m0 - narrow[line] * gap), (m1 - narrow[line + 1] * gap)
            other = np.abs(t * (1.0 - t) * ((1.0 - t) * off0 - t * off1))
            # The two may cross by chance: what they differ by nearby counts too.
            other = np.maximum(other, 0.5 * t * (1.0 - t) * np.maximum(np.abs(off0), np.abs(off1)))
            unsure = _CURVE_DOUBT * other + _BEND_DOUBT * bend * 4.0 * t * (1.0 - t)
            # A steep slope and a step look alike on lines: then all that was drawn away from them is doubtful.
            guessed = 0.5 * np.abs(curved - np.where(t < 0.5, z[line], z[line + 1]))
            unsure = np.where(_may_be_step(z, across, line), np.maximum(guessed, unsure), unsure)
        block = np.ix_(rows[:, 0], np.arange(columns))
        field[block] = np.where(inside, curved, field[block])
        doubt[block] = np.where(inside, unsure, doubt[block])
    return field, doubt


def _slopes(field: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Rise per pixel in x and y of a smoothed map; 0 where the map is not known on both sides."""
    known = np.isfinite(field).astype(np.float32)
    filled = np.where(known > 0, field, np.float32(0.0)).astype(np.float32)
    weight = cv2.GaussianBlur(known, (0, 0), _SLOPE_SMOOTHING_PX)
    smooth = cv2.GaussianBlur(filled, (0, 0), _SLOPE_SMOOTHING_PX) / np.maximum(weight, 1e-3)
    smooth = np.where(known > 0, smooth, np.nan).astype(np.float32)
    slopes: list[NDArray[np.float32]] = []
    for axis in (1, 0):
        rise = np.zeros_like(smooth)
        ahead = np.roll(smooth, -_SLOPE_STEP_PX, axis)
        behind = np.roll(smooth, _SLOPE_STEP_PX, axis)
        inner = [slice(None), slice(None)]
        inner[axis] = slice(_SLOPE_STEP_PX, -_SLOPE_STEP_PX)
        where = tuple(inner)
        rise[where] = (ahead - behind)[where] / (2.0 * _SLOPE_STEP_PX)
        slopes.append(np.nan_to_num(rise).astype(np.float32))
    return slopes[0], slopes[1]


def _natural(spread_mm: F64, sigma_mm: F64, frames: int) -> F64:
    """Variance among the golden parts that noise does not explain, smooth over the part. [mm^2]"""
    if frames < 3:
        return np.zeros(spread_mm.shape)
    # Few frames make a rough variance: its excess over noise is believed only in the mean of a neighbourhood.
    excess = np.nan_to_num(spread_mm**2 - frames * sigma_mm**2).astype(np.float32)
    known = np.isfinite(spread_mm).astype(np.float32)
    size = (121, 3)
    mean = cv2.blur(excess * known, size) / np.maximum(cv2.blur(known, size), 1e-3)
    return np.clip(mean, 0.0, None).astype(np.float64)


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
    field = np.ascontiguousarray(template.z_map_mm, np.float32)
    if is_vertical:
        near, doubt = (m.T for m in _near_map(z, across, (roi[2], roi[3]), roi[0], roi[1]))
    else:
        near, doubt = _near_map(z, across, (roi[3], roi[2]), roi[1], roi[0])
    near, doubt = np.ascontiguousarray(near), np.ascontiguousarray(doubt)
    slope_x, slope_y = _slopes(near)
    sigma, spread = (a.astype(np.float64) for a in (template.line_sigma_mm, template.line_spread_mm))
    scale = template.meta.get("mm_per_pixel") or mm_per_pixel
    distance = template.meta.get("camera_distance_mm")
    return Golden(
        z_mm=z,
        across_px=across,
        variance_mm2=np.nan_to_num(sigma * sigma),
        natural_mm2=_natural(np.where(expected, spread, np.nan), sigma, int(template.frames)),
        pitch_px=_pitch(across),
        map_mm=field,
        near_mm=near,
        doubt_mm=doubt,
        slope_x=slope_x,
        slope_y=slope_y,
        roi=(roi[0], roi[1], roi[2], roi[3]),
        is_vertical=is_vertical,
        mm_per_pixel=float(scale) if scale and np.isfinite(scale) else None,
        camera_distance_mm=float(distance) if distance else float("inf"),
        calibration_hash=str(template.calibration_hash),
    )
