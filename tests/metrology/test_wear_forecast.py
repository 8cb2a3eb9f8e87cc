"""The short form of ``make wear-forecast``."""

from __future__ import annotations

import numpy as np
import pytest

from tests.metrology.wear_series import HOLD_OUT, METHODS, coverage, warnings


def test_forecasts_keep_their_promise_and_a_straight_line_does_not() -> None:
    seeds = range(HOLD_OUT, HOLD_OUT + 120)
    ours, line = coverage(METHODS["wearline"], seeds), coverage(METHODS["straight line"], seeds)
    assert ours.answered > 0.7 * ours.asked
    # Of about 100 answers: 80 % within three standard deviations.
    assert 0.68 < ours.share < 0.92
    assert line.share < 0.4
    assert abs(float(np.median(ours.log_errors))) < 0.2


def test_warnings_come_in_time() -> None:
    seeds = range(HOLD_OUT, HOLD_OUT + 12)
    ours, average = warnings(METHODS["wearline"], seeds, every=25), warnings(METHODS["EWMA at 80 %"], seeds, every=25)
    assert sum(lead == 0.0 for lead in ours.leads) <= 1
    assert float(np.median(ours.leads)) > 400.0
    assert ours.per_kilostroke < 0.1
    assert float(np.percentile(ours.leads, 10)) > float(np.percentile(average.leads, 10))


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_thousand_dies() -> None:
    ours = coverage(METHODS["wearline"], range(HOLD_OUT, HOLD_OUT + 1000))
    assert 0.75 < ours.share < 0.85
