"""From a comparison to PASSED, FAILED, UNSURE or NOT_MEASURED, with the reason in words.

A recipe's limits decide where it has any; without one, any significant region fails the part.
OK is proven: what was not seen is never Passed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wearline.messages import Decision, ResultCode, ZoneResult
from wearline.recipe import Limits, Recipe
from wearline_judge.core.comparison import Comparison
from wearline_judge.core.line_grid import Bool


@dataclass(frozen=True)
class Figures:
    """What the limits are held against, for the part or one zone of it."""

    mean_error_mm: float = 0.0
    mean_sigma_mm: float = 0.0
    max_error_mm: float = 0.0
    """Signed. [mm]"""
    max_sigma_mm: float = 0.0
    profile_mm: float = 0.0
    """Profile of the surface in the style of ISO 1101: twice the largest absolute deviation. [mm]"""
    area_mm2: float | None = 0.0
    area_px: float = 0.0
    wear_mm: float = 0.0
    coverage: float = 0.0


@dataclass(frozen=True)
class Ruling:
    """The decision; `code` is what the PLC is told."""

    decision: Decision
    code: ResultCode
    reason: str


_WELL_KNOWN = 2.0
"""The largest deviation is sought among cells whose uncertainty is at most this multiple of the usual one."""


def figures(comparison: Comparison, within: Bool | None, mm_per_pixel: float | None) -> Figures:
    """Figures over the significant regions, of the whole part or the cells `within` a zone.

    The profile deviation looks at all compared cells; where nothing deviates, so does the largest error.
    """
    inside = np.ones(comparison.label.shape, bool) if within is None else within
    expected, seen = float(comparison.expected[inside].sum()), float(comparison.seen[inside].sum())
    coverage = seen / expected if expected else 0.0
    at = inside & (comparison.label > 0)
    compared = inside & np.isfinite(comparison.deviation_mm) & np.isfinite(comparison.sigma_mm)
    area_unit = mm_per_pixel**2 if mm_per_pixel else None
    highest, highest_sigma = 0.0, 0.0
    if compared.any():
        # One cell on a steep wall may be off by its own large uncertainty: that is no profile of the part.
        usual = float(np.median(comparison.sigma_mm[compared]))
        known = compared & ((comparison.sigma_mm <= _WELL_KNOWN * usual) | at)
        values, sigmas = comparison.deviation_mm[known], comparison.sigma_mm[known]
        peak = int(np.argmax(np.abs(values)))
        highest, highest_sigma = float(values[peak]), float(sigmas[peak])
    if not at.any():
        return Figures(
            max_error_mm=highest,
            max_sigma_mm=highest_sigma,
            profile_mm=2.0 * abs(highest),
            area_mm2=0.0 if area_unit else None,
            coverage=coverage,
        )
    values, sigmas, area = comparison.deviation_mm[at], comparison.sigma_mm[at], comparison.area_px[at]
    peak = int(np.argmax(np.abs(values)))
    sizes = np.bincount(comparison.label[at], weights=area)
    largest = np.abs(values)[comparison.label[at] == int(np.argmax(sizes))]
    return Figures(
        mean_error_mm=float(np.sum(np.abs(values) * area) / np.sum(area)),
        mean_sigma_mm=comparison.mean_sigma(at),
        max_error_mm=float(values[peak]),
        max_sigma_mm=float(sigmas[peak]),
        profile_mm=2.0 * abs(highest),
        area_mm2=float(area.sum()) * area_unit if area_unit else None,
        area_px=float(area.sum()),
        wear_mm=float(np.percentile(largest, 95)),
        coverage=coverage,
    )


def _beyond(found: Figures, limits: Limits, guard: float) -> tuple[list[str], list[str]]:
    """Sentences on limits that are broken for certain, and on those inside the guard band."""
    broken: list[str] = []
    unsure: list[str] = []
    checks = (
        ("mean error", found.mean_error_mm, found.mean_sigma_mm, limits.mean_error_mm, "mm"),
        ("maximum error", abs(found.max_error_mm) if found.area_px else 0.0, found.max_sigma_mm,
         limits.max_error_mm, "mm"),
        ("deviating area", found.area_mm2, 0.0, limits.area_mm2, "mm2"),
    )  # fmt: skip
    for name, value, sigma, limit, unit in checks:
        if limit is None:
            continue
        if value is None:
            broken.append(f"{name} is limited but there is no lateral scale (set mm_per_pixel)")
            continue
        digits = 3 if unit == "mm" else 1
        sentence = f"{name} {value:.{digits}f} {unit}, limit {limit:g} {unit}"
        if found.area_px and abs(value - limit) <= guard * sigma:
            unsure.append(sentence)
        elif value > limit:
            broken.append(sentence)
    return broken, unsure


def has_limits(recipe: Recipe) -> bool:
    """Whether the recipe limits anything."""
    return any(
        v is not None
        for section in (recipe.limits, *(z.limits for z in recipe.zones))
        for v in (section.mean_error_mm, section.max_error_mm, section.area_mm2)
    )


def zone_result(name: str, found: Figures, limits: Limits, recipe: Recipe) -> ZoneResult:
    """One zone as reported; within = nothing broken for certain and seen well enough."""
    broken, unsure = _beyond(found, limits, recipe.guard_band)
    is_seen = found.coverage >= recipe.coverage_min
    return ZoneResult(
        name=name,
        mean_error_mm=found.mean_error_mm if is_seen else None,
        max_error_mm=found.max_error_mm if is_seen else None,
        area_mm2=found.area_mm2 if is_seen else None,
        wear_mm=found.wear_mm if is_seen else None,
        profile_mm=found.profile_mm if is_seen else None,
        coverage=found.coverage,
        is_within=is_seen and not broken and not unsure,
    )


def decide(part: Figures, zones: Sequence[tuple[str, Figures, Limits]], regions: int, recipe: Recipe) -> Ruling:
    """Rule on one part.

    Args:
        part: figures of the whole part.
        zones: name, figures and limits of each zone.
        regions: number of significant regions.
        recipe: its limits, guard band, coverage and mapping of UNSURE.
    """
    for name, found in (("part", part), *((f"zone {n}", f) for n, f, _ in zones)):
        if not found.coverage >= recipe.coverage_min:
            return Ruling(
                Decision.NOT_MEASURED, ResultCode.COVERAGE,
                f"{name} was seen to {100 * found.coverage:.0f} %, {100 * recipe.coverage_min:.0f} % are needed",
            )  # fmt: skip
    broken, unsure = _beyond(part, recipe.limits, recipe.guard_band)
    for name, found, limits in zones:
        more_broken, more_unsure = _beyond(found, limits, recipe.guard_band)
        broken += [f"zone {name}: {s}" for s in more_broken]
        unsure += [f"zone {name}: {s}" for s in more_unsure]
    if not has_limits(recipe) and regions:
        broken.append(
            f"{regions} region{'s' if regions > 1 else ''} beyond {recipe.precision_mm:g} mm, "
            f"mean error {part.mean_error_mm:.3f} mm"
        )
    if broken:
        return Ruling(Decision.FAILED, ResultCode.FAILED, "; ".join(broken))
    if unsure:
        if recipe.unsure_as == "PASSED":
            return Ruling(
                Decision.UNSURE, ResultCode.PASSED, f"inside the guard band, taken as PASSED: {'; '.join(unsure)}"
            )
        return Ruling(Decision.UNSURE, ResultCode.UNSURE, f"inside the guard band: {'; '.join(unsure)}")
    text = f"mean error {part.mean_error_mm:.3f} mm is within limits" if regions else "nothing deviates"
    return Ruling(Decision.PASSED, ResultCode.PASSED, text)
