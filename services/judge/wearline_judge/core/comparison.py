"""Deviation of a part from its template on the laser lines, and the connected regions of it.

A cell is `BLOCK` points of one line; it stands for the sensor area between its line's neighbours.
Decisions rest on cells, so on measured heights alone; nothing of the part is interpolated.

The uncertainty of a cell has two parts. Noise (of the part and of the template) is what reconstruct
states without what is common to the frame, since registration removes that, and scaled by what
neighbouring lines really scatter: streaks of the sheet and light that falls on one half of it are
no surprise then. Guesses between the template's lines are alike along a line, and the rest is alike
over a whole region: spread of good parts, place on a slope, the registration itself.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wearline.config import Settings
from wearline.messages import Region
from wearline.recipe import Zone
from wearline_judge.core.golden import Golden, sample
from wearline_judge.core.line_grid import BLOCK, BLOCK_SEEN, F64, Bool, LineGrid, block_mean, block_sum
from wearline_judge.core.registration import Cells, Motion, RegistrationSettings, register


class ComparisonSettings(Settings):
    """When a deviation is believed."""

    cell_significance: float = Field(default=3.0, ge=0)
    """A cell, or the mean of its neighbourhood, starts a region when it deviates by this many standard uncertainties
    and by the precision."""
    region_significance: float = Field(default=1.645, ge=0)
    """A region counts when its mean exceeds the precision by this many standard uncertainties (one-sided 95 %)."""
    region_existence: float = Field(default=5.0, ge=0)
    """And when the mean of a whole neighbourhood in it is this many standard uncertainties from zero: a part has
    hundreds of places where noise could make a region, and cells that were picked for their size prove nothing."""
    correlation_px: float = Field(default=120.0, gt=0)
    """Distance along a line at which errors are no longer alike. [px]"""
    position_sigma_mm: float = Field(default=0.01, ge=0)
    """Standard uncertainty of where a point lies, felt through the slope. [mm]"""
    area_floor_px: float = Field(default=2500.0, ge=0)
    """Stands for the recipe's area_floor_mm2 where no lateral scale is known. [px]"""
    half_pitch_share: float = Field(default=0.5, gt=0, le=1)
    """A point further than this share of the pitch from the template's line is not compared."""


@dataclass(frozen=True)
class TemplateCells:
    """The template laid out in cells for one region of interest; made once. Arrays are (line, block)."""

    wanted: Bool
    """(line, along): points of the template that a part should show."""
    expected: F64
    """Points of the template in each cell."""
    x_px: F64
    y_px: F64
    """Middle of each cell on the template, NaN = none. [px]"""
    z_mm: F64
    slope_x: F64
    slope_y: F64
    """Rise of the template. [mm/px]"""
    offset_mm: F64
    """Mean height of the cell minus the template's map at its middle. [mm]"""
    noise_mm2: F64
    """Variance of the template's mean height. [mm^2]"""
    natural_mm2: F64
    """Variance among good parts. [mm^2]"""
    area_px: F64
    middle_px: tuple[float, float]
    """x, y about which a part turns. [px]"""
    middle_z_mm: float


def template_cells(golden: Golden, inside: Bool | None) -> TemplateCells:
    """Lay out a template.

    Args:
        golden: the template.
        inside: (line, along), points of the recipe's ROI; None = all.
    """
    wanted = golden.is_expected if inside is None else golden.is_expected & inside
    x, y = block_mean(golden.x_px, wanted), block_mean(golden.y_px, wanted)
    z = block_mean(golden.z_mm, wanted)
    at = (x - golden.roi[0], y - golden.roi[1])
    slope_x, slope_y = (np.nan_to_num(sample(field, *at)) for field in (golden.slope_x, golden.slope_y))
    has = np.isfinite(x)
    pitch = block_mean(golden.pitch_px, np.isfinite(golden.pitch_px))
    return TemplateCells(
        wanted=wanted,
        expected=block_sum(wanted),
        x_px=x,
        y_px=y,
        z_mm=z,
        slope_x=slope_x,
        slope_y=slope_y,
        offset_mm=z - sample(golden.near_mm, *at),
        noise_mm2=np.nan_to_num(block_mean(golden.variance_mm2, wanted)),
        natural_mm2=np.nan_to_num(block_mean(golden.natural_mm2, wanted)),
        area_px=np.where(np.isfinite(pitch), pitch, 0.0) * BLOCK,
        middle_px=(float(np.mean(x[has])), float(np.mean(y[has]))) if has.any() else (0.0, 0.0),
        middle_z_mm=float(np.mean(z[has])) if has.any() else 0.0,
    )


