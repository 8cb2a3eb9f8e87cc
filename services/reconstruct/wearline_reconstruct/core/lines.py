"""Lines: peaks joined from column to column into fragments, and the noise of their positions.

A fragment is a piece of one laser line without a break: gaps of a few columns are bridged, short
branches and single peaks are noise and go (section 4.4.2 of the thesis), and where the line jumps
the fragment ends, because what goes on beyond the jump may be another line.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline.config import Settings
from wearline_reconstruct.core.stripes import F32, F64, I64, Bool, Peaks, Scale

I32 = NDArray[np.int32]


class LineSettings(Settings):
    """How peaks become fragments."""

    bridge_px: int = 6
    """Longest gap that is bridged along a line. [px]"""
    shortest_px: int = 12
    """Shorter fragments are noise. [px]"""
    break_sigma: float = 5.0
    """A line breaks where the two sides of a point disagree by this many standard deviations."""


@dataclass(frozen=True)
class Fragments:
    """Peaks of fragments, ordered by fragment, then along; arrays are [n]."""

    peaks: Peaks
    label: I64
    """Fragment of each peak, 0 .. count - 1."""
    sigma_px: F32
    """Standard uncertainty of each peak's position. [px]"""
    correlation_px: float
    """Pixels along the line that share one independent error. [px]"""

    @property
    def count(self) -> int:
        return int(self.label[-1]) + 1 if len(self.label) else 0

    @property
    def first(self) -> I64:
        """Index of each fragment's first peak, and the end of the last."""
        return np.searchsorted(self.label, np.arange(self.count + 1))


