"""Control charts: individuals, EWMA, CUSUM, Nelson's rules, short-term capability.

A wearing tool drifts by nature, so charts that assume a steady mean are meant for the residuals of
the wear fit; on the wear itself the EWMA says when it has left its start, the CUSUM since when.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wearline_judge.core.line_grid import F64

_D2 = 1.128
"""Mean range of two normal values over their standard deviation."""


def short_term_sigma(values: F64) -> float:
    """Standard deviation from the mean moving range of two, MR / 1.128; 0 for fewer than two values."""
    return float(np.mean(np.abs(np.diff(values)))) / _D2 if values.size > 1 else 0.0


@dataclass(frozen=True)
class Limits:
    """Of a chart; lower, centre and upper in the unit of the values."""

    lower: float
    centre: float
    upper: float


def individuals(values: F64) -> tuple[Limits, Limits]:
    """Limits of an I-MR chart: individuals mean +- 2.660 MR, moving range 0 to 3.267 MR."""
    if values.size < 2:
        centre = float(values[0]) if values.size else 0.0
        return Limits(centre, centre, centre), Limits(0.0, 0.0, 0.0)
    centre, spread = float(np.mean(values)), float(np.mean(np.abs(np.diff(values))))
    return Limits(centre - 2.660 * spread, centre, centre + 2.660 * spread), Limits(0.0, spread, 3.267 * spread)


@dataclass(frozen=True)
class Ewma:
    """Exponentially weighted moving average with its limits, one entry per value."""

    average: F64
    lower: F64
    upper: F64

    @property
    def out(self) -> tuple[int, ...]:
        """Where the average is beyond its limits."""
        return tuple(int(i) for i in np.flatnonzero((self.average > self.upper) | (self.average < self.lower)))


def ewma(values: F64, mean: float, sigma: float, weight: float = 0.2, width: float = 3.0) -> Ewma:
    """z_i = w x_i + (1 - w) z_{i-1}, z_0 = mean; limits mean +- L s sqrt(w / (2 - w) (1 - (1 - w)^{2 i})).

    Roberts 1959; NIST/SEMATECH e-Handbook 6.3.2.4.
    """
    average = np.empty(values.size)
    last = mean
    for i, value in enumerate(values):
        last = weight * float(value) + (1.0 - weight) * last
        average[i] = last
    turns = 2.0 * np.arange(1, values.size + 1)
    half = width * sigma * np.sqrt(weight / (2.0 - weight) * (1.0 - (1.0 - weight) ** turns))
    return Ewma(average, mean - half, mean + half)


@dataclass(frozen=True)
class Cusum:
    """Tabular CUSUM, one entry per value, in standard deviations."""

    above: F64
    below: F64
    decision: float
    """h: the interval beyond which the sums signal."""

    @property
    def alarm(self) -> int | None:
        """First signal."""
        hits = np.flatnonzero((self.above > self.decision) | (self.below > self.decision))
        return int(hits[0]) if hits.size else None

    @property
    def onset(self) -> int | None:
        """Where the change that signalled began: the value after the sum's last zero."""
        at = self.alarm
        if at is None:
            return None
        series = self.above if self.above[at] > self.decision else self.below
        zeros = np.flatnonzero(series[: at + 1] <= 0.0)
        return int(zeros[-1]) + 1 if zeros.size else 0


def cusum(values: F64, mean: float, sigma: float, allowance: float = 0.5, decision: float = 5.0) -> Cusum:
    """C+ = max(0, C+ + (x - mean) / s - k), C- = max(0, C- - (x - mean) / s - k); signals beyond h.

    Page 1954; NIST/SEMATECH e-Handbook 6.3.2.3. k = 0.5 finds a shift of one standard deviation; h = 5 signals
    without one every 465 values.
    """
    above, below = np.zeros(values.size), np.zeros(values.size)
    high = low = 0.0
    for i, value in enumerate(values):
        score = (float(value) - mean) / sigma if sigma > 0 else 0.0
        high = max(0.0, high + score - allowance)
        low = max(0.0, low - score - allowance)
        above[i], below[i] = high, low
    return Cusum(above, below, decision)


@dataclass(frozen=True)
class RuleBreak:
    """A value that breaks one of Nelson's rules."""

    index: int
    """Of the last value of the pattern."""
    rule: int


def nelson(residuals: F64, sigma: float, rules: tuple[int, ...] = (1, 2, 5)) -> tuple[RuleBreak, ...]:
    """Nelson 1984, on residuals of mean 0; by default the rules 1, 2 and 5.

    1: beyond 3 s. 2: nine in a row on one side. 5: two of three beyond 2 s on one side.

    Raises:
        ValueError: a rule that is not offered.
    """
    unknown = set(rules) - {1, 2, 5}
    if unknown:
        raise ValueError(f"Nelson rule {min(unknown)} is not offered; 1, 2 and 5 are")
    found: list[RuleBreak] = []
    if sigma <= 0:
        return ()
    score = residuals / sigma
    for i in range(score.size):
        if 1 in rules and abs(score[i]) > 3.0:
            found.append(RuleBreak(i, 1))
        nine = score[max(i - 8, 0) : i + 1]
        if 2 in rules and nine.size == 9 and (np.all(nine > 0) or np.all(nine < 0)):
            found.append(RuleBreak(i, 2))
        three = score[max(i - 2, 0) : i + 1]
        for sign in (1.0, -1.0):
            if 5 in rules and sign * score[i] > 2.0 and np.count_nonzero(sign * three > 2.0) >= 2:
                found.append(RuleBreak(i, 5))
    return tuple(found)


@dataclass(frozen=True)
class Cpk:
    """Short-term capability at one moment of a die's life."""

    value: float
    low: float
    high: float
    """95 % interval."""


def cpk_now(level: float, sigma: float, upper: float, count: int) -> Cpk | None:
    """Against an upper limit only: (USL - level) / (3 s), with s of the short term; None without spread.

    The interval is Bissell's (1990): Cpk +- 1.96 sqrt(1 / (9 n) + Cpk^2 / (2 (n - 1))). Wear is a systematic
    drift: a figure over a whole regrind interval would mix drift and spread.
    """
    if sigma <= 0 or count < 2:
        return None
    value = (upper - level) / (3.0 * sigma)
    half = 1.96 * float(np.sqrt(1.0 / (9.0 * count) + value**2 / (2.0 * (count - 1))))
    return Cpk(value, value - half, value + half)
