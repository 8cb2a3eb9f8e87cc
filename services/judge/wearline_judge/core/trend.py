"""Wear against the stroke counter since the last service of the die, and what is left until the limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wearline.recipe import Recipe
from wearline_judge.core.line_grid import F64

_FITTED = 200
"""Newest points that the slope is taken from; wear is not straight over a die's whole life."""
_ENOUGH = 8
_SHOWN = 300
_P90 = 1.2816
"""Quantile of the standard normal distribution."""


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


def theil_sen(x: F64, y: F64) -> tuple[float, float, float]:
    """Median slope of all pairs, the median intercept, and the slope's standard uncertainty.

    The uncertainty is that of the least-squares slope with the residuals' robust standard
    deviation, widened for the correlation of neighbouring residuals.
    """
    i, j = np.triu_indices(x.size, 1)
    apart = x[j] != x[i]
    if not apart.any():
        return 0.0, float(np.median(y)), float("inf")
    slope = float(np.median((y[j] - y[i])[apart] / (x[j] - x[i])[apart]))
    offset = float(np.median(y - slope * x))
    rest = y - slope * x - offset
    sigma = max(1.4826 * float(np.median(np.abs(rest))), 1e-6)
    power = float(np.sum(rest[:-1] ** 2))
    alike = float(np.sum(rest[1:] * rest[:-1]) / power) if power > 0 else 0.0
    alike = min(max(alike, 0.0), 0.9)
    spread = float(np.sum((x - x.mean()) ** 2))
    # A Theil-Sen slope has about 91 % of the efficiency of least squares on normal residuals.
    return slope, offset, sigma / np.sqrt(0.91 * spread) * np.sqrt((1 + alike) / (1 - alike))


def wear_trend(strokes: Sequence[int], wears: Sequence[float], limit_mm: float | None) -> Trend:
    """Fit the newest points.

    Args:
        strokes: stroke counter, in any order, since the last die event.
        wears: 0 while nothing deviates significantly. [mm]
        limit_mm: wear that fails a part; None = no forecast.
    """
    if not strokes:
        return Trend(limit_mm=limit_mm)
    order = np.argsort(np.asarray(strokes), kind="stable")
    x, y = np.asarray(strokes, np.float64)[order], np.asarray(wears, np.float64)[order]
    step = -(-x.size // _SHOWN)
    keep = slice((x.size - 1) % step, None, step)
    points = tuple((int(s), float(w)) for s, w in zip(x[keep], y[keep], strict=True))
    # Wear below the precision reads 0: those points say nothing about the slope.
    shown = np.flatnonzero(y > 0)
    if shown.size < _ENOUGH:
        return Trend(points=points, wear_mm=float(np.median(y[-5:])), limit_mm=limit_mm)
    x, y = x[shown[-_FITTED:]], y[shown[-_FITTED:]]
    slope, offset, sigma = theil_sen(x, y)
    level = slope * float(x[-1]) + offset
    remaining: tuple[float | None, ...] = (None, None, None)
    if limit_mm is not None and np.isfinite(sigma) and slope > 2.0 * sigma:
        left = max(limit_mm - level, 0.0)
        remaining = (left / (slope + _P90 * sigma), left / slope, left / (slope - _P90 * sigma))
    is_known = bool(np.isfinite(sigma))
    return Trend(
        points=points,
        wear_mm=level,
        slope_mm_per_kilostroke=1e3 * slope if is_known else None,
        slope_sigma=1e3 * float(sigma) if is_known else None,
        limit_mm=limit_mm,
        remaining_p10=remaining[0],
        remaining_p50=remaining[1],
        remaining_p90=remaining[2],
    )
