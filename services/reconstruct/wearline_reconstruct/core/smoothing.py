"""The spatial Kalman smoother along the lines.

State of a line at one place: height and slope; the slope changes as a random walk (constant-slope
model). A forward filter and a backward filter run over the points and are fused at each of them,
which is the Rauch-Tung-Striebel result in the two-filter form, and does not depend on the
direction of sweep. Both run at once on all lines, cut into pieces that overlap by more than the filter's memory,
so that a step of the recursion handles some hundred lanes.

Steps stay sharp: filters start anew where a line was broken, and a single point that contradicts the
prediction (innovation gate) does not enter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wearline.config import Settings
from wearline_reconstruct.core.stripes import F64, Bool

_PIECES = 8
_WIDE = 1e6


class SmoothingSettings(Settings):
    """How strongly heights are smoothed along a line."""

    gate_sigma: float = 6.0
    """A point further off the prediction than this many standard deviations does not enter."""
    overlap_px: int = 64
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
    lines, size = z_mm.shape
    if not np.isfinite(z_mm).any():
        return Smoothed(z_mm.copy(), sigma_mm.copy())
    # Neighbouring points share their error, so that each brings only its share of news.
    variance = np.where(np.isfinite(z_mm), sigma_mm**2 * max(correlation_px, 1.0), np.inf)
    ends = np.zeros_like(starts)
    ends[:, :-1] = _next_start(starts, np.isfinite(z_mm))
    span = -(-size // _PIECES)
    run_in = min(settings.overlap_px, size)
    forward = _lanes(z_mm, variance, process_mm2, starts, span, run_in)
    backward = _lanes(z_mm[:, ::-1], variance[:, ::-1], process_mm2[:, ::-1], ends[:, ::-1], span, run_in)
    both = (np.concatenate([f, b], axis=1) for f, b in zip(forward, backward, strict=True))
    state = _filter(*both, gate=settings.gate_sigma**2, run_in=run_in)
    half = state.shape[2] // 2
    # Filtered from the left, predicted from the right: each point counts once.
    left = _whole(state[0:5, :, :half], lines, span, size)
    right = _whole(state[5:10, :, half:], lines, span, size)[:, :, ::-1]
    return _fused(z_mm, left, right)


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


def _filter(z: F64, variance: F64, process: F64, starts: Bool, *, gate: float, run_in: int) -> F64:
    """Filtered (z, slope, p00, p01, p11), then the same predicted: (10, span, lane)."""
    steps, lanes = z.shape
    out = np.empty((10, steps - run_in, lanes))
    seen = np.isfinite(z)
    value = np.where(seen, z, 0.0)
    finite_variance = np.where(seen, variance, 1.0)
    any_start = starts.any(axis=1)
    height, slope = np.zeros(lanes), np.zeros(lanes)
    p00, p01, p11 = np.full(lanes, _WIDE), np.zeros(lanes), np.full(lanes, 1.0)
    missed = np.zeros(lanes)
    for k in range(steps):
        q11 = process[k]
        height = height + slope
        p00 = p00 + 2.0 * p01 + p11 + q11 / 3.0
        p01 = p01 + p11 + 0.5 * q11
        p11 = p11 + q11
        if any_start[k]:
            fresh = starts[k]
            p00 = np.where(fresh, _WIDE, p00)
            p01 = np.where(fresh, 0.0, p01)
            p11 = np.where(fresh, 1.0, p11)
        if k >= run_in:
            now = out[:, k - run_in]
            now[5], now[6], now[7], now[8], now[9] = height, slope, p00, p01, p11
        innovation = value[k] - height
        total = p00 + finite_variance[k]
        is_far = innovation * innovation > gate * total
        # After several refusals in a row it is the surface that has moved: start anew.
        missed = np.where(seen[k], np.where(is_far, missed + 1.0, 0.0), missed)
        lost = missed >= 3.0
        if lost.any():
            p00 = np.where(lost, _WIDE, p00)
            p01 = np.where(lost, 0.0, p01)
            p11 = np.where(lost, 1.0, p11)
            missed = np.where(lost, 0.0, missed)
            total = p00 + finite_variance[k]
            is_far = is_far & ~lost
        use = seen[k] & ~is_far
        gain = np.where(use, 1.0 / total, 0.0)
        g0, g1 = p00 * gain, p01 * gain
        height = height + g0 * innovation
        slope = slope + g1 * innovation
        p11 = p11 - g1 * p01
        p01 = p01 - g0 * p01
        p00 = p00 - g0 * p00
        # Rounding must not make a nearly known height negative after a wide start.
        p00 = np.maximum(p00, 1e-16)
        if k >= run_in:
            now[0], now[1], now[2], now[3], now[4] = height, slope, p00, p01, p11
    return out


def _whole(state: F64, lines: int, span: int, size: int) -> F64:
    """(entry, line, along) from (entry, span, line * piece)."""
    entries = state.shape[0]
    shaped = state.transpose(0, 2, 1).reshape(entries, lines, _PIECES * span)
    return np.asarray(shaped[:, :, :size])


def _fused(z: F64, left: F64, right: F64) -> Smoothed:
    """Two independent estimates of (z, slope) at each point, weighed by their covariances."""
    lz, ls, l00, l01, l11 = left
    rz, rs, r00, r01, r11 = right
    # The backward slope runs the other way.
    rs, r01 = -rs, -r01
    s00, s01, s11 = l00 + r00, l01 + r01, l11 + r11
    det = np.maximum(s00 * s11 - s01 * s01, 1e-30)
    dz, ds = rz - lz, rs - ls
    gain0 = (l00 * s11 - l01 * s01) / det
    gain1 = (l01 * s00 - l00 * s01) / det
    fused = lz + gain0 * dz + gain1 * ds
    variance = np.maximum(l00 - gain0 * l00 - gain1 * l01, 1e-12)
    seen = np.isfinite(z)
    return Smoothed(np.where(seen, fused, np.nan), np.where(seen, np.sqrt(variance), np.nan))
