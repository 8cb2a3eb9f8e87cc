"""Deviation of a part from its template on the laser lines, and the connected regions of it.

A cell is `BLOCK` points of one line; it stands for the sensor area between its line's neighbours.
Decisions rest on cells, so on measured heights alone; nothing is interpolated between lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wearline.config import Settings
from wearline.messages import Region
from wearline.recipe import Zone
from wearline_judge.core.golden import Golden, sample
from wearline_judge.core.line_grid import BLOCK, F64, Bool, LineGrid, block_mean, block_sum
from wearline_judge.core.registration import Motion, RegistrationSettings, register


class ComparisonSettings(Settings):
    """When a deviation is believed."""

    cell_significance: float = Field(default=3.0, ge=0)
    """A cell deviates when it does so by this many standard uncertainties, and by the precision."""
    region_significance: float = Field(default=1.645, ge=0)
    """A region counts when its mean exceeds the precision by this many standard uncertainties (one-sided 95 %)."""
    correlation_px: float = Field(default=24.0, gt=0)
    """Distance along a line over which errors are alike. [px]"""
    position_sigma_mm: float = Field(default=0.01, ge=0)
    """Standard uncertainty of where a point lies, felt through the slope. [mm]"""
    area_floor_px: float = Field(default=2500.0, ge=0)
    """Stands for the recipe's area_floor_mm2 where no lateral scale is known. [px]"""
    half_pitch_share: float = Field(default=0.5, gt=0, le=1)
    """A point further than this share of the pitch from the template's line is not compared."""


@dataclass(frozen=True)
class Comparison:
    """One part against its template; arrays are (line, block)."""

    deviation_mm: F64
    """Measured minus template after registration; NaN = not compared. [mm]"""
    sigma_mm: F64
    """Its standard uncertainty. [mm]"""
    area_px: F64
    label: NDArray[np.int32]
    """0 = within precision, else the number of a significant region, from 1."""
    expected: F64
    seen: F64
    """Points of the template in each cell, and how many of them were seen."""
    regions: tuple[Region, ...]
    """Significant ones, largest first."""
    motion: Motion
    point_deviation_mm: F64
    """(line, along). [mm]"""

    @property
    def coverage(self) -> float:
        """Share of the template's points that were seen, 0-1."""
        total = float(self.expected.sum())
        return float(self.seen.sum()) / total if total else 0.0


def polygon_mask(zone: Zone, x_px: F64, y_px: F64) -> Bool:
    """Which positions lie inside a zone's polygon (even-odd rule); NaN positions do not."""
    inside = np.zeros(x_px.shape, bool)
    corners = zone.polygon_px
    with np.errstate(invalid="ignore", divide="ignore"):
        for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True):
            crosses = (y0 > y_px) != (y1 > y_px)
            inside ^= crosses & (x_px < (x1 - x0) * (y_px - y0) / ((y1 - y0) or 1e-12) + x0)
    return inside & np.isfinite(x_px) & np.isfinite(y_px)


def block_position(golden: Golden) -> tuple[F64, F64]:
    """(line, block): x and y of the middle of each cell on the template. [px]"""
    expected = golden.is_expected
    return block_mean(golden.x_px, expected), block_mean(golden.y_px, expected)


def _against(golden: Golden, part: LineGrid, shift_px: tuple[float, float]) -> F64:
    """(line, along): measured minus template, the template moved in plane by `shift_px`. [mm]"""
    along = np.broadcast_to(np.arange(part.z_mm.shape[1], dtype=np.float64), part.z_mm.shape)
    x, y = (part.across_px, along) if golden.is_vertical else (along, part.across_px)
    x, y = x - shift_px[0], y - shift_px[1]
    at_map = sample(golden.map_mm, x - golden.roi[0], y - golden.roi[1]) + golden.map_offset_mm
    on_line = golden.z_mm + golden.slope_x * (x - golden.x_px) + golden.slope_y * (y - golden.y_px)
    return part.z_mm - np.where(np.isfinite(at_map), at_map, on_line)


