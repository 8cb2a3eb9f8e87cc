"""The measuring chain: one frame to line points with an uncertainty each.

A pure function of pixels, calibration, recipe and template: `prepare` does once what does not
depend on the frame, `reconstruct` does the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from wearline.artifact import Calibration, Template
from wearline.errors import CalibrationError, FrameError
from wearline.messages import FrameQuality, ResultCode
from wearline.recipe import Recipe
from wearline_reconstruct.core.hdr import flank_centres, merged_peaks
from wearline_reconstruct.core.heights import across_at, height_slope, heights
from wearline_reconstruct.core.lines import Fragments, LineSettings, fragments
from wearline_reconstruct.core.numbering import (
    NONE,
    Gate,
    NumberingSettings,
    make_gate,
    number_by_gate,
    number_fragments,
)
from wearline_reconstruct.core.quality import Numbered, check_pixels, check_stripes, describe, stripe_width
from wearline_reconstruct.core.smoothing import SmoothingSettings, smooth
from wearline_reconstruct.core.spot import Search, Spot, find_spots
from wearline_reconstruct.core.stripes import (
    F32,
    F64,
    I64,
    Bool,
    Image,
    Peaks,
    Scale,
    StripeSettings,
    strip_image,
    stripe_peaks,
)
from wearline_reconstruct.core.thesis import ThesisSettings, rounding_mm, spatial_kalman, thesis_fragments, thesis_peaks

_STREAK_PX = 60.0
"""Length of streaks of rolled sheet: points within it share the error that they cause. [px]"""


@dataclass(frozen=True)
class ChainSettings:
    """Settings of all steps."""

    stripes: StripeSettings = field(default_factory=StripeSettings)
    lines: LineSettings = field(default_factory=LineSettings)
    numbering: NumberingSettings = field(default_factory=NumberingSettings)
    smoothing: SmoothingSettings = field(default_factory=SmoothingSettings)
    thesis: ThesisSettings = field(default_factory=ThesisSettings)


@dataclass(frozen=True)
class Prepared:
    """What the frames of one object share."""

    calibration: Calibration
    recipe: Recipe
    settings: ChainSettings
    scale: Scale
    gate: Gate | None
    expected: Bool
    """(line, along): where a point is expected."""
    search: Search | None
    """Where the spot may be; None = no spot at calibration."""


@dataclass(frozen=True)
class Reconstruction:
    """What one frame showed."""

    points: F32
    """[n, 5]: line, row_px, col_px, z_mm, sigma_mm."""
    sigma_frame_mm: float
    coverage: float
    quality: FrameQuality
    timings_ms: dict[str, float]


def pitch_of(calibration: Calibration) -> float:
    """Usual distance of neighbouring lines. [px]"""
    with np.errstate(invalid="ignore"):
        gaps = np.diff(calibration.across0_px, axis=0)
    finite = gaps[np.isfinite(gaps)]
    return float(np.median(finite)) if len(finite) else float("inf")


def prepare(
    calibration: Calibration, recipe: Recipe, template: Template | None, settings: ChainSettings | None = None
) -> Prepared:
    """Gather what does not depend on the frame.

    Raises:
        CalibrationError: recipe and calibration disagree on the orientation, or there is no usable line.
    """
    settings = settings or ChainSettings()
    if (recipe.orientation == "vertical") != calibration.is_vertical:
        is_named = "orientation" in recipe.model_fields_set
        if is_named:
            raise CalibrationError(
                f"is for {'vertical' if calibration.is_vertical else 'horizontal'} lines, the recipe for "
                f"{recipe.orientation} ones", "calibration", "calibrate with the recipe's --orientation",
            )  # fmt: skip
    pitch = pitch_of(calibration)
    if not np.isfinite(pitch) or pitch <= 0.0:
        raise CalibrationError("has no two neighbouring lines", "calibration", "calibrate again")
    scale = Scale(calibration.stripe_width_px, pitch)
    across_size = _sizes(calibration)[1]
    gate = None
    expected = np.isfinite(calibration.across0_px) & np.isfinite(calibration.a_mm_per_px)
    if template is not None and template.line_across_px.shape == calibration.across0_px.shape:
        gate = make_gate(
            template.line_across_px, template.line_coverage, across_size, pitch, settings.numbering.gate_share
        )
        expected = expected & gate.expected
    else:
        low, high = calibration.z_range_mm
        middle = across_at(calibration, 0.5 * (low + high))
        with np.errstate(invalid="ignore"):
            expected = expected & (middle >= 0) & (middle <= across_size - 1)
    expected = expected & _within(recipe, calibration, expected.shape)
    return Prepared(calibration, recipe, settings, scale, gate, expected, _spot_search(calibration, pitch))


def _sizes(calibration: Calibration) -> tuple[int, int]:
    """Pixels along and across the lines."""
    rows, cols = (int(v) for v in calibration.image_shape)
    return (rows, cols) if calibration.is_vertical else (cols, rows)


def _within(recipe: Recipe, calibration: Calibration, shape: tuple[int, ...]) -> Bool:
    """(line, along): inside the recipe's ROI at the datum."""
    inside = np.ones(shape, bool)
    if recipe.roi is None:
        return inside
    x, y, width, height = recipe.roi
    along = np.arange(shape[1])
    (a0, a1), (c0, c1) = ((y, y + height), (x, x + width)) if calibration.is_vertical else (
        (x, x + width), (y, y + height)
    )  # fmt: skip
    across = across_at(calibration, float(np.mean(calibration.z_range_mm)))
    with np.errstate(invalid="ignore"):
        return inside & (along >= a0) & (along < a1) & (across >= c0) & (across < c1)


