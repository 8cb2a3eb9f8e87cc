"""Line points and a template to a whole verdict and the maps for the eye: the one path, live and offline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from wearline.config import Settings
from wearline.messages import Decision, LinePoints, RegistrationResult, ResultCode
from wearline.recipe import Recipe
from wearline_judge.core.comparison import (
    Comparison,
    ComparisonSettings,
    TemplateCells,
    compare,
    polygon_mask,
    template_cells,
)
from wearline_judge.core.decision import Figures, decide, figures, zone_result
from wearline_judge.core.golden import Golden
from wearline_judge.core.line_grid import F64, Bool
from wearline_judge.core.registration import Motion, RegistrationSettings, out_of_pose


class JudgingSettings(Settings):
    """Of the comparison itself; limits belong to the recipe."""

    comparison: ComparisonSettings = ComparisonSettings()
    registration: RegistrationSettings = RegistrationSettings()


@dataclass(frozen=True)
class Setup:
    """A template and a recipe made ready for each other; made once for each pair."""

    golden: Golden
    recipe: Recipe
    cells: TemplateCells
    precision_mm: F64
    """(line, block). [mm]"""
    datum: Bool | None
    zones: tuple[tuple[str, Bool], ...]


def make_setup(golden: Golden, recipe: Recipe) -> Setup:
    """Lay the recipe's ROI and zones on the template's line grid."""
    inside = None
    if recipe.roi is not None:
        left, top, width, height = recipe.roi
        px, py = golden.x_px, golden.y_px
        with np.errstate(invalid="ignore"):
            inside = (px >= left) & (px < left + width) & (py >= top) & (py < top + height)
    cells = template_cells(golden, inside)
    x, y = cells.x_px, cells.y_px
    zones = tuple((zone.name, polygon_mask(zone, x, y)) for zone in recipe.zones)
    precision = np.full(x.shape, recipe.precision_mm)
    for zone, (_, mask) in zip(recipe.zones, zones, strict=True):
        if zone.precision_mm is not None:
            precision[mask] = zone.precision_mm
    datum = None
    if recipe.datum_zones:
        datum = np.zeros(x.shape, bool)
        for zone in recipe.datum_zones:
            datum |= polygon_mask(zone, x, y)
    return Setup(golden, recipe, cells, precision, datum, zones)


@dataclass(frozen=True)
class Judgement:
    """The verdict's fields that the comparison gives, and the comparison for the view."""

    fields: dict[str, Any]
    comparison: Comparison | None = None


def refused(code: int, reason: str) -> Judgement:
    """A part that cannot be judged."""
    return Judgement({"decision": Decision.NOT_MEASURED, "code": int(code), "reason": reason})


def _registration(motion: Motion, is_in_mm: bool, has_datum: bool) -> RegistrationResult:
    return RegistrationResult(
        dz_mm=motion.dz_mm,
        tilt_x_mrad=1e3 * motion.tilt_x,
        tilt_y_mrad=1e3 * motion.tilt_y,
        dx_mm=motion.dx if is_in_mm else 0.0,
        dy_mm=motion.dy if is_in_mm else 0.0,
        turn_mrad=1e3 * motion.turn,
        undetermined=motion.undetermined if is_in_mm else ("dx_mm", "dy_mm"),
        datum="zones" if has_datum else "best fit",
    )


def judge_points(measured: LinePoints, setup: Setup, settings: JudgingSettings) -> Judgement:
    """Judge one part.

    Without a lateral scale a tilt is reported per pixel (1 mrad = 0.001 mm per px) and an in-plane
    shift, though removed, is not reported.
    """
    golden, recipe = setup.golden, setup.recipe
    if measured.refusal_code:
        return refused(measured.refusal_code, measured.refusal)
    if not len(measured.points):
        return refused(ResultCode.COVERAGE, "no laser line was seen")
    comparison = compare(
        golden, setup.cells, measured.points, setup.precision_mm, recipe.area_floor_mm2, setup.datum,
        measured.sigma_frame_mm, settings.comparison, settings.registration,
    )  # fmt: skip
    scale = golden.mm_per_pixel

    def of(mask: Bool | None) -> Figures:
        return figures(comparison, mask, scale)

    whole = of(None)
    zones = [(name, of(mask), zone.limits) for zone, (name, mask) in zip(recipe.zones, setup.zones, strict=True)]
    results = tuple(zone_result(name, found, limits, recipe) for name, found, limits in zones)
    registration = _registration(comparison.motion, scale is not None, setup.datum is not None)
    always = {"coverage": whole.coverage, "zones": results, "registration": registration}
    ruling = decide(whole, zones, len(comparison.regions), recipe)
    if ruling.code is not ResultCode.COVERAGE:
        why = out_of_pose(comparison.motion, settings.registration, scale is not None)
        if why:
            return Judgement({**refused(ResultCode.REGISTRATION, why).fields, **always}, comparison)
    fields = {"decision": ruling.decision, "code": int(ruling.code), "reason": ruling.reason, **always}
    if ruling.decision is not Decision.NOT_MEASURED:
        fields |= {
            "mean_error_mm": whole.mean_error_mm,
            "max_error_mm": whole.max_error_mm,
            "wear_mm": whole.wear_mm,
            "profile_mm": whole.profile_mm,
            "deviating_area_mm2": whole.area_mm2,
            "deviating_area_px": round(whole.area_px),
            "regions": comparison.regions,
        }
    return Judgement(fields, comparison)
