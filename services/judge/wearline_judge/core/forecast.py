"""How a die wears since its last service, and when it reaches its limit.

Model of the wear after n strokes of one service interval:

    w(n) = a + c (n / n_now)^p + steps + W(n) + noise

a power law with unknown exponent (running in, straight, or ever faster), steps where a chip broke
out (large) or a coil was changed (small), and a Wiener process W in operational time (its variance
grows with wear, not with strokes): coils of harder sheet and unseen causes make the rate itself
uncertain, and no forecast may claim to know them. For every exponent and strength of W on a grid
all else is linear and normal, so the posterior is exact (Gaussian process regression; Rasmussen &
Williams 2006, eq. 2.23-2.25 and 2.30); the grid is averaged by its evidence. The stroke at which
the limit is reached has the distribution P(T <= n) = P(w(n) >= limit), which is exact for wear that
never goes back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from wearline.config import Settings
from wearline_judge.core.line_grid import F64

_EXPONENTS = np.array([0.55, 0.7, 0.85, 1.0, 1.15, 1.3, 1.5, 1.75, 2.0])
_RATES = np.array([0.003, 0.009, 0.025, 0.05])
"""Variance of W at the limit, in squares of the limit: it strays by 4 to 21 % of it."""
_ENOUGH = 8
_BINS = 36
_HORIZON = 20.0
"""Forecasts look ahead this many times the strokes since service."""
_CHIP, _COIL = 0.5, 0.02
"""Usual size of a step by a chip that was seen and by another coil, as shares of the limit."""
_COILS = 8
"""Newest changes of coil that are looked at."""
_MEDIAN_LOSS = 1.2533
"""A median's standard deviation over a mean's, for normal values."""
_TO_SIGMA = 1.4826
_HARSHER = 0.05
_COMMON = 0.3
"""Share of the scatter of single readings that neighbouring readings have in common."""


class ForecastSettings(Settings):
    """What is expected of dies before one of them has been seen."""

    identifiable: float = Field(default=3.0, gt=0)
    """Without a slope of this many standard uncertainties there is no forecast."""
    exponent: float = Field(default=1.1, gt=0)
    """Usual exponent of the power law."""
    exponent_spread: float = Field(default=0.35, gt=0)
    """And its standard deviation among dies."""
    jump_significance: float = Field(default=6.0, gt=0)
    """A step counts as a jump from this many standard uncertainties on."""
    jump_min_mm: float = Field(default=0.01, ge=0)
    """And from this size on. [mm]"""


@dataclass(frozen=True)
class Jump:
    """A sudden change of the wear: a chip, a displaced insert."""

    stroke: int
    """First stroke after it."""
    size_mm: float
    sigma_mm: float


RESTARTS = ("regrind", "polish", "insert", "die_change")
"""Die events that make the surface new: the trend starts anew. A change of coil lets the same surface wear on."""


@dataclass(frozen=True)
class Interval:
    """What was read between two services of a die."""

    start: int
    """Stroke of the service that began it; the first reading's for the first one."""
    began: str
    """Kind of that service; empty for the first one."""
    strokes: tuple[int, ...]
    wears: tuple[float, ...]
    coils: tuple[int, ...] = ()
    """Strokes at which the coil was changed."""


def intervals(
    strokes: Sequence[int], wears: Sequence[float], events: Sequence[tuple[int, str]]
) -> tuple[Interval, ...]:
    """Part the record of a die at its services; old intervals are kept, the last one is running.

    Args:
        strokes, wears: readings in the order of their strokes.
        events: (stroke, kind) in order; a reading at the stroke of a service belongs to what it began.
    """
    services = [(stroke, kind) for stroke, kind in events if kind in RESTARTS]
    coils = [stroke for stroke, kind in events if kind not in RESTARTS]
    first = min(strokes, default=services[0][0] if services else 0)
    starts = [(min(first, services[0][0]) if services else first, ""), *services]
    found: list[Interval] = []
    for k, (start, kind) in enumerate(starts):
        stop = starts[k + 1][0] if k + 1 < len(starts) else None
        own = [i for i, s in enumerate(strokes) if s >= start and (stop is None or s < stop)]
        if not own and not kind:
            continue
        within = tuple(c for c in coils if c > start and (stop is None or c < stop))
        found.append(Interval(start, kind, tuple(strokes[i] for i in own), tuple(wears[i] for i in own), within))
    return tuple(found)


