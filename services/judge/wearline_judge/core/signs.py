"""From readings of wear and their trend to the signs that the ladder of alarms looks at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wearline.messages import Decision
from wearline_judge.core.alarms import Signs, bad_in_row
from wearline_judge.core.charts import ewma, nelson, short_term_sigma
from wearline_judge.core.forecast import theil_sen
from wearline_judge.core.trend import Trend

_START = 20
"""Readings after a service that say where the wear starts."""
_NEAR = 30
"""Newest readings that the newest one is held against."""
_LEAST_SIGMA_MM = 0.005
"""No reading is better known than this; a run of equal ones (wear below the precision reads 0) is no proof."""
_GUARD = 1.645
"""One-sided 95 % (ISO 14253-1)."""


def read_signs(strokes: Sequence[int], wears: Sequence[float], trend: Trend, decisions: Sequence[Decision]) -> Signs:
    """What is known of one zone after a stroke.

    Args:
        strokes, wears: readings since the last service, oldest first. [mm]
        trend: fitted to them.
        decisions: of the newest parts, oldest first; empty for a zone, whose parts are not decided apart.
    """
    y = np.asarray(wears, np.float64)
    return Signs(
        has_left_start=_has_left_start(y),
        remaining_p10=trend.remaining_p10,
        is_beyond=(
            trend.limit_mm is not None
            and trend.wear_mm is not None
            and trend.wear_sigma_mm is not None
            and trend.wear_mm - _GUARD * trend.wear_sigma_mm > trend.limit_mm
        ),
        fits_nothing=_fits_nothing(np.asarray(strokes, np.float64), y),
        bad_in_row=bad_in_row(decisions),
    )


def _has_left_start(wears: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> bool:
    if wears.size <= _START:
        return False
    start = wears[:_START]
    sigma = max(short_term_sigma(start), _LEAST_SIGMA_MM)
    chart = ewma(wears, float(np.mean(start)), sigma)
    return bool(chart.average[-1] > chart.upper[-1])


def _fits_nothing(
    strokes: np.ndarray[tuple[int, ...], np.dtype[np.float64]], wears: np.ndarray[tuple[int, ...], np.dtype[np.float64]]
) -> bool:
    """The newest reading against the straight line through those before it (Nelson 1)."""
    x, y = strokes[-_NEAR - 1 : -1], wears[-_NEAR - 1 : -1]
    # Wear that appears at all, after readings of 0, is no outlier: it was below the precision before.
    if x.size < _NEAR or not np.all(y > 0):
        return False
    slope, offset, _ = theil_sen(x, y)
    rest = y - slope * x - offset
    sigma = max(short_term_sigma(rest), float(np.std(rest)), _LEAST_SIGMA_MM)
    newest = np.array([wears[-1] - slope * strokes[-1] - offset])
    return bool(nelson(newest, sigma, (1,)))
