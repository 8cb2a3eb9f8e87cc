"""The spatial Kalman smoother along the lines.

State of a line at one place: height and slope; the slope changes as a random walk (constant-slope
model). A forward filter and a backward filter run over the points and are fused at each of them,
which is the Rauch-Tung-Striebel result in the two-filter form, and does not depend on the
direction of sweep. Both run at once on all lines, cut into pieces that overlap by more than the filter's memory,
so that a step of the recursion handles some hundred lanes.

Steps stay sharp: filters start anew where a line was broken. A single point that contradicts the
prediction hardly enters (innovation gate).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wearline.config import Settings
from wearline_reconstruct.core.stripes import F64, Bool

_PIECES = 8
_WIDE = 1e6
_NOTHING = 1e15


class SmoothingSettings(Settings):
    """How strongly heights are smoothed along a line."""

    gate_sigma: float = 6.0
    """A point further off the prediction than this many standard deviations counts less and less."""
    reach_px: float = 60.0
    """Scale over which a surface that shows no bends is smoothed: about three times as many points count. [px]"""
    overlap_px: int = 96
    """Run-in of each piece; longer than the memory of the filter. [px]"""


@dataclass(frozen=True)
class Smoothed:
    """Arrays (line, along); NaN where there was no point."""

    z_mm: F64
    sigma_mm: F64
    """Posterior standard deviation. [mm]"""


def smooth(
    z_mm: F64, sigma_mm: F64, starts: Bool, correlation_px: float, process_mm2: F64, settings: SmoothingSettings
) -> Smoothed:
    """Smooth heights along the lines.

    Args:
        z_mm: (line, along), NaN = no point. [mm]
        sigma_mm: (line, along), standard uncertainty of one point. [mm]
        starts: (line, along), True at the first point of each piece without a break.
        correlation_px: points that share one independent error. [px]
        process_mm2: (line, along), variance that the slope gains per pixel. [mm^2/px^3]
    """
    if not np.isfinite(z_mm).any():
        return Smoothed(z_mm.copy(), sigma_mm.copy())
    # Two neighbours make one step: they were averaged over more before, and it halves the time.
    lines, along = z_mm.shape
    size = -(-along // 2)
    pair = _pairs(z_mm, np.nan)
    z = pair.mean(axis=2)
    seen = np.isfinite(z)
    # Neighbouring points share their error, so that each brings only its share of news.
    variance = np.where(seen, _pairs(sigma_mm, np.nan).mean(axis=2) ** 2 * (0.5 * max(correlation_px, 1.0)), np.inf)
    process = 8.0 * _pairs(process_mm2, 0.0).max(axis=2)
    begins = _pairs(starts, False)
    # Where two pieces meet within a step, the second one has it.
    start: Bool = np.asarray(begins.any(axis=2))
    z[begins[:, :, 1] & np.isfinite(pair[:, :, 0])] = np.nan
    ends = np.zeros_like(start)
    ends[:, :-1] = _next_start(start, np.isfinite(pair).any(axis=2))
    span = -(-size // _PIECES)
    run_in = min(settings.overlap_px // 2, size)
    forward = _lanes(z, variance, process, start, span, run_in)
    backward = _lanes(z[:, ::-1], variance[:, ::-1], process[:, ::-1], ends[:, ::-1], span, run_in)
    both = (np.concatenate([f, b], axis=1) for f, b in zip(forward, backward, strict=True))
    # Filtered from the left, predicted from the right: each point counts once.
    filtered, predicted = _filter(*both, gate=settings.gate_sigma**2, run_in=run_in)
    left = _whole(filtered, lines, span, size)
    right = _whole(predicted, lines, span, size)[:, :, ::-1]
    height, slope, sigma = _fused(left, right)
    apart = slope[:, :, None] * np.array([-0.25, 0.25])
    single = np.isfinite(z_mm)
    full = (height[:, :, None] + apart).reshape(lines, 2 * size)[:, :along]
    spread = np.repeat(sigma, 2, axis=1)[:, :along]
    return Smoothed(np.where(single, full, np.nan), np.where(single, spread, np.nan))


def _pairs(values: NDArray[Any], fill: float | bool) -> NDArray[Any]:
    """(line, along) as (line, step, 2)."""
    lines, along = values.shape
    if along % 2:
        values = np.concatenate([values, np.full((lines, 1), fill, values.dtype)], axis=1)
    return values.reshape(lines, -1, 2)


def _next_start(starts: Bool, seen: Bool) -> Bool:
    """(line, along - 1): the last point before each start, where the backward filter starts anew."""
    ends = np.zeros((starts.shape[0], starts.shape[1] - 1), bool)
    for line in np.flatnonzero(starts.sum(axis=1) > 1):
        places = np.flatnonzero(seen[line])
        index = np.searchsorted(places, np.flatnonzero(starts[line]))
        last = places[index[index > 0] - 1]
        ends[line, last[last < ends.shape[1]]] = True
    return ends


def _lanes(
    z: F64, variance: F64, process: F64, starts: Bool, span: int, run_in: int
) -> tuple[F64, F64, F64, NDArray[np.bool_]]:
    """(run_in + span, line * piece): each piece with its run-in before it, time on the first axis."""
    lines, size = z.shape
    padded = _PIECES * span + run_in

    def cut(values: NDArray[np.generic], fill: float | bool) -> NDArray[np.generic]:
        full = np.full((lines, padded), fill, dtype=values.dtype)
        full[:, run_in : run_in + size] = values
        view = np.lib.stride_tricks.sliding_window_view(full, run_in + span, axis=1)[:, ::span][:, :_PIECES]
        return np.ascontiguousarray(view.reshape(lines * _PIECES, run_in + span).T)

    return cut(z, np.nan), cut(variance, np.inf), cut(process, 0.0), cut(starts, False)  # type: ignore[return-value]


def _filter(z: F64, variance: F64, process: F64, starts: Bool, *, gate: float, run_in: int) -> tuple[F64, F64]:
    """z, slope, p00, p01, p11 as (5, span, lane): filtered for the first half of the lanes, predicted for the rest."""
    steps, lanes = z.shape
    half = lanes // 2
    filtered = np.empty((steps - run_in, 5, half))
    predicted = np.empty((steps - run_in, 5, lanes - half))
    seen = np.isfinite(z)
    value = np.where(seen, z, 0.0)
    # A point that is not there weighs nothing.
    noise = np.where(seen, variance, _NOTHING)
    third, second = process / 3.0, process / 2.0
    any_start: Bool = np.asarray(starts.any(axis=1))
    state = np.zeros((5, lanes))
    height, slope, p00, p01, p11 = state
    p00[:], p11[:] = _WIDE, 1.0
    innovation, total, gain, g0, g1 = np.empty((5, lanes))
    for k in range(steps):
        height += slope
        p00 += p01
        p01 += p11
        p00 += p01
        p00 += third[k]
        p01 += second[k]
        p11 += process[k]
        if any_start[k]:
            fresh = starts[k]
            p00[fresh], p01[fresh], p11[fresh] = _WIDE, 0.0, 1.0
        if k >= run_in:
            predicted[k - run_in] = state[:, half:]
        np.subtract(value[k], height, out=innovation)
        np.add(p00, noise[k], out=total)
        # gain = 1 / max(total, innovation^2 / gate): what is too far off counts less, the further the less.
        np.multiply(innovation, innovation, out=gain)
        gain /= gate
        np.maximum(gain, total, out=gain)
        np.divide(1.0, gain, out=gain)
        np.multiply(p00, gain, out=g0)
        np.multiply(p01, gain, out=g1)
        np.multiply(g0, innovation, out=total)
        height += total
        innovation *= g1
        slope += innovation
        g1 *= p01
        p11 -= g1
        np.subtract(1.0, g0, out=g0)
        p01 *= g0
        p00 *= g0
        if k >= run_in:
            filtered[k - run_in] = state[:, :half]
    return filtered.transpose(1, 0, 2), predicted.transpose(1, 0, 2)


def _whole(state: F64, lines: int, span: int, size: int) -> F64:
    """(entry, line, along) from (entry, span, line * piece)."""
    entries = state.shape[0]
    shaped = state.transpose(0, 2, 1).reshape(entries, lines, _PIECES * span)
    return np.asarray(shaped[:, :, :size])


def _fused(left: F64, right: F64) -> tuple[F64, F64, F64]:
    """Two independent estimates of (z, slope) at each step, weighed by their covariances: z, slope, sigma of z."""
    lz, ls, l00, l01, l11 = left
    rz, rs, r00, r01, r11 = right
    # The backward slope runs the other way.
    rs, r01 = -rs, -r01
    s00, s01, s11 = l00 + r00, l01 + r01, l11 + r11
    det = np.maximum(s00 * s11 - s01 * s01, 1e-30)
    dz, ds = (rz - lz) / det, (rs - ls) / det
    # The gain of the height applies to both, that of the slope likewise.
    turn_z, turn_s = s11 * dz - s01 * ds, s00 * ds - s01 * dz
    height = lz + l00 * turn_z + l01 * turn_s
    slope = ls + l01 * turn_z + l11 * turn_s
    lost = (l00 * s11 - l01 * s01) / det * l00 + (l01 * s00 - l00 * s01) / det * l01
    return height, slope, np.sqrt(np.maximum(l00 - lost, 1e-12))