def _spot_search(calibration: Calibration, pitch: float) -> Search | None:
    spot = calibration.spot_px
    if not np.isfinite(spot).all() or calibration.lines % 2 == 0:
        return None
    along = float(spot[0] if calibration.is_vertical else spot[1])
    middle = calibration.lines // 2
    place = int(np.clip(round(along), 0, calibration.across0_px.shape[1] - 1))
    places = [float(across_at(calibration, float(z))[middle, place]) for z in calibration.z_range_mm]
    if not np.isfinite(places).all():
        return None
    drift = max(abs(float(calibration.meta.get("spot_along_px_per_mm", 0.0)) * z) for z in calibration.z_range_mm)
    # A part lower or higher than the range must be seen as such, not lost.
    return Search(
        (along - drift - pitch, along + drift + pitch),
        (min(places) - 1.2 * pitch, max(places) + 1.2 * pitch),
        0.4 * float(calibration.meta.get("spot_excess", 1.0)),
    )


def reconstruct(
    pixels: Image | Sequence[Image], prepared: Prepared, clock_s: Callable[[], float] | None = None
) -> Reconstruction:
    """Heights on the laser lines of one frame, or of several exposures of a part at rest.

    Args:
        pixels: uint8 [row, col], the full sensor; or two or three of them.
        prepared: from `prepare`.
        clock_s: a monotonic clock for `timings_ms`; None = no timings.

    Raises:
        FrameError: codes 21 (no picture of laser lines), 12 (too little of it) or 22 (out of range).
    """
    timings: dict[str, float] = {}
    last = clock_s() if clock_s else 0.0

    def lap(name: str) -> None:
        nonlocal last
        if clock_s:
            now = clock_s()
            timings[name] = round(1e3 * (now - last), 3)
            last = now

    calibration, settings = prepared.calibration, prepared.settings
    rows, cols = (int(v) for v in calibration.image_shape)
    strip, peaks = _peaks_of([pixels] if isinstance(pixels, np.ndarray) else pixels, (rows, cols), prepared)
    by_thesis = prepared.recipe.method == "thesis"
    lap("stripes")
    if by_thesis:
        found = thesis_fragments(peaks, prepared.scale, settings.thesis)
    else:
        found = fragments(peaks, prepared.scale, settings.stripes.average_px, settings.lines)
    check_stripes(found, peaks, int(prepared.expected.sum()))
    lap("lines")
    number, spot = _numbered(strip, found, prepared)
    lap("numbering")
    width_px = stripe_width(strip, found.peaks, prepared.scale)
    result = _measured(found, number, spot, width_px, prepared)
    lap("heights")
    return Reconstruction(
        result.points,
        result.sigma_frame_mm,
        result.coverage,
        result.quality,
        {**timings, "total": sum(timings.values())},
    )


