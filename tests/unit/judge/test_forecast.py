"""Forecasts on records whose future is known."""

from __future__ import annotations

import numpy as np
import pytest

from wearline_judge.core.forecast import ForecastSettings, find_jumps, forecast, intervals, tell_drift, theil_sen
from wearline_judge.core.trend import wear_trend


def record(exponent: float, life: float, limit: float, until: float, noise: float, seed: int,
           start: int = 0) -> tuple[list[int], list[float]]:  # fmt: skip
    """Readings of w = limit (n / life)^p up to a share of the life."""
    rng = np.random.default_rng(seed)
    n = np.linspace(life / 300, until * life, 300)
    wear = limit * (n / life) ** exponent + rng.normal(0.0, noise, n.size)
    return [start + round(float(v)) for v in n], [float(w) if w > 0.05 else 0.0 for w in wear]


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.4])
@pytest.mark.parametrize("start", [0, 120_000])
def test_straight_and_curved_wear_is_forecast(exponent: float, start: int) -> None:
    strokes, wears = record(exponent, 5000.0, 0.25, 0.75, 0.005, 5, start)
    found = forecast(strokes, wears, 0.25, start)
    assert found is not None and found.is_identifiable
    assert found.remaining_p10 is not None and found.remaining_p50 is not None and found.remaining_p90 is not None
    assert found.remaining_p10 < 1250.0 < found.remaining_p90
    assert 0.75 < found.remaining_p50 / 1250.0 < 1.35
    slope = 0.25 * exponent * 0.75 ** (exponent - 1.0) / 5000.0
    assert found.slope_mm_per_stroke == pytest.approx(slope, rel=0.25)
    assert found.level_mm == pytest.approx(0.25 * 0.75**exponent, abs=0.006)
    assert found.noise_mm == pytest.approx(0.005, rel=0.3)


def test_a_die_that_does_not_wear_has_no_forecast() -> None:
    rng = np.random.default_rng(6)
    for seed in range(20):
        wears = 0.1 + np.random.default_rng([6, seed]).normal(0.0, 0.01, 200)
        found = forecast(list(range(200)), wears.tolist(), 0.3)
        assert found is not None and not found.is_identifiable, seed
        assert (found.remaining_p10, found.remaining_p90) == (None, None)
    assert forecast(list(range(50)), [0.0] * 50, 0.3) is None
    assert forecast([], [], 0.3) is None
    # Below three standard uncertainties of the slope nothing is said, far above it something is.
    x = np.arange(400)
    shown = [
        (f := forecast(x.tolist(), (0.1 + b * x + rng.normal(0, 0.01, 400)).tolist(), 0.3)) is not None
        and f.is_identifiable
        for b in (2e-6, 2e-4)
    ]
    assert shown == [False, True]


def test_wear_at_its_limit_has_no_strokes_left() -> None:
    strokes, wears = record(1.0, 1000.0, 0.2, 1.3, 0.003, 7)
    found = forecast(strokes, wears, 0.2, 0)
    assert found is not None and found.remaining_p50 == 0.0 and found.remaining_p10 == 0.0


def test_outliers_do_not_move_the_slope() -> None:
    strokes, wears = record(1.0, 5000.0, 0.25, 0.8, 0.004, 8)
    spoiled = [w + 0.2 if k % 11 == 0 else w for k, w in enumerate(wears)]
    clean, dirty = forecast(strokes, wears, 0.25, 0), forecast(strokes, spoiled, 0.25, 0)
    assert clean is not None and dirty is not None
    assert dirty.slope_mm_per_stroke == pytest.approx(clean.slope_mm_per_stroke, rel=0.12)


def test_a_chip_is_found_dated_and_sized() -> None:
    strokes, wears = record(1.0, 5000.0, 0.25, 0.8, 0.004, 9)
    chipped = [w + 0.04 if s >= 2600 and w > 0 else w for s, w in zip(strokes, wears, strict=True)]
    found = forecast(strokes, chipped, 0.35, 0)
    assert found is not None
    (jump,) = found.jumps
    assert abs(jump.stroke - 2600) <= 5 * 14
    assert jump.size_mm == pytest.approx(0.04, abs=4 * jump.sigma_mm)
    # The slope does not take the chip for wear.
    assert found.slope_mm_per_stroke == pytest.approx(0.25 / 5000.0, rel=0.25)


