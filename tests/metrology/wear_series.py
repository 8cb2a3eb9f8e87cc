"""``make wear-forecast``: forecasts on simulated dies that were never used to tune them, beside two usual rules.

Coverage: how often the stroke at which the true wear reached the limit lay between P10 and P90, asked
once per die at a random moment. Warning: raised when the method expects the limit within the strokes
to the next planned stop (for the EWMA rule: when the average passes 80 % of the limit); it is a false
alarm when more than twice those strokes were still left; lead time is what was left at the first
warning that was not false.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tests.metrology.wear_lives import Interval, die_life
from wearline_judge.core.charts import ewma
from wearline_judge.core.forecast import forecast, intervals

HOLD_OUT = 1_000_000
"""Seeds from here on were not looked at while the forecast was tuned."""
STOP_SHARE = 0.1
"""Strokes between planned stops, as a share of a usual life between services."""
USUAL_LIFE = 6000.0

Quantiles = tuple[float, float, float]
Method = Callable[[Interval, int], Quantiles | None]


def by_forecast(life: Interval, count: int) -> Quantiles | None:
    """What is shipped."""
    coils = [c for c in life.coils if c <= life.strokes[count - 1]]
    found = forecast(life.strokes[:count].tolist(), life.read_mm[:count].tolist(), life.limit_mm, life.start, coils)
    if found is None or found.remaining_p50 is None or found.remaining_p10 is None or found.remaining_p90 is None:
        return None
    return found.remaining_p10, found.remaining_p50, found.remaining_p90


def by_line(life: Interval, count: int) -> Quantiles | None:
    """A straight line by least squares through all that was read since service, quantiles from its slope alone."""
    x, y = life.strokes[:count].astype(np.float64), life.read_mm[:count]
    x, y = x[y > 0], y[y > 0]
    if x.size < 8:
        return None
    slope, offset = (float(v) for v in np.polyfit(x, y, 1))
    rest = y - slope * x - offset
    sigma = float(np.sqrt(np.sum(rest**2) / (x.size - 2) / np.sum((x - x.mean()) ** 2)))
    if slope <= 3.0 * sigma:
        return None
    left = max(life.limit_mm - slope * float(x[-1]) - offset, 0.0)
    return left / (slope + 1.2816 * sigma), left / slope, left / (slope - 1.2816 * sigma)


def by_ewma(life: Interval, count: int) -> Quantiles | None:
    """No forecast: the limit is near when the average has passed 80 % of it."""
    newest = life.read_mm[max(count - 40, 0) : count]
    average = float(ewma(newest, float(newest[0]), 0.0).average[-1])
    return (0.0, 0.0, 0.0) if average > 0.8 * life.limit_mm else (np.inf, np.inf, np.inf)


METHODS: dict[str, Method] = {"wearline": by_forecast, "straight line": by_line, "EWMA at 80 %": by_ewma}


@dataclass(frozen=True)
class Coverage:
    """Over dies."""

    asked: int
    answered: int
    inside: int
    early: int
    """The limit came before P10."""
    log_errors: tuple[float, ...]
    """ln(P50 / true)."""

    @property
    def share(self) -> float:
        return self.inside / max(self.answered, 1)


def last_interval(seed: int) -> Interval:
    """The running interval of a die, found by the shipped code from its whole record."""
    lives, events = die_life(np.random.default_rng(seed))
    strokes = [int(s) for life in lives for s in life.strokes]
    wears = [float(w) for life in lives for w in life.read_mm]
    found = intervals(strokes, wears, events)[-1]
    last = lives[-1]
    assert found.start == last.start and found.strokes == tuple(last.strokes.tolist())
    return last


def coverage(method: Method, seeds: range) -> Coverage:
    """One question per die."""
    answered = inside = early = 0
    errors: list[float] = []
    for seed in seeds:
        life = last_interval(seed)
        share = float(np.random.default_rng([seed, 1]).uniform(0.4, 0.95))
        count = int(np.searchsorted(life.strokes - life.start, share * (life.at_limit - life.start)))
        quantiles = method(life, max(count, 1))
        if quantiles is None:
            continue
        left = life.at_limit - float(life.strokes[max(count, 1) - 1])
        answered += 1
        inside += quantiles[0] <= left <= quantiles[2]
        early += left < quantiles[0]
        errors.append(float(np.log(max(quantiles[1], 1.0) / max(left, 1.0))))
    return Coverage(len(seeds), answered, inside, early, tuple(errors))


@dataclass(frozen=True)
class Warnings:
    """Over dies."""

    leads: tuple[float, ...]
    """Strokes; 0 where no warning came."""
    false_alarms: int
    strokes: float

    @property
    def per_kilostroke(self) -> float:
        return 1e3 * self.false_alarms / max(self.strokes, 1.0)


def warnings(method: Method, seeds: range, every: int = 8) -> Warnings:
    """Each die from its service to its limit, asked every few readings."""
    horizon = STOP_SHARE * USUAL_LIFE
    leads: list[float] = []
    false_alarms, total = 0, 0.0
    for seed in seeds:
        life = last_interval(seed)
        total += life.at_limit - life.start
        lead, was_warned = 0.0, False
        for count in range(every, len(life.strokes) + 1, every):
            left = life.at_limit - float(life.strokes[count - 1])
            if left < 0:
                break
            quantiles = method(life, count)
            is_warned = quantiles is not None and quantiles[0] <= horizon
            if is_warned and left > 2.0 * horizon:
                false_alarms += not was_warned
            elif is_warned and lead == 0.0:
                lead = left
            was_warned = is_warned
        leads.append(lead)
    return Warnings(tuple(leads), false_alarms, total)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dies", type=int, default=1000)
    parser.add_argument("--warned-dies", type=int, default=250, help="dies followed reading by reading")
    chosen = parser.parse_args()
    seeds = range(HOLD_OUT, HOLD_OUT + chosen.dies)
    print(f"{chosen.dies} dies, one question each at a random 40 to 95 % of the life of the running interval\n")
    print(f"{'method':14} {'answered':>9} {'in P10-P90':>11} {'before P10':>11} {'bias P50':>9} {'|error| P50':>12}")
    for name in ("wearline", "straight line"):
        c = coverage(METHODS[name], seeds)
        error = np.array(c.log_errors)
        print(
            f"{name:14} {c.answered:9d} {100 * c.share:9.1f} % {100 * c.early / c.answered:9.1f} %"
            f" {100 * np.expm1(np.median(error)):+7.1f} % {100 * np.expm1(np.median(np.abs(error))):10.1f} %"
        )
    horizon = STOP_SHARE * USUAL_LIFE
    followed = range(HOLD_OUT, HOLD_OUT + chosen.warned_dies)
    print(f"\n{chosen.warned_dies} dies followed to their limit; planned stops every {horizon:.0f} strokes\n")
    print(f"{'method':14} {'median lead':>12} {'lead P10':>9} {'unwarned':>9} {'false / 1000 strokes':>21}")
    for name, method in METHODS.items():
        w = warnings(method, followed)
        leads = np.array(w.leads)
        print(
            f"{name:14} {np.median(leads):12.0f} {np.percentile(leads, 10):9.0f} {int((leads == 0).sum()):9d}"
            f" {w.per_kilostroke:21.3f}"
        )


if __name__ == "__main__":
    main()