def _peaks_of(pictures: Sequence[Image], shape: tuple[int, int], prepared: Prepared) -> tuple[Image, Peaks]:
    """The strip image that shows the spot best, and the peaks of all exposures."""
    settings, scale = prepared.settings, prepared.scale
    exposures: list[tuple[float, Image, Peaks]] = []
    refusal: FrameError | None = None
    for pixels in pictures:
        try:
            check_pixels(pixels, shape)
        except FrameError as error:
            # Of several exposures one may be too dark or too bright to show anything.
            refusal = error
            continue
        strip = strip_image(pixels, prepared.calibration.is_vertical)
        if prepared.recipe.method == "thesis":
            peaks = thesis_peaks(strip, scale, settings.stripes, settings.thesis)
        else:
            peaks = stripe_peaks(strip, scale, settings.stripes)
            if prepared.recipe.hdr != "off":
                peaks = flank_centres(strip, peaks, scale, settings.stripes)
        exposures.append((float(strip[::16, ::16].mean()), strip, peaks))
    if refusal is not None and not exposures:
        raise refusal
    exposures.sort(key=lambda exposure: exposure[0])
    if len(exposures) == 1:
        return exposures[0][1:]
    # The brightest exposure without much saturation: the spot stands out, and does not bloom.
    calm = [e for e in exposures if float(np.mean(e[2].is_saturated)) < 0.1] or exposures[:1]
    return calm[-1][1], merged_peaks([peaks for _, _, peaks in exposures], scale)


def _numbered(strip: Image, found: Fragments, prepared: Prepared) -> tuple[I64, Spot | None]:
    """Line number per peak, and the spot."""
    calibration, pitch = prepared.calibration, prepared.scale.pitch_px
    spots = find_spots(strip, prepared.scale, prepared.search) if prepared.search else []
    if prepared.gate is not None:
        number = number_by_gate(found, prepared.gate)
        spot = _check_against_template(number, found, spots, prepared.gate, prepared)
        return number, spot
    spots = _spots_in_range(spots, prepared)
    if prepared.search is not None and not spots and not prepared.recipe.line_constraints:
        _refuse_spot_elsewhere(strip, prepared)
    numbers = number_fragments(
        found, calibration, pitch, spots, prepared.recipe.line_constraints, prepared.settings.numbering
    )
    if not (numbers.number != NONE).any():
        if prepared.search is not None and not spots:
            raise FrameError(
                "shows no centre spot, and nothing else settles the line numbers",
                cure="uncover the spot, or mark lines with line_constraints in the recipe",
                code=int(ResultCode.COVERAGE),
            )  # fmt: skip
        low, high = calibration.z_range_mm
        raise FrameError(
            f"shows no line at a height between {low:.2f} and {high:.2f} mm that can be numbered for certain",
            cure="check that the part lies in the calibrated range and that this is the calibrated head",
            code=int(ResultCode.COVERAGE),
        )  # fmt: skip
    number = numbers.number[found.label]
    if not spots and not prepared.recipe.line_constraints:
        _check_whole_comb(found, numbers.number, calibration)
    return number, spots[0] if spots else None


_CLEAR_SPOT = 1.5
"""Excess of a spot that cannot be anything else, as a multiple of the least."""


def _spots_in_range(spots: list[Spot], prepared: Prepared) -> list[Spot]:
    """Spots at a height that the middle line may have, the strongest first.

    Raises:
        FrameError: a clear spot lies outside the calibrated range (22).
    """
    if not spots:
        return spots
    calibration = prepared.calibration
    low, high = calibration.z_range_mm
    middle = calibration.lines // 2
    places = np.array([np.clip(round(s.along_px), 0, calibration.across0_px.shape[1] - 1) for s in spots], np.int64)
    z = heights(calibration, np.full(len(spots), middle), places, np.array([s.across_px for s in spots]))
    reserve = 0.1 * prepared.scale.pitch_px * float(np.nanmedian(np.abs(calibration.a_mm_per_px[:, ::16])))
    inside = [s for s, height in zip(spots, z, strict=True) if low - reserve <= height <= high + reserve]
    least = prepared.search.least_excess if prepared.search else 1.0
    if spots[0].excess > _CLEAR_SPOT * least and (not inside or inside[0].excess < 0.3 * spots[0].excess):
        raise FrameError(
            f"lies at about {z[0]:.1f} mm by the centre spot, outside the calibrated {low:.2f} to {high:.2f} mm",
            cure="check the part's position or calibrate a larger range", code=int(ResultCode.REGISTRATION),
        )  # fmt: skip
    return inside