def fragments(peaks: Peaks, scale: Scale, average_px: int, settings: LineSettings) -> Fragments:
    """Join the peaks of a frame into fragments."""
    label = _tracks(peaks, scale, settings)
    order, label = _longer(peaks, label, settings.shortest_px)
    peaks = peaks.take(order)
    sigma, length = position_noise(peaks, label, scale, average_px)
    broken, doubtful = _breaks(peaks, label, sigma, length, settings.break_sigma)
    label = label + np.cumsum(broken)
    keep = ~doubtful & ~_smeared_ends(peaks, label, average_px // 2)
    peaks, label, sigma = peaks.take(keep), label[keep], sigma[keep]
    order, label = _longer(peaks, label, max(settings.shortest_px // 2, 6))
    return Fragments(peaks.take(order), label, sigma[order], length)


def ordered_fragments(peaks: Peaks, label: I64, scale: Scale, average_px: int, shortest_px: int) -> Fragments:
    """Fragments from peaks that bear labels already, without the short ones."""
    order, label = _longer(peaks, label, shortest_px)
    peaks = peaks.take(order)
    sigma, length = position_noise(peaks, label, scale, average_px)
    return Fragments(peaks, label, sigma, length)


def _smeared_ends(peaks: Peaks, label: I64, reach: int) -> Bool:
    """Peaks beyond the true end of a line: averaging along it shows them there."""
    first = np.ones(len(label), bool)
    first[1:] = label[1:] != label[:-1]
    number = np.cumsum(first) - 1
    begin = peaks.along[first][number]
    end = peaks.along[np.flatnonzero(first)[1:] - 1] if len(label) else begin
    end = np.append(end, peaks.along[-1:])[number]
    size = int(peaks.along.max(initial=0))
    from_begin, to_end = peaks.along - begin, end - peaks.along
    return np.asarray(((from_begin < reach) & (begin > reach)) | ((to_end < reach) & (end < size - reach)))


def _tracks(peaks: Peaks, scale: Scale, settings: LineSettings) -> I64:
    """A label per peak: mutual nearest neighbours in the next column that has one."""
    n = len(peaks)
    reach = max(1.6, 0.9 * scale.width_px)
    if np.isfinite(scale.pitch_px):
        reach = min(reach, 0.3 * scale.pitch_px)
    along = peaks.along.astype(np.int64)
    across = peaks.across_px.astype(np.float64)
    stride = 1.0e5
    key = along * stride + across
    behind = np.full(n, -1, np.int64)
    ahead = np.full(n, -1, np.int64)
    for lag in range(1, settings.bridge_px + 2):
        free = np.flatnonzero(ahead < 0)
        if not len(free):
            break
        allowed = reach * (1.0 + 0.35 * (lag - 1))
        if lag == 1:
            partner = _nearest(key, along, across, free, lag, stride, allowed)
            back = _nearest(key, along, across, np.arange(n), -lag, stride, allowed)
        else:
            starts = np.flatnonzero(behind < 0)
            back = np.full(n, -1, np.int64)
            sub = _nearest_among(key, along, across, free, starts, lag, stride, allowed)
            back[starts] = _nearest_among(key, along, across, starts, free, -lag, stride, allowed)
            partner = sub
        found = partner >= 0
        source, target = free[found], partner[found]
        mutual = back[target] == source
        source, target = source[mutual], target[mutual]
        ahead[source] = target
        behind[target] = source
    # Pointer jumping: every peak ends at the first peak of its chain.
    root = np.where(behind < 0, np.arange(n), behind)
    while True:
        further = root[root]
        if np.array_equal(further, root):
            return root
        root = further


def _nearest(key: F64, along: I64, across: F64, wanted: I64, lag: int, stride: float, allowed: float) -> I64:
    return _nearest_among(key, along, across, wanted, None, lag, stride, allowed)


def _nearest_among(
    key: F64, along: I64, across: F64, wanted: I64, pool: I64 | None, lag: int, stride: float, allowed: float
) -> I64:
    """For each wanted peak the nearest of the pool ``lag`` columns on, or -1."""
    keys = key if pool is None else key[pool]
    if not len(keys) or not len(wanted):
        return np.full(len(wanted), -1, np.int64)
    goal = key[wanted] + lag * stride
    right = np.searchsorted(keys, goal)
    left = np.maximum(right - 1, 0)
    right = np.minimum(right, len(keys) - 1)
    near_right, near_left = np.abs(keys[right] - goal), np.abs(keys[left] - goal)
    best = np.where(near_right < near_left, right, left)
    # The stride is far larger than any picture, so that a small distance means the right column.
    best_index = best if pool is None else pool[best]
    return np.where(np.minimum(near_right, near_left) < allowed, best_index, -1)


def _longer(peaks: Peaks, label: I64, shortest: int) -> tuple[I64, I64]:
    """Order by label, then along, without labels that hold fewer peaks; labels counted from 0."""
    if not len(label):
        return np.zeros(0, np.int64), label
    count = np.bincount(label)
    is_long = count >= shortest
    number = np.cumsum(is_long) - 1
    kept = np.flatnonzero(is_long[label])
    dense = number[label[kept]]
    # Peaks come ordered along the lines, so that a stable sort by label is enough; 16 bit sort in linear time.
    if len(dense) and dense.max() < 2**16:
        dense = dense.astype(np.uint16)
    order = kept[np.argsort(dense, kind="stable")]
    return order, number[label[order]]


def position_noise(peaks: Peaks, label: I64, scale: Scale, average_px: int) -> tuple[F32, float]:
    """Standard uncertainty of each position, and the length over which errors are alike, from the frame itself.

    Third differences over a distance at which errors are independent cancel any smooth shape up to
    a parabola. Their spread, in classes of signal, gives ``v = v_speckle + v_noise / signal^2``.
    """
    lag = average_px + max(3, round(1.2 * scale.width_px))
    n = len(label)
    fallback = 0.06 * scale.width_px
    if n <= 3 * lag:
        return np.full(n, fallback, np.float32), float(lag)
    y = peaks.across_px.astype(np.float64)
    same = (label[3 * lag :] == label[: -3 * lag]) & (peaks.along[3 * lag :] - peaks.along[: -3 * lag] == 3 * lag)
    third = (y[3 * lag :] - 3.0 * y[2 * lag : -lag] + 3.0 * y[lag : -2 * lag] - y[: -3 * lag])[same]
    if len(third) < 60:
        return np.full(n, fallback, np.float32), float(lag)
    signal = peaks.signal_dn[lag : n - 2 * lag][same].astype(np.float64)
    step = max(1, len(third) // 8000)
    third, signal = third[::step], signal[::step]
    edges = np.percentile(signal, np.linspace(0, 100, 7))
    rows, values = [], []
    for low, high in pairwise(edges):
        chosen = (signal >= low) & (signal <= high)
        if chosen.sum() < 10:
            continue
        spread = np.median(np.abs(third[chosen])) / 0.6745
        rows.append([1.0, float(np.mean(1.0 / np.maximum(signal[chosen], 0.5) ** 2))])
        values.append(spread * spread / 20.0)
    design, variance = np.array(rows), np.array(values)
    weight = 1.0 / np.maximum(variance, 1e-8)
    solved, *_ = np.linalg.lstsq(design * weight[:, None], variance * weight, rcond=None)
    flat = float(np.median(variance))
    steady, noisy = float(solved[0]), float(solved[1])
    if noisy < 0.0:
        steady, noisy = flat, 0.0
    elif steady < 0.05 * flat:
        steady = 0.05 * flat
        noisy = float(np.median((variance - steady) / design[:, 1]).clip(0.0))
    strength = np.maximum(peaks.signal_dn, 0.5).astype(np.float64)
    sigma = np.sqrt(steady + noisy / (strength * strength) + 1e-6)
    sigma[peaks.is_saturated] *= 1.5
    return sigma.astype(np.float32), _error_length(y, label, peaks.along, average_px, lag)


def _error_length(y: F64, label: I64, along: I32, average_px: int, lag: int) -> float:
    """Variance of sums of neighbouring errors over that of independent ones, from second differences."""
    ratio = float(average_px)
    reach = 4 * lag
    if len(y) <= 4 * reach:
        return ratio
    total = np.concatenate([[0.0], np.cumsum(y)])

    def spread(block: int, step: int) -> float:
        mean = (total[block:] - total[:-block]) / block
        last = len(mean) - 3 * step
        if last < 50:
            return float("nan")
        same = (label[3 * step + block - 1 :][:last] == label[:last]) & (
            along[3 * step + block - 1 :][:last] - along[:last] == 3 * step + block - 1
        )
        third = (mean[3 * step :] - 3 * mean[2 * step : -step] + 3 * mean[step : -2 * step] - mean[: -3 * step])[same]
        third = third[:: max(1, len(third) // 8000)]
        return float(np.median(np.abs(third)) ** 2) if len(third) > 50 else float("nan")

    block = 2 * lag
    point, blocked = spread(1, block + lag), spread(block, block + lag)
    if not np.isfinite(point) or not np.isfinite(blocked) or point <= 0.0:
        return ratio
    return float(np.clip(block * blocked / point, ratio, 2.5 * lag))


def _breaks(peaks: Peaks, label: I64, sigma: F32, length: float, limit: float) -> tuple[Bool, Bool]:
    """Where a new fragment starts within one (jump), and which peaks lie within the smear of a jump."""
    n = len(label)
    broken, doubtful = np.zeros(n, bool), np.zeros(n, bool)
    m, guard = max(12, round(2.0 * length)), max(2, round(0.45 * length))
    if n <= 2 * (m + guard) + 1:
        return broken, doubtful
    y = peaks.across_px.astype(np.float64)
    index = np.arange(n, dtype=np.float64)
    # Straight lines through m points on either side of the guard zone, compared at the middle.
    sums = np.concatenate([[0.0], np.cumsum(y)])
    moments = np.concatenate([[0.0], np.cumsum(index * y)])
    i = np.arange(m + guard, n - m - guard)

    def line_at(first: I64, count: int, at: I64) -> F64:
        mean = (sums[first + count] - sums[first]) / count
        centre = first + 0.5 * (count - 1)
        slope = ((moments[first + count] - moments[first]) - centre * (sums[first + count] - sums[first])) / (
            count * (count * count - 1.0) / 12.0
        )
        return np.asarray(mean + slope * (at - centre))

    def jump_at(at: I64, count: int) -> F64:
        return line_at(at + guard, count, at) - line_at(at - guard - count + 1, count, at)

    jump = jump_at(i, m)
    distance = 0.5 * (m - 1) + guard
    variance = 2.0 * sigma[i].astype(np.float64) ** 2 * length * (1.0 / m + distance**2 / (m * (m * m - 1.0) / 12.0))
    whole = label[i + guard + m - 1] == label[i - guard - m + 1]
    excess = np.where(whole, np.abs(jump) / np.sqrt(variance), 0.0)
    # Bends give smooth, broad excess; a jump stands out as a local maximum.
    span = guard + m // 2
    highest = cv2.dilate(excess[None], np.ones((1, 2 * span + 1), np.uint8))[0]
    peak = np.flatnonzero((excess > limit) & (excess >= highest) & (np.abs(jump) > 0.35))
    if not len(peak):
        return broken, doubtful
    # Seen from close by, a jump is as high as from afar; what is left of a wall's bend is a tenth.
    near = jump_at(i[peak], max(m // 3, 6))
    peak = peak[np.abs(near) > 0.5 * np.abs(jump[peak])]
    at = i[peak]
    broken[at] = True
    for offset in range(-guard - 1, guard + 1):
        doubtful[np.clip(at + offset, 0, n - 1)] = True
    return broken, doubtful
