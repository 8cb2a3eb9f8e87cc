"""Simulated lives of dies: what a judge reads of them stroke by stroke, and the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True)
class Interval:
    """From one service of a die to the stroke at which it reached its limit."""

    strokes: I64
    """Stroke counter of every reading."""
    read_mm: F64
    """0 below the precision. [mm]"""
    true_mm: F64
    start: int
    """Stroke of the service."""
    limit_mm: float
    at_limit: float
    """Stroke at which the true wear reaches the limit."""
    coils: tuple[int, ...]
    """Strokes at which the coil was changed."""


def interval(rng: np.random.Generator, start: int = 0, readings: int = 400) -> Interval:
    """One service interval: curved wear, coils, chips, correlated noise, outliers."""
    limit = float(rng.uniform(0.12, 0.35))
    life = float(rng.lognormal(np.log(6000.0), 0.5))
    exponent = float(np.clip(rng.normal(1.1, 0.35), 0.55, 2.0))
    n = np.linspace(0.0, 2.2 * life, 4001)
    step = n[1] - n[0]
    # Coils of harder and softer sheet: the rate of wear changes at each, and a thickness comes on top.
    coil = life / float(rng.uniform(5.0, 20.0))
    which = (n // coil).astype(int)
    rate = np.exp(rng.normal(0.0, 0.25, which[-1] + 1))[which]
    residual = float(rng.uniform(0.0, 0.02))
    growth = np.diff((n / life) ** exponent, prepend=0.0) * rate
    wear = residual + (limit - residual) * np.cumsum(growth)
    for at in rng.uniform(0.0, 1.1 * life, rng.poisson(0.5)):
        wear = wear + np.where(n >= at, float(rng.uniform(0.01, 0.04)), 0.0)
    crossed = int(np.argmax(wear >= limit)) if (wear >= limit).any() else n.size - 1
    at_limit = float(n[crossed])
    taken = np.unique(np.linspace(1, max(crossed, 50), readings).astype(int))
    true = wear[taken]
    sigma = float(rng.uniform(0.003, 0.012))
    noise = np.empty(taken.size)
    last, alike = 0.0, float(rng.uniform(0.0, 0.5))
    for i, shock in enumerate(rng.standard_normal(taken.size)):
        last = alike * last + float(np.sqrt(1.0 - alike**2)) * shock
        noise[i] = sigma * last
    thickness = rng.normal(0.0, 0.003, which[-1] + 1)[which[taken]]
    outliers = np.where(rng.random(taken.size) < 0.01, rng.normal(0.0, 8.0 * sigma, taken.size), 0.0)
    read = true + noise + thickness + outliers
    read = np.where(read > 0.05, read, 0.0)
    strokes = start + np.maximum(np.rint(taken * step), 1).astype(np.int64)
    coils = tuple(start + round(k * coil) for k in range(1, int(at_limit // coil) + 1))
    return Interval(strokes, read, true, start, limit, start + at_limit, coils)


def die_life(rng: np.random.Generator) -> tuple[list[Interval], list[tuple[int, str]]]:
    """One to three service intervals of a die and the log of its events; services come before or after the limit."""
    lives: list[Interval] = []
    events: list[tuple[int, str]] = []
    start = 0
    for k in range(int(rng.integers(1, 4))):
        events.append((start, str(rng.choice(["regrind", "polish", "insert"])) if k else "die_change"))
        life = interval(rng, start)
        lives.append(life)
        events += [(c, "coil_change") for c in life.coils if c <= life.strokes[-1]]
        start = int(life.strokes[-1]) + 1
    return lives, sorted(events)