def _refuse_spot_elsewhere(strip: Image, prepared: Prepared) -> None:
    """A clear spot where this head cannot have it: another head, or the camera has moved.

    Raises:
        FrameError: 22.
    """
    assert prepared.search is not None
    for spot in find_spots(strip, prepared.scale)[:1]:
        if spot.excess > _CLEAR_SPOT * max(prepared.search.least_excess, 0.4):
            row, col = (
                (spot.along_px, spot.across_px) if prepared.calibration.is_vertical else (spot.across_px, spot.along_px)
            )  # fmt: skip
            raise FrameError(
                f"shows the centre spot at row {row:.0f}, column {col:.0f}, where this head cannot have it",
                cure="check that this is the calibrated head, that nothing has moved, and the part's position",
                code=int(ResultCode.REGISTRATION),
            )  # fmt: skip


def _check_whole_comb(found: Fragments, number: I64, calibration: Calibration) -> None:
    """Without a spot the comb must fit from end to end: else all numbers may be shifted alike.

    Raises:
        FrameError: 12.
    """
    size = np.bincount(found.label)
    signal = np.bincount(found.label, weights=found.peaks.signal_dn) / size
    left = (number == NONE) & (signal > 0.4 * float(np.median(found.peaks.signal_dn)))
    known = np.flatnonzero(np.isfinite(calibration.across0_px).any(axis=1))
    has_ends = np.isin(known[[0, -1]], number).all()
    if int(size[left].sum()) > 0.3 * float(size.max()) or not has_ends:
        raise FrameError(
            "shows no centre spot, and the lines alone do not settle their numbers",
            cure="uncover the spot, check the part's position, or mark lines with line_constraints in the recipe",
            code=int(ResultCode.COVERAGE),
        )  # fmt: skip


def _check_against_template(
    number: I64, found: Fragments, spots: list[Spot], gate: Gate, prepared: Prepared
) -> Spot | None:
    """A part one whole pitch too high passes any gate: spot and comb must fit as well.

    Raises:
        FrameError: they do not (22), or neither can be seen (12).
    """
    pitch = prepared.scale.pitch_px
    for spot in spots:
        place = int(np.clip(round(spot.along_px), 0, len(gate.middle_px) - 1))
        near = gate.middle_px[max(place - int(pitch), 0) : place + int(pitch) + 1]
        if not np.isfinite(near).any():
            continue
        off = spot.across_px - float(np.nanmedian(near))
        if abs(off) < 0.55 * pitch:
            return spot
        if prepared.search is not None and spot.excess > _CLEAR_SPOT * prepared.search.least_excess:
            raise FrameError(
                f"shows the centre spot {abs(off) / pitch:.1f} line distances from where the template has it",
                cure="check the part's position and that the template belongs to it", code=int(ResultCode.REGISTRATION),
            )  # fmt: skip
    per_line = gate.expected.sum(axis=1)
    used = np.flatnonzero(per_line > 0.25 * gate.expected.shape[1])
    seen = np.bincount(number[number != NONE], minlength=len(per_line))
    unclaimed = int((number == NONE).sum())
    if len(used) and unclaimed < 0.5 * per_line[used].mean():
        ends = used[[0, -1]]
        if (seen[ends] > 0.6 * per_line[ends]).all():
            return None
    raise FrameError(
        "shows no centre spot, and the lines alone do not settle their numbers",
        cure="uncover the spot and check the part's position", code=int(ResultCode.COVERAGE),
    )  # fmt: skip


@dataclass(frozen=True)
class _Measured:
    points: F32
    sigma_frame_mm: float
    coverage: float
    quality: FrameQuality