@dataclass(frozen=True)
class Forecast:
    """Of one zone of one die; None = not identifiable."""

    level_mm: float
    """Wear now, from the model. [mm]"""
    level_sigma_mm: float
    slope_mm_per_stroke: float
    """Robust slope of the newest part of the record."""
    slope_sigma: float
    noise_mm: float
    """Scatter of single readings. [mm]"""
    exponent: float | None = None
    """Most plausible exponent of the power law."""
    remaining_p10: float | None = None
    remaining_p50: float | None = None
    remaining_p90: float | None = None
    """Strokes to the limit."""
    jumps: tuple[Jump, ...] = ()

    @property
    def is_identifiable(self) -> bool:
        return self.remaining_p50 is not None


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
    sigma = max(_TO_SIGMA * float(np.median(np.abs(rest))), 1e-6)
    alike = _alike(rest)
    spread = float(np.sum((x - x.mean()) ** 2))
    # A Theil-Sen slope has about 91 % of the efficiency of least squares on normal residuals.
    return slope, offset, sigma / np.sqrt(0.91 * spread) * np.sqrt((1 + alike) / (1 - alike))


def _alike(rest: F64) -> float:
    """Correlation of neighbouring residuals, 0 to 0.9; outliers clipped."""
    scale = _TO_SIGMA * float(np.median(np.abs(rest)))
    clipped = np.clip(rest, -3.0 * scale, 3.0 * scale)
    power = float(np.sum(clipped**2))
    return min(max(float(np.sum(clipped[1:] * clipped[:-1])) / power, 0.0), 0.9) if power > 0 else 0.0


def since_shown(wears: F64) -> int:
    """Index from which wear is seen steadily: before it most readings are 0, below the precision."""
    seen = (wears > 0).astype(np.float64)
    if not seen.size:
        return 0
    ahead = np.convolve(seen, np.ones(5), "full")[4:]
    of = np.minimum(np.arange(seen.size, 0, -1), 5)
    steady = np.flatnonzero((ahead >= 0.8 * of) & (seen > 0))
    return int(steady[0]) if steady.size else int(seen.size)


def find_jumps(strokes: F64, wears: F64, settings: ForecastSettings) -> tuple[Jump, ...]:
    """Steps against the trend on both sides, in order, two windows apart at least."""
    window = 8
    n = wears.size
    if n < 3 * window:
        return ()
    noise, _ = _noise(strokes, wears)
    windows = np.lib.stride_tricks.sliding_window_view
    level = np.median(windows(wears, window), axis=1)
    middle = np.mean(windows(strokes, window), axis=1)
    # A step at i is what the window after it shows beyond the trend: that of the windows around where there is
    # room for them (wear that grows ever faster is no jump), else the usual one.
    rise, gap = level[window:] - level[:-window], middle[window:] - middle[:-window]
    rate = rise / np.maximum(gap, 1e-9)
    trend = np.full(rate.size, float(np.median(rate)))
    inner = slice(window, rate.size - window)
    if rate.size > 2 * window:
        trend[inner] = 0.5 * (rate[: -2 * window] + rate[2 * window :])
    size = np.zeros(n)
    size[window : n - window + 1] = rise - trend * gap
    sigma = noise * _MEDIAN_LOSS * float(np.sqrt(2.0 / window + 1.0 / window))
    least = max(settings.jump_significance * sigma, settings.jump_min_mm)
    found: list[Jump] = []
    free = np.abs(size)
    while True:
        at = int(np.argmax(free))
        if free[at] < least:
            break
        found.append(Jump(int(strokes[at]), float(size[at]), sigma))
        free[max(at - 2 * window, 0) : at + 2 * window + 1] = 0.0
    return tuple(sorted(found, key=lambda jump: jump.stroke))


