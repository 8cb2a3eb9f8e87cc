"""Golden frames to a template: mean and spread of registered heights, coverage, and the frame that does not fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wearline.artifact import F32, Calibration, Template
from wearline.errors import TemplateError
from wearline.messages import LinePoints
from wearline.recipe import Recipe
from wearline.surface import dense_map
from wearline_judge.core.comparison import Comparison, compare, point_deviation
from wearline_judge.core.golden import Golden, camera_distance_mm, make_golden
from wearline_judge.core.judgement import JudgingSettings, make_setup
from wearline_judge.core.line_grid import F64, LineGrid, line_grid
from wearline_judge.core.registration import out_of_pose

_CURE = "leave it out or take it again"
_ENOUGH_TO_BLAME = 3
"""Of two frames that differ, nobody knows which one is wrong."""


@dataclass(frozen=True)
class Sample:
    """One golden frame and what it is called."""

    name: str
    points: LinePoints


@dataclass(frozen=True)
class _Mean:
    z_mm: F64
    across_px: F64
    sigma_mm: F64
    spread_mm: F64
    coverage: F64


def _across_of(calibration: Calibration, z_mm: F64) -> F64:
    """(line, along): where a line lies at these heights; the inverse of z = a d / (1 + b d). [px]"""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(calibration.across0_px + z_mm / (calibration.a_mm_per_px - calibration.b_per_px * z_mm))


def _meaned(heights: F64, sigmas: F64, calibration: Calibration, is_median: bool) -> _Mean:
    """Over the samples (sample, line, along)."""
    count = np.isfinite(heights).sum(axis=0)
    seen = count > 0
    filled = np.where(seen, heights, 0.0)
    mean = np.where(seen, np.nanmedian(filled, axis=0) if is_median else np.nanmean(filled, axis=0), np.nan)
    variance = np.nansum(np.where(np.isfinite(heights), sigmas**2, 0.0), axis=0)
    off = filled - mean
    if is_median:
        # One bad frame must not widen what it is held against; of two nobody knows the spread.
        spread = np.where(count >= _ENOUGH_TO_BLAME, 1.4826 * np.nanmedian(np.where(seen, np.abs(off), 0.0), axis=0), 0)
    else:
        spread = np.where(count >= 2, np.sqrt(np.nansum(off**2, axis=0) / np.maximum(count - 1, 1)), 0.0)
    return _Mean(
        z_mm=mean,
        across_px=_across_of(calibration, mean),
        sigma_mm=np.where(seen, np.sqrt(variance) / np.maximum(count, 1), np.nan),
        spread_mm=np.where(seen, spread, np.nan),
        coverage=count / heights.shape[0],
    )


def _template(
    mean: _Mean, calibration: Calibration, calibration_hash: str, recipe: Recipe, recipe_hash: str, frames: int,
    meta: dict[str, Any],
) -> Template:  # fmt: skip
    rows, cols = (int(v) for v in calibration.image_shape)
    line, along = np.nonzero(np.isfinite(mean.z_mm) & np.isfinite(mean.across_px))
    across = mean.across_px[line, along]
    row, col = (along, across) if calibration.is_vertical else (across, along)
    points = np.column_stack([line, row, col, mean.z_mm[line, along], mean.sigma_mm[line, along]]).astype(np.float32)
    surface = dense_map(points, (rows, cols), is_vertical=calibration.is_vertical, roi=clipped(recipe, rows, cols))

    def stored(values: F64) -> F32:
        return values.astype(np.float32)

    return Template(
        meta=meta,
        line_across_px=stored(mean.across_px),
        line_z_mm=stored(mean.z_mm),
        line_sigma_mm=stored(mean.sigma_mm),
        line_spread_mm=stored(mean.spread_mm),
        line_coverage=stored(mean.coverage),
        z_map_mm=surface.z_mm,
        roi=surface.roi,
        calibration_hash=calibration_hash,
        recipe_hash=recipe_hash,
        frames=frames,
    )


def clipped(recipe: Recipe, rows: int, cols: int) -> tuple[int, int, int, int]:
    """The recipe's ROI on this sensor: x, y, width, height. [px]

    Raises:
        TemplateError: it lies outside the sensor.
    """
    x, y, width, height = recipe.roi or (0, 0, cols, rows)
    left, top, right, bottom = max(x, 0), max(y, 0), min(x + width, cols), min(y + height, rows)
    if right <= left or bottom <= top:
        raise TemplateError(f"its roi {recipe.roi} lies outside the {cols} x {rows} sensor", "recipe", "mend the roi")
    return left, top, right - left, bottom - top


_SUSPICION = 6.5
"""Standard uncertainties by which a region of a golden frame must stand out to be suspicious. More than a part
is failed for: streaks of the sheet reach five on one good frame of fifty, and the frame need not be good to a limit
but alike the others."""


def teach(
    samples: Sequence[Sample],
    calibration: Calibration,
    calibration_hash: str,
    recipe: Recipe,
    recipe_hash: str,
    settings: JudgingSettings,
) -> Template:
    """Make a template.

    Heights are averaged after each frame's rigid motion against the others was taken away; the pose
    is that of the first frame. Each frame is held against the median of all, so that one bad frame
    cannot spoil what the others are held against.

    Raises:
        TemplateError: a frame that cannot be measured, that shows too little, or that deviates from
            the others; its name and the reason are in the text.
    """
    if not samples:
        raise TemplateError("no golden frame was given", "template", "name one or more frames of good parts")
    if calibration.is_vertical != (recipe.orientation == "vertical"):
        raise TemplateError(
            f"the recipe's lines are {recipe.orientation}, the calibration's are not", "template", "mend orientation"
        )
    for sample in samples:
        if sample.points.refusal_code or not len(sample.points.points):
            raise TemplateError(sample.points.refusal or "no laser line was seen", sample.name, _CURE)
    lines, along = calibration.a_mm_per_px.shape
    parts = [line_grid(s.points.points, lines, along, calibration.is_vertical) for s in samples]
    _check_seen(samples, parts, recipe)
    sigmas = np.stack([p.sigma_mm for p in parts])
    scale = calibration.mm_per_pixel if np.isfinite(calibration.mm_per_pixel) else recipe.mm_per_pixel
    distance = camera_distance_mm(calibration)
    meta: dict[str, Any] = {
        "is_vertical": bool(calibration.is_vertical),
        "mm_per_pixel": float(scale) if scale else None,
        "camera_distance_mm": distance if np.isfinite(distance) else None,
        "samples": [s.name for s in samples],
        "sigma_frame_mm": float(np.mean([s.points.sigma_frame_mm for s in samples])),
    }

    def made(mean: _Mean) -> Template:
        return _template(mean, calibration, calibration_hash, recipe, recipe_hash, len(samples), meta)

    mean = _meaned(parts[0].z_mm[None], sigmas[:1], calibration, is_median=False)
    for turn in range(2 if len(samples) > 1 else 0):
        template = made(mean)
        golden = make_golden(template, recipe.mm_per_pixel)
        found = [_compared(golden, sample.points, recipe, settings) for sample in samples]
        if turn == 1:
            _check_fit(samples, found, settings, bool(scale))
        heights = np.stack([_aligned(golden, part, c) for part, c in zip(parts, found, strict=True)])
        mean = _meaned(heights, sigmas, calibration, is_median=turn == 0)
    return made(mean)


def _compared(golden: Golden, points: LinePoints, recipe: Recipe, settings: JudgingSettings) -> Comparison:
    setup = make_setup(golden, recipe)
    comparison = settings.comparison.model_copy(update={"region_existence": _SUSPICION})
    return compare(
        golden, setup.cells, points.points, setup.precision_mm, recipe.area_floor_mm2, setup.datum,
        points.sigma_frame_mm, comparison, settings.registration,
    )  # fmt: skip


def _aligned(golden: Golden, part: LineGrid, comparison: Comparison) -> F64:
    """Heights in the pose of the template; where it has none yet, as measured but for the motion in height."""
    away = part.z_mm - comparison.motion.dz_mm
    return np.where(golden.is_expected, golden.z_mm + point_deviation(golden, part, comparison.motion), away)


def _check_seen(samples: Sequence[Sample], parts: Sequence[LineGrid], recipe: Recipe) -> None:
    seen = np.stack([p.is_seen for p in parts])
    usual = seen.mean(axis=0) >= 0.5
    for sample, own in zip(samples, seen, strict=True):
        share = float((own & usual).sum() / max(int(usual.sum()), 1))
        if share < recipe.coverage_min:
            raise TemplateError(
                f"shows {100 * share:.0f} % of what the others show, {100 * recipe.coverage_min:.0f} % are needed",
                sample.name, _CURE,
            )  # fmt: skip


def _check_fit(
    samples: Sequence[Sample], found: Sequence[Comparison], settings: JudgingSettings, is_in_mm: bool
) -> None:
    """Against the median of all."""
    for sample, comparison in zip(samples, found, strict=True):
        if (why := out_of_pose(comparison.motion, settings.registration, is_in_mm)) is not None:
            raise TemplateError(f"is suspicious: {why}", sample.name, _CURE)
    suspects = [(c.regions[0], s) for s, c in zip(samples, found, strict=True) if c.regions]
    if not suspects:
        return
    worst, sample = max(suspects, key=lambda pair: pair[0].mean_mm * pair[0].area_px)
    size = f"{worst.area_mm2:.0f} mm2" if worst.area_mm2 is not None else f"{worst.area_px} px"
    place = f"over {size} about x {worst.col_px:.0f}, y {worst.row_px:.0f} px"
    if len(samples) < _ENOUGH_TO_BLAME:
        raise TemplateError(
            f"is suspicious: the two golden frames differ by {2.0 * worst.mean_mm:.3f} mm {place}", sample.name,
            "take a third one, so that the wrong one can be told",
        )  # fmt: skip
    raise TemplateError(
        f"is suspicious: it deviates from the other golden frames by {worst.mean_mm:.3f} mm {place}", sample.name, _CURE
    )