def _measured(
    found: Fragments, number: I64, spot: Spot | None, width_px: float | None, prepared: Prepared
) -> _Measured:
    calibration, recipe = prepared.calibration, prepared.recipe
    lines, along_size = calibration.across0_px.shape
    keep = _one_each(number, found, (lines, along_size))
    line, along = number[keep], found.peaks.along[keep].astype(np.int64)
    across = found.peaks.across_px[keep].astype(np.float64)
    z = heights(calibration, line, along, across)
    low, high = calibration.z_range_mm
    with np.errstate(invalid="ignore"):
        valid = (z >= low) & (z <= high)
    if valid.mean() < 0.2:
        raise FrameError(
            f"lies at {float(np.nanmedian(z)):.2f} mm, outside the calibrated {low:.2f} to {high:.2f} mm",
            cure="check the part's position or calibrate a larger range", code=int(ResultCode.REGISTRATION),
        )  # fmt: skip
    outside = float(1.0 - valid.mean())
    keep, line, along, across, z = keep[valid], line[valid], along[valid], across[valid], z[valid]
    slope = np.abs(height_slope(calibration, line, along, across))
    places = _Places(keep, line, along, z, slope)
    if recipe.method == "thesis":
        z, posterior, is_rejected = _filtered_by_thesis(found, places, prepared)
    else:
        z, posterior, is_rejected = _smoothed(found, places, spot, prepared)
    vibration = float(calibration.meta.get("vibration_px", 0.05)) * float(np.median(slope[::19])) if len(slope) else 0.0
    common = float(np.hypot(vibration, float(calibration.meta.get("z_sigma_common_mm", 0.0))))
    sigma = np.sqrt(posterior**2 + calibration.z_sigma_mm[line, along] ** 2 + vibration**2)
    good = np.isfinite(z) & np.isfinite(sigma) & ~is_rejected & (z >= low) & (z <= high)
    if recipe.roi is not None:
        x, y, width, height = recipe.roi
        row, col = (along, across) if calibration.is_vertical else (across, along)
        good &= (col >= x) & (col < x + width) & (row >= y) & (row < y + height)
    order = np.flatnonzero(good)
    row, col = (along, across) if calibration.is_vertical else (across, along)
    points = np.stack([line[order], row[order], col[order], z[order], sigma[order]], axis=1).astype(np.float32)
    expected = prepared.expected
    hit = np.zeros_like(expected)
    hit[line[order], along[order]] = True
    coverage = float((hit & expected).sum() / max(int(expected.sum()), 1))
    if not len(points):
        raise FrameError(
            "shows no measurable point in the region of interest", cure="check the recipe's roi and the part",
            code=int(ResultCode.COVERAGE),
        )  # fmt: skip
    count = np.bincount(line[order], minlength=lines)
    wanted = np.flatnonzero((expected.sum(axis=1) > 0.1 * along_size) | (count > 0))
    quality = describe(
        found,
        Numbered(
            wanted=wanted, missing=wanted[count[wanted] == 0], spot_found=spot is not None, coverage=coverage,
            outside=outside, unnamed=1.0 - len(keep) / max(len(found.peaks), 1),
            pitch_ratio=_pitch_ratio(line, along, across, calibration),
        ),
        calibration.stripe_width_px, width_px,
    )  # fmt: skip
    return _Measured(points, common, coverage, quality)


@dataclass(frozen=True)
class _Places:
    """Numbered points, [n]."""

    keep: I64
    """Their peaks."""
    line: I64
    along: I64
    z_mm: F64
    slope_mm_per_px: F64


def _smoothed(found: Fragments, places: _Places, spot: Spot | None, prepared: Prepared) -> tuple[F64, F64, Bool]:
    """Smoothed heights [mm], their standard uncertainty without what is common to the frame [mm], and outliers."""
    calibration, line, along = prepared.calibration, places.line, places.along
    slope, z = places.slope_mm_per_px, places.z_mm
    texture = _texture_px(found, places.keep, prepared)
    fast = found.sigma_px[places.keep].astype(np.float64)
    shape = calibration.across0_px.shape
    grid_z, grid_sigma = np.full(shape, np.nan), np.full(shape, np.nan)
    label = np.full(shape, -1, np.int64)
    grid_z[line, along] = z
    length = max(found.correlation_px, 1.0)
    streak = float(calibration.meta.get("streak_px", _STREAK_PX))
    spread = _spot_px(found, places, spot, prepared)
    grid_sigma[line, along] = slope * np.sqrt(fast**2 * length + texture**2 * streak + spread**2 * _SPOT_LENGTH_PX)
    label[line, along] = found.label[places.keep]
    point = slope * np.sqrt(fast**2 + texture**2 + spread**2)
    steep = float(np.median(slope[::19])) ** 2
    # The spot's own error must not pass for a bend.
    calm_z = grid_z.copy()
    calm_z[line[spread > 0.0], along[spread > 0.0]] = np.nan
    process = _process_noise(
        calm_z, steep * float(np.median(fast[::19])) ** 2, length, steep * float(np.median(texture[::19])) ** 2,
        streak, prepared.settings.smoothing.reach_px,
    )  # fmt: skip
    starts = _piece_starts(label, grid_z)
    smoothed = smooth(grid_z, grid_sigma, starts, 1.0, process, prepared.settings.smoothing)
    missed = _misfit(grid_z - smoothed.z_mm, float(np.median((slope * fast)[::19])), length)[line, along]
    result = smoothed.z_mm[line, along]
    posterior = np.hypot(np.minimum(smoothed.sigma_mm[line, along], point), missed)
    return result, posterior, np.asarray(np.abs(z - result) > 6.0 * np.hypot(point, missed))