def _noise(strokes: F64, wears: F64) -> tuple[float, float]:
    """Standard deviation of single readings, and the factor by which their correlation widens a mean."""
    if wears.size < 4:
        return 1e-4, 1.0
    second = wears[1:-1] - 0.5 * (wears[:-2] + wears[2:])
    white = max(_TO_SIGMA * float(np.median(np.abs(second))) / float(np.sqrt(1.5)), 1e-5)
    window = min(25, wears.size | 1)
    padded = np.pad(wears, window // 2, mode="edge")
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(padded, window), axis=1)[: wears.size]
    alike = _alike(wears - smooth)
    return white / float(np.sqrt(1.0 - alike)), float(np.sqrt((1.0 + alike) / (1.0 - alike)))


def _normal_cdf(z: F64) -> F64:
    """Abramowitz & Stegun 26.2.17, to 1e-7."""
    t = 1.0 / (1.0 + 0.2316419 * np.abs(z))
    poly = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    tail = np.exp(-0.5 * np.minimum(z * z, 1400.0)) / 2.5066282746310002 * poly
    return np.where(z > 0, 1.0 - tail, tail)


def _binned(x: F64, y: F64, edges: Sequence[float], noise: float, widen: float) -> tuple[F64, F64, F64]:
    """Medians of runs of readings that no jump parts: stroke, wear, standard uncertainty."""
    size = max(-(-x.size // _BINS), 1)
    part = np.searchsorted(np.asarray(edges, np.float64), x, side="right")
    xs, ys, ss = [], [], []
    for label in np.unique(part):
        own = np.flatnonzero(part == label)
        for begin in range(0, own.size, size):
            run = own[begin : begin + size]
            xs.append(float(np.mean(x[run])))
            ys.append(float(np.median(y[run])))
            loss = _MEDIAN_LOSS if run.size > 2 else 1.0
            # Sheet of one coil shifts all its readings alike: no mean is better than that.
            ss.append(noise * max(min(loss * widen / float(np.sqrt(run.size)), 1.0), _COMMON))
    return np.array(xs), np.array(ys), np.array(ss)


def forecast(
    strokes: Sequence[int], wears: Sequence[float], limit_mm: float | None, start: int | None = None,
    coils: Sequence[int] = (), settings: ForecastSettings | None = None,
) -> Forecast | None:  # fmt: skip
    """Fit one service interval.

    Args:
        strokes: stroke counter, in any order.
        wears: 0 while nothing deviates significantly. [mm]
        limit_mm: wear that fails a part; None = no forecast.
        start: stroke of the service; None = the first one given.
        coils: strokes at which the coil was changed since then.
        settings: what is usual.

    Returns:
        None while too few readings show wear.
    """
    settings = settings or ForecastSettings()
    order = np.argsort(np.asarray(strokes, np.int64), kind="stable")
    x, y = np.asarray(strokes, np.float64)[order], np.asarray(wears, np.float64)[order]
    origin = float(start) if start is not None else (float(x[0]) if x.size else 0.0)
    shown = since_shown(y)
    x, y = x[shown:], y[shown:]
    if x.size < _ENOUGH or x[-1] <= x[0]:
        return None
    jumps = find_jumps(x, y, settings)
    noise, widen = _noise(x, y)
    xs, ys, ss = _binned(x, y, [float(j.stroke) for j in jumps], noise, widen)
    slope, slope_sigma = _slope_now(xs, ys, ss, jumps)
    now = float(x[-1])
    scale = limit_mm if limit_mm is not None else max(float(np.max(ys)), 1e-3)
    steps = [(j.stroke - origin, _CHIP) for j in jumps] + [(c - origin, _COIL) for c in list(coils)[-_COILS:]]
    model = _Model(xs - origin, ys, ss, max(now - origin, 1.0), scale, steps, settings)
    level, level_sigma = model.level()
    remaining: tuple[float | None, float | None, float | None] = (None, None, None)
    if limit_mm is not None and slope > settings.identifiable * slope_sigma:
        remaining = model.remaining(limit_mm)
    return Forecast(
        level, level_sigma, slope, slope_sigma, noise, model.exponent(), *remaining, jumps=jumps
    )  # fmt: skip


def _slope_now(xs: F64, ys: F64, ss: F64, jumps: Sequence[Jump]) -> tuple[float, float]:
    """Robust slope over the newest half of the record, steps taken out, and its standard uncertainty."""
    level = ys - sum((np.where(xs >= j.stroke, j.size_mm, 0.0) for j in jumps), np.zeros(xs.size))
    newest = slice(max(xs.size // 2 if xs.size >= 2 * _ENOUGH else 0, 0), None)
    x, y, s = xs[newest], level[newest], ss[newest]
    if x.size < 3:
        return 0.0, float("inf")
    slope, _, sigma = theil_sen(x, y)
    # Few residuals may agree by chance: the slope is never better than the readings allow.
    floor = float(np.mean(s)) / float(np.sqrt(np.sum((x - x.mean()) ** 2)))
    return slope, max(float(sigma), floor)


class _Model:
    """The Gaussian processes on the grid, ready for predictions; strokes count from the service."""

    def __init__(
        self, n: F64, y: F64, sigma: F64, now: float, scale: float,
        steps: Sequence[tuple[float, float]], settings: ForecastSettings,
    ) -> None:  # fmt: skip
        self._n, self._now = n, now
        self._steps = np.array([at for at, _ in steps])
        # A service leaves little wear; the power law may be anything below some limits' worth.
        self._sizes2 = (np.array([0.1, 3.0, *(size for _, size in steps)]) * scale) ** 2
        reached = max(float(np.max(y)), 0.1 * scale)
        exponents, rates = (a.ravel() for a in np.meshgrid(_EXPONENTS, _RATES, indexing="ij"))
        self._exponents, self._growth = exponents, rates * scale * reached
        cov = self._covariance(n, n) + np.diag(sigma**2)
        self._root = np.linalg.cholesky(cov)
        half = np.linalg.solve(self._root, np.broadcast_to(y[:, None], (exponents.size, y.size, 1)))
        self._alpha = np.linalg.solve(np.swapaxes(self._root, 1, 2), half)
        size = np.log(np.diagonal(self._root, axis1=1, axis2=2)).sum(axis=1)
        usual = (exponents - settings.exponent) / settings.exponent_spread
        logs = -0.5 * np.sum(half**2, axis=(1, 2)) - size - 0.5 * usual**2
        weight = np.exp(logs - logs.max())
        self._weight = weight / weight.sum()

    def _parts(self, n: F64) -> tuple[F64, F64]:
        """(grid, point): the power law; (point, step): the steps."""
        power = np.maximum(n / self._now, 0.0)[None, :] ** self._exponents[:, None]
        return power, np.where(n[:, None] >= self._steps, 1.0, 0.0)

    def _covariance(self, left: F64, right: F64) -> F64:
        """(grid, left, right): of the wear before anything was read. [mm^2]"""
        (a, step_a), (b, step_b) = self._parts(left), self._parts(right)
        steps = self._sizes2[0] + (step_a * self._sizes2[2:]) @ step_b.T
        law = self._sizes2[1] * a[:, :, None] * b[:, None, :]
        wiener = self._growth[:, None, None] * np.minimum(a[:, :, None], b[:, None, :])
        return np.asarray(law + wiener + steps)

    def _predicted(self, n: F64) -> tuple[F64, F64]:
        """(grid, point): mean and standard deviation of the wear itself. [mm]"""
        cross = self._covariance(self._n, n)
        half = np.linalg.solve(self._root, cross)
        power, steps = self._parts(n)
        own = self._sizes2[0] + self._sizes2[1] * power**2 + (steps @ self._sizes2[2:]) + self._growth[:, None] * power
        mean = np.sum(cross * self._alpha, axis=1)
        return mean, np.sqrt(np.maximum(own - np.sum(half * half, axis=1), 1e-12))

    def level(self) -> tuple[float, float]:
        """Wear now and its standard uncertainty. [mm]"""
        mean, spread = (a[:, 0] for a in self._predicted(np.array([self._now])))
        level = float(self._weight @ mean)
        return level, float(np.sqrt(self._weight @ (spread**2 + (mean - level) ** 2)))

    def exponent(self) -> float:
        """Mean of the posterior."""
        return float(self._weight @ self._exponents)

    def remaining(self, limit_mm: float) -> tuple[float, float, float]:
        """Quantiles 10, 50 and 90 % of the strokes left; 0 = reached, the horizon = beyond it."""
        ahead = np.concatenate([[0.0], np.geomspace(1e-3, _HORIZON, 140)]) * self._now
        means, spreads = self._predicted(self._now + ahead)
        # Chips only add, and rates vary further up than down: what is to come is more than the law says.
        means += _HARSHER * (means - means[:, :1])
        reached = self._weight @ _normal_cdf((means - limit_mm) / spreads)
        reached = np.maximum.accumulate(reached)
        p10, p50, p90 = (float(np.interp(q, reached, ahead, left=0.0)) for q in (0.1, 0.5, 0.9))
        return p10, p50, p90


@dataclass(frozen=True)
class Drift:
    """Which of gauge and die moves; slopes in mm per 1000 strokes with their standard uncertainties."""

    gauge: float
    gauge_sigma: float
    """Of the master part, which does not wear."""
    die: float
    die_sigma: float
    """Of the production less that of the master."""
    sentence: str

    @property
    def gauge_moves(self) -> bool:
        return abs(self.gauge) > 3.0 * self.gauge_sigma

    @property
    def die_moves(self) -> bool:
        return abs(self.die) > 3.0 * self.die_sigma


def tell_drift(
    strokes: Sequence[int], deviations_mm: Sequence[float], master_strokes: Sequence[int],
    master_deviations_mm: Sequence[float],
) -> Drift | None:  # fmt: skip
    """Tell a drift of the gauge from wear of the die.

    A master part measured now and then shows what the gauge alone does: what the production shows
    beyond it is the die's.

    Args:
        strokes, deviations_mm: production: signed mean deviation of a zone. [mm]
        master_strokes, master_deviations_mm: the same of the master part, by the stroke counter of its time.

    Returns:
        None with fewer than 8 production parts or 4 measurements of the master.
    """
    if len(strokes) < _ENOUGH or len(master_strokes) < 4:
        return None

    def fitted(x: Sequence[int], y: Sequence[float]) -> tuple[float, float]:
        xs, ys = np.asarray(x, np.float64), np.asarray(y, np.float64)
        step = -(-xs.size // 300)
        slope, offset, sigma = theil_sen(xs[::step], ys[::step])
        # So few points may lie on a line by chance.
        rest = ys - slope * xs - offset
        floor = float(np.std(rest)) / float(np.sqrt(max(np.sum((xs - xs.mean()) ** 2), 1e-12)))
        return 1e3 * slope, 1e3 * max(float(sigma), floor)

    gauge, gauge_sigma = fitted(master_strokes, master_deviations_mm)
    whole, whole_sigma = fitted(strokes, deviations_mm)
    die, die_sigma = whole - gauge, float(np.hypot(whole_sigma, gauge_sigma))
    found = Drift(gauge, gauge_sigma, die, die_sigma, "")
    by_gauge = f"the gauge drifts by {gauge:+.4f} mm per 1000 strokes"
    by_die = f"the die wears by {die:+.4f} mm per 1000 strokes"
    sentence = {
        (False, False): "neither gauge nor die moves",
        (True, False): f"{by_gauge}: calibrate it, the die is not to blame",
        (False, True): by_die,
        (True, True): f"{by_die} while {by_gauge}: calibrate it before the die is judged",
    }[found.gauge_moves, found.die_moves]
    return Drift(gauge, gauge_sigma, die, die_sigma, sentence)