def test_steady_noise_and_curved_wear_hold_no_jump() -> None:
    for seed in range(30):
        for exponent in (0.6, 1.0, 1.9):
            strokes, wears = record(exponent, 5000.0, 0.3, 0.9, 0.006, 900 + seed)
            shown = np.array(wears) > 0
            x, y = np.array(strokes, float)[shown], np.array(wears)[shown]
            assert find_jumps(x, y, ForecastSettings()) == (), (seed, exponent)


def test_services_restart_the_trend_and_coils_do_not() -> None:
    strokes = list(range(0, 100, 10))
    wears = [float(s) for s in strokes]
    events = [(20, "coil_change"), (35, "regrind"), (60, "coil_change"), (70, "die_change")]
    first, second, third = intervals(strokes, wears, events)
    assert (first.start, first.began, first.strokes, first.coils) == (0, "", (0, 10, 20, 30), (20,))
    assert (second.start, second.began, second.strokes, second.coils) == (35, "regrind", (40, 50, 60), (60,))
    assert (third.start, third.began, third.strokes) == (70, "die_change", (70, 80, 90))
    assert third.wears == (70.0, 80.0, 90.0)
    (only,) = intervals(strokes, wears, [])
    assert only.strokes == tuple(strokes)
    # A service at the very first stroke leaves no empty interval before it; one after the last begins a new one.
    assert [i.start for i in intervals(strokes, wears, [(0, "regrind"), (200, "polish")])] == [0, 200]
    assert intervals([], [], []) == ()


def test_the_records_answer_carries_the_forecast() -> None:
    strokes, wears = record(1.0, 5000.0, 0.25, 0.8, 0.004, 10, start=7000)
    trend = wear_trend(strokes, wears, 0.25, 7000)
    found = forecast(strokes, wears, 0.25, 7000)
    assert found is not None
    assert (trend.remaining_p10, trend.remaining_p50, trend.remaining_p90) == (
        found.remaining_p10, found.remaining_p50, found.remaining_p90,
    )  # fmt: skip
    assert trend.slope_mm_per_kilostroke == pytest.approx(1e3 * found.slope_mm_per_stroke)
    assert trend.points[-1][0] == strokes[-1]
    assert wear_trend([], [], 0.2).points == ()


@pytest.mark.parametrize(("gauge", "die"), [(0.0, 0.0), (0.008, 0.0), (0.0, 0.012), (-0.006, 0.010)])
def test_gauge_drift_is_told_from_wear(gauge: float, die: float) -> None:
    rng = np.random.default_rng(11)
    strokes = np.arange(0, 6000, 20)
    production = 1e-3 * (gauge + die) * strokes + rng.normal(0.0, 0.006, strokes.size)
    master_strokes = np.arange(0, 6000, 400)
    master = 1e-3 * gauge * master_strokes + rng.normal(0.0, 0.002, master_strokes.size)
    found = tell_drift(strokes.tolist(), production.tolist(), master_strokes.tolist(), master.tolist())
    assert found is not None
    assert (found.gauge_moves, found.die_moves) == (gauge != 0.0, die != 0.0), found.sentence
    assert found.gauge == pytest.approx(gauge, abs=0.002) and found.die == pytest.approx(die, abs=0.0025)
    assert tell_drift(strokes.tolist(), production.tolist(), [0, 1], [0.0, 0.0]) is None


def test_theil_sen_uncertainty_is_true() -> None:
    x = np.linspace(0.0, 100.0, 60)
    scores = []
    for seed in range(300):
        y = 0.02 * x + np.random.default_rng([12, seed]).normal(0.0, 0.5, x.size)
        slope, _, sigma = theil_sen(x, y)
        scores.append((slope - 0.02) / sigma)
    assert 0.85 < float(np.std(scores)) < 1.15