def _filtered_by_thesis(found: Fragments, places: _Places, prepared: Prepared) -> tuple[F64, F64, Bool]:
    """As `_smoothed`, by the thesis' iterations."""
    sigma = rounding_mm(places.slope_mm_per_px, found.sigma_px[places.keep].astype(np.float64))
    grid_z = np.full(prepared.calibration.across0_px.shape, np.nan)
    grid_z[places.line, places.along] = places.z_mm
    filtered = spatial_kalman(grid_z, float(np.median(sigma[::19])), prepared.settings.thesis.iterations)
    return filtered.z_mm[places.line, places.along], sigma, np.zeros(len(sigma), bool)


def _pitch_ratio(line: I64, along: I64, across: F64, calibration: Calibration) -> float:
    """Distance of neighbouring lines over that on the plates, median."""
    grid = np.full(calibration.across0_px.shape, np.nan)
    thin = along % 16 == 0
    grid[line[thin], along[thin]] = across[thin]
    ratio = np.diff(grid[:, ::16], axis=0) / np.diff(calibration.across0_px[:, ::16], axis=0)
    return float(np.nanmedian(ratio)) if np.isfinite(ratio).any() else 1.0


def _one_each(number: I64, found: Fragments, shape: tuple[int, int]) -> I64:
    """Peaks with a number, ordered by line, then along; where two claim one place, the stronger."""
    named = np.flatnonzero(number != NONE)
    place = number[named] * shape[1] + found.peaks.along[named]
    if np.bincount(place, minlength=1).max() > 1:
        rising = np.argsort(found.peaks.signal_dn[named], kind="stable")
        named, place = named[rising], place[rising]
    owner = np.full(shape[0] * shape[1], -1)
    owner[place] = named
    return owner[owner >= 0]


def _texture_px(found: Fragments, keep: I64, prepared: Prepared) -> F64:
    """Error of each position by streaks of the surface: as on the plates, and more in ambient light. [px]"""
    meta = prepared.calibration.meta
    gain = 4.0 * prepared.scale.width_px
    base = float(meta.get("texture_px", 0.0))
    ambient_then = gain * float(meta.get("noise_dn", 0.0)) / max(float(meta.get("signal_dn", 1.0)), 1.0)
    steady = np.sqrt(max(base**2 - ambient_then**2, 0.0))
    signal = np.maximum(found.peaks.signal_dn[keep].astype(np.float64), 1.0)
    return np.asarray(np.hypot(steady, gain * found.peaks.noise_dn / signal))


_SPOT_REACH = 0.75
"""Half the length along the middle line on which the spot's light may lie. [pitch]"""
_SPOT_SHARE = 0.6
_SPOT_LENGTH_PX = 10.0
"""Along the line the spot's own speckle is alike over some of its width. [px]"""