@dataclass(frozen=True)
class PartCells:
    """What one frame showed, means over the points of each cell; (line, block), NaN = not seen."""

    seen: F64
    """Points of the template that were seen."""
    x_px: F64
    y_px: F64
    z_mm: F64
    variance_mm2: F64
    """Mean variance of the points, common part included. [mm^2]"""


def part_cells(points: NDArray[np.float32], golden: Golden, cells: TemplateCells, share: float) -> PartCells:
    """Gather line points [n, 5] (line, row_px, col_px, z_mm, sigma_mm) into the template's cells.

    A point counts where the template has one, within `share` of the pitch of it; points that are not
    finite or lie outside the grid do not, nor does a second one at the same place.
    """
    lines, along = golden.z_mm.shape
    blocks = -(-along // BLOCK)
    finite = np.isfinite(points).all(axis=1) if len(points) else np.zeros(0, bool)
    line_f, row, col, z, sigma = (points if finite.all() else points[finite]).T.astype(np.float64)
    across, along_f = (col, row) if golden.is_vertical else (row, col)
    line, place = np.rint(line_f).astype(np.int64), np.rint(along_f).astype(np.int64)
    keep = (line >= 0) & (line < lines) & (place >= 0) & (place < along)
    index = np.where(keep, line * along + place, 0)
    near = np.abs(across - golden.across_px.ravel()[index]) <= share * golden.pitch_px.ravel()[index]
    keep &= cells.wanted.ravel()[index] & near
    if np.bincount(index[keep], minlength=1).max(initial=0) > 1:
        first = np.zeros(len(index), bool)
        kept = np.flatnonzero(keep)
        first[kept[np.unique(index[kept], return_index=True)[1]]] = True
        keep = first
    cell = (line * blocks + place // BLOCK)[keep]
    size = lines * blocks
    seen = np.bincount(cell, minlength=size).astype(np.float64)
    enough = seen >= BLOCK_SEEN
    means = [
        np.where(enough, np.bincount(cell, v[keep], size) / np.maximum(seen, 1.0), np.nan).reshape(lines, blocks)
        for v in (across, along_f, z, sigma * sigma)
    ]
    across_mean, along_mean = means[0], means[1]
    x, y = (across_mean, along_mean) if golden.is_vertical else (along_mean, across_mean)
    return PartCells(seen.reshape(lines, blocks), x, y, means[2], means[3])


@dataclass(frozen=True)
class Doubt:
    """What a deviation is uncertain by, (line, block), one standard uncertainty each. [mm]"""

    noise_mm: F64
    """Alike over a short distance along a line, independent from line to line."""
    guess_mm: F64
    """Alike along a line, independent from line to line."""
    common_mm: F64
    """Alike over a whole region."""
    correlation_px: float
    """Distance along a line at which noise is no longer alike. [px]"""

    @property
    def sigma_mm(self) -> F64:
        """All of it. [mm]"""
        return np.sqrt(self.noise_mm**2 + self.guess_mm**2 + self.common_mm**2)

    def of_mean(self, at: Bool, area: F64) -> float:
        """Standard uncertainty of the area-weighted mean over the cells `at`. [mm]"""
        rows, blocks = np.nonzero(at)
        if not rows.size:
            return 0.0
        window = (slice(int(rows.min()), int(rows.max()) + 1), slice(int(blocks.min()), int(blocks.max()) + 1))
        inside = at[window]
        share = np.where(inside, area[window], 0.0)
        share = share / share.sum()
        noise, guess, common = (
            np.where(inside, share * a[window], 0.0) for a in (self.noise_mm, self.guess_mm, self.common_mm)
        )
        reach = max(int(np.ceil(self.correlation_px / BLOCK)), 1)
        kernel = np.clip(1.0 - np.abs(np.arange(-reach, reach + 1)) * BLOCK / self.correlation_px, 0.0, None)[None, :]
        alike = cv2.filter2D(noise, -1, kernel, borderType=cv2.BORDER_CONSTANT)
        variance = float(np.sum(noise * alike)) + float(np.sum(guess.sum(axis=1) ** 2)) + float(common.sum()) ** 2
        return float(np.sqrt(variance))


@dataclass(frozen=True)
class Comparison:
    """One part against its template; arrays are (line, block)."""

    deviation_mm: F64
    """Measured minus template after registration; NaN = not compared. [mm]"""
    sigma_mm: F64
    """Its standard uncertainty. [mm]"""
    doubt: Doubt
    area_px: F64
    label: NDArray[np.int32]
    """0 = within precision, else the number of a significant region, from 1."""
    expected: F64
    seen: F64
    """Points of the template in each cell, and how many of them were seen."""
    regions: tuple[Region, ...]
    """Significant ones, largest first."""
    motion: Motion

    @property
    def coverage(self) -> float:
        """Share of the template's points that were seen, 0-1."""
        total = float(self.expected.sum())
        return float(self.seen.sum()) / total if total else 0.0

    def mean_sigma(self, at: Bool) -> float:
        """Standard uncertainty of the area-weighted mean deviation of the cells `at`. [mm]"""
        return self.doubt.of_mean(at, self.area_px)


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


def compare(
    golden: Golden,
    cells: TemplateCells,
    points: NDArray[np.float32],
    precision_mm: F64,
    area_floor_mm2: float,
    datum: Bool | None,
    sigma_frame_mm: float,
    settings: ComparisonSettings,
    registration: RegistrationSettings,
) -> Comparison:
    """Register a part and find where it deviates.

    Args:
        golden, cells: the template.
        points: [n, 5], what the frame showed.
        precision_mm: (line, block), deviation above which a cell counts. [mm]
        area_floor_mm2: smaller regions do not count. [mm^2]
        datum: (line, block), cells that the registration may use; None = all.
        sigma_frame_mm: share of the points' uncertainty that is common to the frame. [mm]
        settings, registration: thresholds.
    """
    part = part_cells(points, golden, cells, settings.half_pitch_share)
    scale = golden.mm_per_pixel
    unit = scale or 1.0
    place = Cells(
        (part.x_px - cells.middle_px[0]) * unit,
        (part.y_px - cells.middle_px[1]) * unit,
        cells.z_mm - cells.middle_z_mm if scale else np.zeros(part.z_mm.shape),
        cells.slope_x / unit,
        cells.slope_y / unit,
        golden.camera_distance_mm if scale else float("inf"),
    )
    noise2 = np.maximum(part.variance_mm2 - sigma_frame_mm**2, 0.1 * part.variance_mm2) + cells.noise_mm2

    # Neighbouring cells of a line err alike: a part of them determines the motion as well as all.
    step = max(1, int(np.count_nonzero(np.isfinite(part.z_mm))) // _CELLS_FOR_MOTION)
    few_cells, few_part, few_place = thinned(cells, step), thinned(part, step), thinned(place, step)
    few_sigma2 = (noise2 + cells.natural_mm2)[:, ::step]

    def residual(motion: Motion) -> tuple[F64, F64]:
        expected, guess = _moved_template(golden, few_cells, few_part, few_place, motion, unit)
        return (few_part.z_mm - expected).ravel(), np.sqrt(few_sigma2 + guess**2).ravel()

    flat_place = Cells(
        few_place.x.ravel(), few_place.y.ravel(), few_place.height_mm.ravel(), few_place.slope_x.ravel(),
        few_place.slope_y.ravel(), few_place.distance,
    )  # fmt: skip
    use = np.ones(few_part.z_mm.shape, bool) if datum is None else datum[:, ::step]
    motion = register(residual, flat_place, use.ravel(), registration, scale is not None, datum is not None)
    expected, guess = _moved_template(golden, cells, part, place, motion, unit)
    deviation = part.z_mm - expected

    own = settings.position_sigma_mm if scale else settings.position_sigma_mm * 10.0
    common2 = cells.natural_mm2 + motion.place_sigma(place, own) ** 2 + motion.height_sigma_mm**2
    usual = float(np.nanmedian(noise2)) if np.isfinite(noise2).any() else 0.0
    # What reconstruct states above the usual (steep walls, ends of lines) has its own reasons.
    scatter = _scatter(deviation, noise2, common2 + guess**2)
    noise2 = noise2 + (scatter - 1.0) * np.minimum(noise2, usual)
    doubt = Doubt(np.sqrt(noise2), guess, np.sqrt(common2), settings.correlation_px)
    sigma = doubt.sigma_mm

    floor_px = area_floor_mm2 / scale**2 if scale else (settings.area_floor_px if area_floor_mm2 > 0 else 0.0)
    label, regions = _regions(deviation, doubt, sigma, cells, precision_mm, floor_px, scale, settings)
    seen = np.minimum(part.seen, cells.expected)
    return Comparison(deviation, sigma, doubt, cells.area_px, label, cells.expected, seen, regions, motion)


_CELLS_FOR_MOTION = 1500
_Grids = TypeVar("_Grids", TemplateCells, PartCells, Cells)


def thinned(grids: _Grids, step: int) -> _Grids:
    """Every so many blocks of all arrays (line, block)."""
    blocks = {
        entry.name: getattr(grids, entry.name)[:, ::step]
        for entry in fields(grids)
        if isinstance(getattr(grids, entry.name), np.ndarray) and entry.name != "wanted"
    }
    return replace(grids, **blocks)


def _moved_template(
    golden: Golden, cells: TemplateCells, part: PartCells, place: Cells, motion: Motion, unit: float
) -> tuple[F64, F64]:
    """(line, block): height of the template moved by `motion` where the part was seen, and its doubt. [mm]"""
    u, v = motion.move(place)
    x, y = part.x_px - u / unit, part.y_px - v / unit
    at = (x - golden.roi[0], y - golden.roi[1])
    at_map = sample(golden.near_mm, *at) + cells.offset_mm
    on_line = cells.z_mm + cells.slope_x * (x - cells.x_px) + cells.slope_y * (y - cells.y_px)
    height = np.where(np.isfinite(at_map), at_map, on_line) + motion.rise(place)
    return height, np.nan_to_num(sample(golden.doubt_mm, *at))


def point_deviation(golden: Golden, part: LineGrid, motion: Motion) -> F64:
    """(line, along): measured minus template moved by `motion`; NaN where either has no point. [mm]"""
    cells = template_cells(golden, None)
    scale = golden.mm_per_pixel
    unit = scale or 1.0
    along = golden.along_px
    x, y = (part.across_px, along) if golden.is_vertical else (along, part.across_px)
    place = Cells(
        (x - cells.middle_px[0]) * unit,
        (y - cells.middle_px[1]) * unit,
        golden.z_mm - cells.middle_z_mm if scale else np.zeros(part.z_mm.shape),
        np.zeros(0),
        np.zeros(0),
        golden.camera_distance_mm if scale else float("inf"),
    )
    u, v = motion.move(place)
    origin_x, origin_y = golden.roi[0], golden.roi[1]
    offset = golden.z_mm - sample(golden.near_mm, golden.x_px - origin_x, golden.y_px - origin_y)
    moved = sample(golden.near_mm, x - u / unit - origin_x, y - v / unit - origin_y)
    return part.z_mm - (moved + np.nan_to_num(offset)) - motion.rise(place)


_TILE = (29, 9)
"""Blocks along and lines across of the tiles over which scatter is judged: 230 px, so that light on half of a
picture is seen, and large against a flake, whose edges are scatter too."""
_SCATTER_PRIOR = 30.0
"""Cells that the scatter of the whole part counts for against those of a tile."""
_MEDIAN_OF_SQUARE = 0.4549
"""Of a normal deviate of variance 1."""


def _scatter(deviation: F64, noise2: F64, rest2: F64) -> F64:
    """(line, block): real over stated variance of the noise, from second differences between neighbouring lines.

    Wear is smooth from line to line, or ends at an edge that a median forgets; noise is neither.
    """
    lines, blocks = deviation.shape
    if lines < 3:
        return np.ones((lines, blocks))
    bent = deviation[1:-1] - 0.5 * (deviation[:-2] + deviation[2:])
    stated = noise2[1:-1] + 0.25 * (noise2[:-2] + noise2[2:])
    other = rest2[1:-1] + 0.25 * (rest2[:-2] + rest2[2:])
    with np.errstate(invalid="ignore", divide="ignore"):
        # Where other doubts rule, scatter says little about noise.
        ratio = np.where(stated > 1.5 * other, bent * bent / stated, np.nan)
    # Errors are alike over many blocks: every other one says as much.
    ratio[:, 1::2] = np.nan
    usable = ratio[np.isfinite(ratio)]
    if usable.size < 100:
        return np.ones((lines, blocks))
    whole = float(np.median(usable))
    tiles = np.full((-(-lines // _TILE[1]), -(-blocks // _TILE[0])), np.float32(whole))
    for i in range(tiles.shape[0]):
        for j in range(tiles.shape[1]):
            # Half a tile more on every side: neighbours share what they see.
            top, left = i * _TILE[1] - _TILE[1] // 2, j * _TILE[0] - _TILE[0] // 4
            own = ratio[max(top, 0) : top + 2 * _TILE[1], max(left, 0) : left + (3 * _TILE[0]) // 2]
            own = own[np.isfinite(own)]
            if own.size:
                share = own.size / (own.size + _SCATTER_PRIOR)
                tiles[i, j] = share * float(np.median(own)) + (1.0 - share) * whole
    grown = cv2.resize(tiles, (tiles.shape[1] * _TILE[0], tiles.shape[0] * _TILE[1]), interpolation=cv2.INTER_LINEAR)
    return np.clip(grown[:lines, :blocks].astype(np.float64) / _MEDIAN_OF_SQUARE, 0.1, None)


_AROUND = (9, 2)
"""Blocks along and lines across of the neighbourhood whose mean may start a region: some 7 x 8 mm."""
_ANCHOR = (_AROUND[0] // 2, 0)
"""A window reaches from its line to the next one."""
_GROWN = 1.5
"""A region takes in neighbours that deviate by the precision and by this many standard uncertainties."""


@dataclass(frozen=True)
class _Windows:
    """Means over the neighbourhood windows that begin at each cell."""

    mean_mm: NDArray[np.float32]
    sigma_mm: NDArray[np.float32]
    precision_mm: NDArray[np.float32]
    is_whole: Bool
    """Most of the window was seen."""

    def around(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Per cell, the largest value of all windows that hold it."""
        anchor = (_AROUND[0] - 1 - _ANCHOR[0], _AROUND[1] - 1 - _ANCHOR[1])
        return np.asarray(cv2.dilate(values, np.ones((_AROUND[1], _AROUND[0]), np.uint8), anchor=anchor))

    def best(self, sign: float) -> NDArray[np.float32]:
        """Per cell, by how many standard uncertainties the best window that holds it deviates this way."""
        score = np.where(self.is_whole, sign * self.mean_mm / np.maximum(self.sigma_mm, 1e-9), 0.0)
        return self.around(score.astype(np.float32))


def _windows(deviation: F64, doubt: Doubt, seen: Bool, precision: F64) -> _Windows:
    total = _AROUND[0] * _AROUND[1]
    lag = np.abs(np.subtract.outer(np.arange(_AROUND[0]), np.arange(_AROUND[0]))) * BLOCK / doubt.correlation_px
    alike = float(np.mean(np.clip(1.0 - lag, 0.0, None))) / _AROUND[1]
    spread2 = alike * doubt.noise_mm**2 + doubt.guess_mm**2 / _AROUND[1] + doubt.common_mm**2

    def summed(values: F64) -> NDArray[np.float32]:
        known = np.where(seen, values, 0.0).astype(np.float32)
        border = cv2.BORDER_CONSTANT
        return np.asarray(cv2.boxFilter(known, -1, _AROUND, anchor=_ANCHOR, normalize=False, borderType=border))

    count = summed(np.ones(deviation.shape))
    some = np.maximum(count, np.float32(1.0))
    # Of a window at the edge of what was seen less is known.
    sigma = np.sqrt(summed(spread2) / some * (np.float32(total) / some))
    mean, level = (np.asarray(summed(v) / some, np.float32) for v in (deviation, precision))
    return _Windows(mean, np.asarray(sigma, np.float32), level, count > 0.6 * total)


def _starts(
    deviation: F64, sigma: F64, seen: Bool, windows: _Windows, precision: F64, settings: ComparisonSettings
) -> tuple[Bool, Bool]:
    """Cells that start a region, and cells that may belong to one."""
    with np.errstate(invalid="ignore"):
        size = np.abs(deviation)
        starts = size > np.maximum(precision, settings.cell_significance * sigma)
        member = size > np.maximum(precision, _GROWN * sigma)
    needed = np.maximum(windows.precision_mm, np.float32(settings.cell_significance) * windows.sigma_mm)
    for sign in (1.0, -1.0):
        found = windows.is_whole & (np.float32(sign) * windows.mean_mm > needed)
        if found.any():
            reached = windows.around(found.astype(np.float32)) > 0
            starts |= reached & (sign * np.nan_to_num(deviation) > precision)
    return starts & seen, (member | starts) & seen


def _regions(
    deviation: F64, doubt: Doubt, sigma: F64, cells: TemplateCells, precision: F64, floor_px: float,
    scale: float | None, settings: ComparisonSettings,
) -> tuple[NDArray[np.int32], tuple[Region, ...]]:  # fmt: skip
    seen = np.isfinite(deviation) & np.isfinite(sigma)
    windows = _windows(deviation, doubt, seen, precision)
    starts, member = _starts(deviation, sigma, seen, windows, precision, settings)
    label = np.zeros(deviation.shape, np.int32)
    if not starts.any():
        return label, ()
    area = cells.area_px
    found: list[tuple[Region, Bool]] = []
    for sign in (1.0, -1.0):
        own = member & (sign * deviation > 0)
        count, raw = cv2.connectedComponents(own.astype(np.uint8), connectivity=8)
        if count == 1:
            continue
        begun = np.bincount(raw[starts & own], minlength=count) > 0
        sizes = np.bincount(raw.ravel(), weights=area.ravel(), minlength=count)
        best = windows.best(sign)
        for index in range(1, count):
            if not begun[index] or sizes[index] < floor_px or sizes[index] <= 0:
                continue
            at = raw == index
            if float(best[at].max()) < settings.region_existence:
                continue
            region = _region(at, deviation, doubt, cells, precision, scale, settings)
            if region is not None:
                found.append((region, at))
    found.sort(key=lambda pair: -pair[0].area_px)
    for number, (_, at) in enumerate(found, 1):
        label[at] = number
    return label, tuple(region for region, _ in found)


def _region(
    at: Bool, deviation: F64, doubt: Doubt, cells: TemplateCells, precision: F64, scale: float | None,
    settings: ComparisonSettings,
) -> Region | None:  # fmt: skip
    """Figures of one region; None = it does not count."""
    weight, values = cells.area_px[at], deviation[at]
    size = float(weight.sum())
    mean = float(np.sum(np.abs(values) * weight) / size)
    uncertainty = doubt.of_mean(at, cells.area_px)
    limit = float(np.sum(precision[at] * weight) / size)
    if mean - limit < settings.region_significance * uncertainty:
        return None
    half = np.sqrt(weight) / 2.0
    xs, ys = cells.x_px[at], cells.y_px[at]
    left, top = float(np.min(xs - half)), float(np.min(ys - half))
    return Region(
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
