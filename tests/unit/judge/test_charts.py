"""Control charts against published examples and exact algebra."""

from __future__ import annotations

import numpy as np
import pytest

from wearline_judge.core.charts import cpk_now, cusum, ewma, individuals, nelson, short_term_sigma

NIST = np.array(
    [52.0, 47.0, 53.0, 49.3, 50.1, 47.0, 51.0, 50.1, 51.2, 50.5, 49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6,
     52.1]
)  # fmt: skip
"""NIST/SEMATECH e-Handbook of Statistical Methods, 6.3.2.4: example of an EWMA chart, mean 50, s = 2.0539, w = 0.3."""
NIST_EWMA = np.array(
    [50.60, 49.52, 50.56, 50.18, 50.16, 49.21, 49.75, 49.85, 50.26, 50.33, 50.11, 49.36, 49.52, 50.05, 49.38, 49.92,
     50.73, 51.23, 51.94, 51.99]
)  # fmt: skip


def test_ewma_is_that_of_the_handbook() -> None:
    found = ewma(NIST, 50.0, 2.0539, weight=0.3)
    np.testing.assert_allclose(found.average, NIST_EWMA, atol=0.006)
    # The handbook gives the limits of the steady state: 50 +- 3 (0.4201) (2.0539).
    assert found.upper[-1] == pytest.approx(52.5884, abs=2e-3)
    assert found.lower[-1] == pytest.approx(47.4115, abs=2e-3)
    assert found.upper[0] == pytest.approx(50.0 + 3.0 * 2.0539 * 0.3)
    assert found.out == ()


CUSUM = np.array(
    [324.925, 324.675, 324.725, 324.350, 325.350, 325.225, 324.125, 324.525, 325.225, 324.600, 324.625, 325.150,
     328.325, 327.250, 327.825, 328.500, 326.675, 327.775, 326.875, 328.350]
)  # fmt: skip
"""The same, 6.3.2.3: mean 325, k = 0.3175 and h = 4.1959 in the unit of the data."""
CUSUM_HIGH = (0, 0, 0, 0, 0.03, 0, 0, 0, 0, 0, 0, 0, 3.01, 4.94, 7.45, 10.63, 11.99, 14.44, 16.00, 19.04)


def test_cusum_is_that_of_the_handbook() -> None:
    found = cusum(CUSUM, 325.0, 1.0, allowance=0.3175, decision=4.1959)
    np.testing.assert_allclose(found.above, CUSUM_HIGH, atol=0.02)
    assert found.alarm == 13
    assert found.onset == 12


def test_cusum_dates_a_fall_too() -> None:
    values = np.concatenate([np.zeros(30), np.full(20, -2.0)])
    found = cusum(values, 0.0, 1.0)
    assert found.onset == 30 and found.alarm == 33


def test_individuals_limits() -> None:
    values = np.array([10.0, 12.0, 11.0, 13.0])
    x, spread = individuals(values)
    mean_range = 5.0 / 3.0
    assert (x.lower, x.centre, x.upper) == pytest.approx((11.5 - 2.66 * mean_range, 11.5, 11.5 + 2.66 * mean_range))
    assert spread.upper == pytest.approx(3.267 * mean_range)
    assert short_term_sigma(values) == pytest.approx(mean_range / 1.128)


def rules(residuals: list[float]) -> set[tuple[int, int]]:
    return {(b.index, b.rule) for b in nelson(np.array(residuals), 1.0)}


def test_nelson_rules_fire_where_they_should_and_nowhere_else() -> None:
    assert rules([0.5, -3.1, 0.2]) == {(1, 1)}
    assert rules([2.9, -2.9, 0.0]) == set()
    assert rules([0.1] * 8) == set()
    assert rules([0.1] * 9) == {(8, 2)}
    assert rules([-0.1] * 4 + [0.1] + [-0.1] * 8) == set()
    assert rules([2.1, 0.0, 2.2]) == {(2, 5)}
    assert rules([2.1, 0.0, 0.0, 2.2]) == set()
    assert rules([2.1, -2.2, 0.0]) == set()
    with pytest.raises(ValueError, match="rule 3"):
        nelson(np.zeros(3), 1.0, rules=(1, 3))


def test_nelson_false_alarms_are_as_rare_as_stated() -> None:
    rng = np.random.default_rng(3)
    found = nelson(rng.standard_normal(40_000), 1.0)
    count = {rule: sum(b.rule == rule for b in found) for rule in (1, 2, 5)}
    assert count[1] == pytest.approx(40_000 * 0.0027, rel=0.25)
    assert count[2] == pytest.approx(40_000 * 2 * 0.5**9, rel=0.25)
    # P(point beyond 2 s and one of the two before it on the same side).
    assert count[5] == pytest.approx(40_000 * 2 * 0.02275 * (1 - (1 - 0.02275) ** 2), rel=0.3)


def test_cpk_of_the_moment() -> None:
    found = cpk_now(0.12, 0.01, 0.18, 50)
    assert found is not None
    assert found.value == pytest.approx(2.0)
    assert found.high - found.value == pytest.approx(1.96 * np.sqrt(1 / 450 + 4 / 98))
    assert cpk_now(0.1, 0.0, 0.2, 50) is None