def _spot_px(found: Fragments, places: _Places, spot: Spot | None, prepared: Prepared) -> F64:
    """Error of each position by the light of the centre spot, 0 away from it. [px]

    The spot is a disc many stripes wide, and its middle need not lie on its line: it pulls the centre by a
    share of what it adds to the stripe's width.
    """
    spread = np.zeros(len(places.keep))
    if spot is None:
        return spread
    pitch, peaks = prepared.scale.pitch_px, found.peaks
    near = np.flatnonzero(
        (np.abs(places.along - spot.along_px) < _SPOT_REACH * pitch)
        & (np.abs(peaks.across_px[places.keep] - spot.across_px) < 0.5 * pitch)
    )
    if len(near) < 3:
        return spread
    width = peaks.width_px[places.keep[near]].astype(np.float64)
    size = min(9, len(near))
    padded = np.pad(width, size // 2, mode="edge")
    usual = np.convolve(padded, np.full(size, 1.0 / size), mode="valid")[: len(near)]
    line_width = float(np.median(peaks.width_px[::7]))
    spread[near] = _SPOT_SHARE * np.sqrt(np.maximum(usual**2 - line_width**2, 0.0))
    return spread


def _piece_starts(label: I64, z: F64) -> Bool:
    """(line, along): first point of each piece that the smoother may not cross."""
    starts = np.zeros(label.shape, bool)
    for line in range(label.shape[0]):
        places = np.flatnonzero(np.isfinite(z[line]))
        if len(places):
            owner = label[line, places]
            fresh = np.ones(len(places), bool)
            fresh[1:] = (owner[1:] != owner[:-1]) | (np.diff(places) > 40)
            starts[line, places[fresh]] = True
    return starts


_LAGS = (8, 16, 32, 64, 128)
_CELL = 4
_SURE = 3.0
"""A bend that stands out by this many standard deviations is followed."""


def _process_noise(z: F64, fast_mm2: float, fast_px: float, slow_mm2: float, slow_px: float, reach_px: float) -> F64:
    """Variance that the slope gains per pixel, (line, along), from the surface's own third differences. [mm^2/px^3]

    Differences of means over one lag, so that a bend is found at the scale at which it stands out
    best, on a line for itself or on three neighbours together. A surface whose slope is a random
    walk shows third differences of the variance q lag^3.

    Args:
        z: heights (line, along), NaN = no point. [mm]
        fast_mm2: variance of one point by noise that is alike over ``fast_px``.
        slow_mm2: and by streaks that are alike over ``slow_px``.
        reach_px: length over which a surface that shows no bends is averaged.
    """
    lines, size = z.shape
    cells = size // _CELL
    long_run = fast_mm2 * fast_px + slow_mm2 * slow_px
    process = np.full((lines, cells), long_run / reach_px**4, np.float32)
    # Means over a few pixels say all at these lags.
    whole = z[:, : cells * _CELL].astype(np.float32).reshape(lines, cells, _CELL)
    have = np.isfinite(whole)
    filled = np.where(have, whole, np.float32(0.0)).sum(axis=2)
    weight = have.sum(axis=2, dtype=np.float32)
    for lag in (n for n in _LAGS if 4 * n < size):
        step = lag // _CELL
        count = cv2.boxFilter(weight, -1, (step, 1), normalize=False, borderType=cv2.BORDER_CONSTANT)
        mean = cv2.boxFilter(filled, -1, (step, 1), normalize=False, borderType=cv2.BORDER_CONSTANT)
        mean /= np.maximum(count, 1.0)
        mean[count < 0.6 * lag] = np.nan
        third = mean[:, 3 * step :] - mean[:, : -3 * step]
        third += np.float32(3.0) * (mean[:, step : -2 * step] - mean[:, 2 * step : -step])
        third[np.isnan(third)] = 0.0
        limit = _SURE**2 * 20.0 * (fast_mm2 * min(fast_px / lag, 1.0) + slow_mm2 * min(slow_px / lag, 1.0))
        three = cv2.blur(third, (1, 3), borderType=cv2.BORDER_REPLICATE)
        third *= third
        three *= three
        third[third < limit] = 0.0
        three[three < limit / 3.0] = 0.0
        np.maximum(third, three, out=third)
        if not third.any():
            continue
        # Short bends are sharp and want all of it; long ones are followed as well with less.
        third *= np.float32(min(8.0 / lag, 1.0) / lag**3)
        # A bend lies anywhere within the reach of the difference that shows it.
        widened = cv2.dilate(third, np.ones((1, 2 * step + 1), np.uint8))
        start = 3 * step // 2
        stop = start + widened.shape[1]
        np.maximum(process[:, start:stop], widened, out=process[:, start:stop])
        np.maximum(process[:, :start], widened[:, :1], out=process[:, :start])
        np.maximum(process[:, stop:], widened[:, -1:], out=process[:, stop:])
    full = np.repeat(process, _CELL, axis=1).astype(np.float64)
    return np.pad(full, ((0, 0), (0, size - full.shape[1])), mode="edge")


def _misfit(residual: F64, fast_mm: float, length: float) -> F64:
    """What the smoother leaves of the surface's shape: residuals that are alike over more than noise is. [mm]"""
    have = np.isfinite(residual)
    window = (25, 1)
    count = cv2.blur(have.astype(np.float32), window)
    mean = cv2.blur(np.where(have, residual, 0.0).astype(np.float32), window) / np.maximum(count, 0.05)
    expected = fast_mm**2 * min(length / 25.0, 1.0)
    return np.sqrt(np.maximum(mean.astype(np.float64) ** 2 - 4.0 * expected, 0.0))
