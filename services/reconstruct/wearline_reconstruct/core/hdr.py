"""More range than one exposure has: peaks of several exposures merged, and the flanks of what is saturated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from wearline_reconstruct.core.stripes import F32, Image, Peaks, Scale, StripeSettings

MOST_EXPOSURES = 3


def merged_peaks(exposures: Sequence[Peaks], scale: Scale) -> Peaks:
    """Of each stripe the peak of the exposure that shows it best: the brightest that is not saturated.

    The part must rest between the exposures. Nothing is said or needed of their times.
    """
    order = np.lexsort(
        (np.concatenate([p.across_px for p in exposures]), np.concatenate([p.along for p in exposures]))
    )  # fmt: skip
    peaks = Peaks(
        along=np.concatenate([p.along for p in exposures])[order],
        across_px=np.concatenate([p.across_px for p in exposures])[order],
        signal_dn=np.concatenate([p.signal_dn for p in exposures])[order],
        width_px=np.concatenate([p.width_px for p in exposures])[order],
        background_dn=np.concatenate([p.background_dn for p in exposures])[order],
        is_saturated=np.concatenate([p.is_saturated for p in exposures])[order],
        noise_dn=float(np.median([p.noise_dn for p in exposures])),
    )
    if not len(peaks):
        return peaks
    # Peaks of one stripe follow each other closely; saturated ones are broader and lie where they like within it.
    fresh = np.ones(len(peaks), bool)
    fresh[1:] = (peaks.along[1:] != peaks.along[:-1]) | (np.diff(peaks.across_px) > 1.2 * scale.width_px)
    stripe = np.cumsum(fresh) - 1
    merit = np.where(peaks.is_saturated, -1.0, peaks.signal_dn)
    best = np.lexsort((merit, stripe))
    last = np.flatnonzero(np.append(np.diff(stripe[best]) > 0, True))
    return peaks.take(best[last])


def flank_centres(strip: Image, peaks: Peaks, scale: Scale, settings: StripeSettings) -> Peaks:
    """Saturated peaks moved to the middle between their flanks at half height.

    A clipped top says nothing of the centre, and a bloomed stripe is broader than the window that
    suits the others. Peaks without two clear flanks stay as they are.
    """
    chosen = np.flatnonzero(peaks.is_saturated)
    if not len(chosen):
        return peaks
    pitch = scale.pitch_px if np.isfinite(scale.pitch_px) else 20.0 * scale.width_px
    half = int(min(max(6.0 * scale.width_px, 8.0), 0.48 * pitch))
    averaged = cv2.boxFilter(strip, cv2.CV_32F, (1, settings.average_px | 1), borderType=cv2.BORDER_REPLICATE)
    middle = np.rint(peaks.across_px[chosen]).astype(np.int64)
    offset = np.arange(-half, half + 1)
    window = averaged[peaks.along[chosen][:, None].astype(np.int64), np.clip(middle[:, None] + offset, 0,
                                                                             strip.shape[1] - 1)]  # fmt: skip
    level = 0.5 * (peaks.background_dn[chosen] + window[:, half])
    right = _crossing(window[:, half:], level)
    left = _crossing(window[:, half::-1], level)
    found = np.isfinite(left) & np.isfinite(right)
    across = peaks.across_px.copy()
    width = peaks.width_px.copy()
    across[chosen[found]] = (middle + 0.5 * (right - left)).astype(np.float32)[found]
    width[chosen[found]] = ((left + right) / 2.35482).astype(np.float32)[found]
    return replace(peaks, across_px=across, width_px=width)


def _crossing(profile: F32, level: F32) -> F32:
    """Distance from the first sample at which each profile [n, k] falls through its level; NaN = it does not. [px]"""
    below = profile < level[:, None]
    first = np.argmax(below, axis=1)
    index = np.arange(len(profile))
    before, after = profile[index, np.maximum(first - 1, 0)], profile[index, first]
    share = (before - level) / np.maximum(before - after, 1e-3)
    return np.asarray(np.where(below.any(axis=1) & (first > 0), first - 1 + share, np.nan), np.float32)
