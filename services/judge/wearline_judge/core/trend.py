"""Wear against the stroke counter since the last service of the die, and what is left until the limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wearline.recipe import Recipe
from wearline_judge.core.forecast import forecast

_FITTED = 200
"""Newest points that say how wear and mean error go together."""
_SHOWN = 300


@dataclass(frozen=True)
class Trend:
    """Figures of one wear trend; None = not identifiable."""

    points: tuple[tuple[int, float], ...] = ()
    """(stroke, wear_mm), decimated."""
    wear_mm: float | None = None
    """Level at the newest stroke, from the fit where there is one. [mm]"""
    slope_mm_per_kilostroke: float | None = None
    slope_sigma: float | None = None
    limit_mm: float | None = None
    remaining_p10: float | None = None
    remaining_p50: float | None = None
    remaining_p90: float | None = None
    wear_sigma_mm: float | None = None
    """Standard uncertainty of wear_mm; None without a fit. [mm]"""
    jumps: tuple[tuple[int, float], ...] = ()
    """(stroke, size in mm) of sudden changes."""


def wear_limit(recipe: Recipe, mean_errors: Sequence[float], wears: Sequence[float]) -> float:
    """The wear at which the recipe's limit is reached. [mm]

    A limit on the largest error holds for the wear itself. One on the mean error is carried over by
    the usual ratio of wear to mean error; without any limit the precision is what fails a part.
    """
    if recipe.limits.max_error_mm is not None:
        return recipe.limits.max_error_mm
    if recipe.limits.mean_error_mm is None:
        return recipe.precision_mm
    ratios = [w / m for w, m in zip(wears, mean_errors, strict=True) if m > 0 and w > 0]
    ratio = float(np.median(ratios[-_FITTED:])) if ratios else 1.0
    return recipe.limits.mean_error_mm * ratio


def wear_trend(
    strokes: Sequence[int],
    wears: Sequence[float],
    limit_mm: float | None,
    start: int | None = None,
    coils: Sequence[int] = (),
) -> Trend:
    """Fit one service interval.

    Args:
        strokes: stroke counter, in any order, since the last service.
        wears: 0 while nothing deviates significantly. [mm]
        limit_mm: wear that fails a part; None = no forecast.
        start: stroke of the service; None = the first one given.
        coils: strokes at which the coil was changed since then.
    """
    if not strokes:
        return Trend(limit_mm=limit_mm)
    order = np.argsort(np.asarray(strokes), kind="stable")
    x, y = np.asarray(strokes, np.float64)[order], np.asarray(wears, np.float64)[order]
    step = -(-x.size // _SHOWN)
    keep = slice((x.size - 1) % step, None, step)
    points = tuple((int(s), float(w)) for s, w in zip(x[keep], y[keep], strict=True))
    found = forecast(strokes, wears, limit_mm, start, coils)
    if found is None:
        return Trend(points=points, wear_mm=float(np.median(y[-5:])), limit_mm=limit_mm)
    is_known = bool(np.isfinite(found.slope_sigma))
    return Trend(
        points=points,
        wear_mm=found.level_mm,
        slope_mm_per_kilostroke=1e3 * found.slope_mm_per_stroke if is_known else None,
        slope_sigma=1e3 * found.slope_sigma if is_known else None,
        limit_mm=limit_mm,
        remaining_p10=found.remaining_p10,
        remaining_p50=found.remaining_p50,
        remaining_p90=found.remaining_p90,
        wear_sigma_mm=found.level_sigma_mm,
        jumps=tuple((jump.stroke, jump.size_mm) for jump in found.jumps),
    )