def compare(
    golden: Golden,
    part: LineGrid,
    precision_mm: F64,
    area_floor_mm2: float,
    datum: Bool | None,
    inside: Bool | None,
    sigma_frame_mm: float,
    settings: ComparisonSettings,
    registration: RegistrationSettings,
) -> Comparison:
    """Register a part and find where it deviates.

    Args:
        golden: the template.
        part: what the frame showed.
        precision_mm: (line, block), deviation above which a cell counts. [mm]
        area_floor_mm2: smaller regions do not count. [mm^2]
        datum: (line, block), cells that the registration may use; None = all.
        inside: (line, along), points of the recipe's ROI; None = all.
        sigma_frame_mm: share of the points' uncertainty that is common to the frame. [mm]
        settings, registration: thresholds.
    """
    wanted = golden.is_expected if inside is None else golden.is_expected & inside
    near = np.abs(part.across_px - golden.across_px) <= settings.half_pitch_share * golden.pitch_px
    valid = wanted & part.is_seen & near
    scale = golden.mm_per_pixel
    unit = scale or 1.0
    x_px, y_px = block_position(golden)
    has_cells = np.isfinite(x_px)
    middle_x = float(np.mean(x_px[has_cells])) if has_cells.any() else 0.0
    middle_y = float(np.mean(y_px[has_cells])) if has_cells.any() else 0.0
    x, y = (x_px - middle_x) * unit, (y_px - middle_y) * unit
    slope_x = block_mean(golden.slope_x, golden.is_expected) / unit
    slope_y = block_mean(golden.slope_y, golden.is_expected) / unit

    natural = np.clip(golden.spread_mm**2 - part.sigma_mm**2, 0.0, None)
    variance = block_mean(part.sigma_mm**2 + golden.variance_mm2 + natural, valid)
    use = datum if datum is not None else np.ones(x.shape, bool)
    # The map knows the part at a distance, the linear model only next to it: a second look from the shifted place.
    motion = Motion()
    shift_px = (0.0, 0.0)
    for turn in range(2):
        raw = _against(golden, part, shift_px)
        cells = block_mean(raw, valid)
        step = register(
            cells, np.sqrt(variance), x, y, slope_x, slope_y, use, registration, scale is not None, datum is not None
        )
        motion = Motion(
            step.dz_mm, step.tilt_x, step.tilt_y, motion.dx + step.dx, motion.dy + step.dy,
            step.undetermined, step.scale_mm, step.shift_sigma or motion.shift_sigma,
        )  # fmt: skip
        if turn == 1 or not (step.dx or step.dy):
            break
        shift_px = (motion.dx / unit, motion.dy / unit)
    motion = _held(motion, registration, scale is not None, datum is not None)
    rest_x, rest_y = motion.dx - shift_px[0] * unit, motion.dy - shift_px[1] * unit
    cells = cells - motion.height(x, y) + slope_x * rest_x + slope_y * rest_y
    px, py = golden.x_px - middle_x, golden.y_px - middle_y
    points = raw - motion.height(px * unit, py * unit) + (golden.slope_x * rest_x + golden.slope_y * rest_y) / unit
    steepness = np.hypot(slope_x, slope_y)
    place = np.hypot(settings.position_sigma_mm if scale else settings.position_sigma_mm * 10.0, motion.shift_sigma)
    sigma = np.sqrt(variance + (steepness * place) ** 2)

    area = golden.block_area_px
    seen, expected = block_sum(valid), block_sum(wanted)
    with np.errstate(invalid="ignore"):
        deviates = np.abs(cells) > np.maximum(precision_mm, settings.cell_significance * sigma)
    floor_px = area_floor_mm2 / scale**2 if scale else (settings.area_floor_px if area_floor_mm2 > 0 else 0.0)
    label, regions = _regions(
        np.asarray(deviates & np.isfinite(cells)), cells, sigma, area, x_px, y_px, precision_mm, floor_px, scale,
        sigma_frame_mm, settings,
    )  # fmt: skip
    return Comparison(cells, sigma, area, label, expected, seen, regions, motion, np.where(valid, points, np.nan))


def _held(motion: Motion, settings: RegistrationSettings, is_in_mm: bool, has_datum: bool) -> Motion:
    """The motion with its shift inside its bound, where no datum zone vouches for it."""
    limit = settings.shift_max_mm if is_in_mm else settings.shift_max_px
    length = float(np.hypot(motion.dx, motion.dy))
    if has_datum or length <= limit:
        return motion
    share = limit / length
    return Motion(
        motion.dz_mm, motion.tilt_x, motion.tilt_y, motion.dx * share, motion.dy * share,
        motion.undetermined, motion.scale_mm, motion.shift_sigma,
    )  # fmt: skip


def mean_sigma(sigma: F64, area: F64, sigma_frame_mm: float, correlation_px: float) -> float:
    """Standard uncertainty of an area-weighted mean of cells whose neighbours along a line err alike. [mm]"""
    share = area / area.sum()
    own = np.clip(sigma**2 - sigma_frame_mm**2, 0.0, None)
    alike = min(max(correlation_px / BLOCK, 1.0), float(share.size))
    return float(np.sqrt(alike * np.sum(share**2 * own) + sigma_frame_mm**2))


def _regions(
    deviates: Bool, cells: F64, sigma: F64, area: F64, x_px: F64, y_px: F64, precision: F64, floor_px: float,
    scale: float | None, sigma_frame_mm: float, settings: ComparisonSettings,
) -> tuple[NDArray[np.int32], tuple[Region, ...]]:  # fmt: skip
    count, raw = cv2.connectedComponents(deviates.astype(np.uint8), connectivity=8)
    label = np.zeros(raw.shape, np.int32)
    if count == 1:
        return label, ()
    sizes = np.bincount(raw.ravel(), weights=np.where(deviates, area, 0.0).ravel(), minlength=count)
    found: list[Region] = []
    for index in np.argsort(-sizes, kind="stable"):
        if index == 0 or sizes[index] < floor_px or sizes[index] <= 0:
            continue
        at = raw == index
        weight, values = area[at], cells[at]
        size = float(weight.sum())
        mean = float(np.sum(np.abs(values) * weight) / size)
        uncertainty = mean_sigma(sigma[at], weight, sigma_frame_mm, settings.correlation_px)
        limit = float(np.sum(precision[at] * weight) / size)
        if mean - limit < settings.region_significance * uncertainty:
            continue
        half = np.sqrt(weight) / 2.0
        xs, ys = x_px[at], y_px[at]
        left, top = float(np.min(xs - half)), float(np.min(ys - half))
        found.append(
            Region(
                area_px=round(size),
                area_mm2=size * scale**2 if scale else None,
                volume_mm3=size * scale**2 * float(np.sum(values * weight) / size) if scale else None,
                mean_mm=mean,
                max_mm=float(values[np.argmax(np.abs(values))]),
                p95_mm=float(np.percentile(np.abs(values), 95)),
                sigma_mm=uncertainty,
                row_px=float(np.sum(ys * weight) / size),
                col_px=float(np.sum(xs * weight) / size),
                box_px=(
                    round(left),
                    round(top),
                    round(float(np.max(xs + half)) - left),
                    round(float(np.max(ys + half)) - top),
                ),
            )
        )
        label[at] = len(found)
    return label, tuple(found)
