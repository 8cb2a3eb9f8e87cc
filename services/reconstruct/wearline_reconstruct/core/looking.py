"""Stripes of any picture, without a calibration: the scale is tried out, and what is no stripe goes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from wearline_reconstruct.core.lines import Fragments, LineSettings, fragments
from wearline_reconstruct.core.stripes import (
    F64,
    Bool,
    Image,
    Scale,
    StripeSettings,
    estimate_scale,
    period_of,
    stripe_peaks,
)

_WIDTHS_PX = (1.5, 2.5, 4.0, 6.5, 10.0, 16.0)
_CLEARLY_BETTER = 2.0
"""A scale must be better than the estimated one by this factor to take its place."""
_LEAST_SHARE = 0.1
"""Fragments weaker than this share of the strong ones are texture or stray light."""
_SHORT_PX = 60.0
_LEAST_RIDGE = 0.35
"""And those whose brighter flank is not darker than the middle by this share of their height: they are edges."""
_ROUGHEST = 0.3
"""And those that jump from column to column by this share of their width."""


def any_stripes(strip: Image, stripes: StripeSettings, lines: LineSettings) -> tuple[Scale, Fragments]:
    """Scale and fragments of a strip image [along, across]; fragments are empty where there are no stripes.

    The estimate of the scale follows what is most frequent in the picture, which on a chessboard in
    daylight is not the laser line. So other widths are tried, and long, smooth, sharp and bright
    fragments count for them.
    """
    scale = estimate_scale(strip)
    found = _stripes_at(strip, scale, stripes, lines)
    best = _CLEARLY_BETTER * _score(found)
    for width in _WIDTHS_PX:
        if 0.7 < width / scale.width_px < 1.4:
            continue
        other = Scale(width, period_of(strip, width))
        try_out = _stripes_at(strip, other, stripes, lines)
        score = _score(try_out)
        if score > best:
            best, found = score, try_out
            scale = Scale(float(np.median(found.peaks.width_px)), other.pitch_px)
    return scale, found


def _stripes_at(strip: Image, scale: Scale, stripes: StripeSettings, lines: LineSettings) -> Fragments:
    peaks = stripe_peaks(strip, scale, stripes)
    found = fragments(peaks, scale, stripes.average_px, lines)
    if not found.count:
        return found
    found = _chosen(found, _is_ridge(strip, found))
    # Two rounds: the first one takes away what would hide how bright a stripe of this picture is.
    for _ in range(2):
        if found.count:
            found = _chosen(found, _is_stripe(found, scale))
    return found


def _is_ridge(strip: Image, found: Fragments) -> Bool:
    """[fragment]: darker on both sides."""
    near = cv2.blur(strip, (3, 7)).astype(np.float32)
    along = found.peaks.along.astype(np.int64)
    middle = np.rint(found.peaks.across_px).astype(np.int64)
    away = np.rint(2.5 * found.peaks.width_px + 1.0).astype(np.int64)
    last = strip.shape[1] - 1
    left, top, right = (near[along, np.clip(middle + k * away, 0, last)] for k in (-1, 0, 1))
    rise = _mean(found, (top - np.maximum(left, right)).astype(np.float64))
    height = _mean(found, (top - np.minimum(left, right)).astype(np.float64))
    return np.asarray(rise > _LEAST_RIDGE * np.maximum(height, 1e-6))


def _is_stripe(found: Fragments, scale: Scale) -> Bool:
    """[fragment]: as bright as the others, and smooth."""
    size = np.bincount(found.label)
    signal = _mean(found, found.peaks.signal_dn.astype(np.float64))
    order = np.argsort(signal)
    reached = np.cumsum(size[order]) >= 0.8 * size.sum()
    strong = float(signal[order][reached][0])
    across = found.peaks.across_px.astype(np.float64)
    same = found.label[2:] == found.label[:-2]
    bend = np.abs(across[2:] - 2.0 * across[1:-1] + across[:-2])[same]
    rough = np.bincount(found.label[1:-1][same], weights=bend, minlength=found.count) / np.maximum(
        np.bincount(found.label[1:-1][same], minlength=found.count), 1
    )
    # What is short as well must be brighter to be believed.
    least = _LEAST_SHARE * np.maximum(_SHORT_PX / size, 1.0)
    return np.asarray((signal > least * strong) & (rough < _ROUGHEST * max(scale.width_px, 2.0)))


def _mean(found: Fragments, values: F64) -> F64:
    return np.bincount(found.label, weights=values) / np.bincount(found.label)


def _chosen(found: Fragments, keep: Bool) -> Fragments:
    mine = keep[found.label]
    number = np.cumsum(keep) - 1
    return replace(found, peaks=found.peaks.take(mine), label=number[found.label[mine]], sigma_px=found.sigma_px[mine])


def _score(found: Fragments) -> float:
    """How much a picture looks like stripes at one scale: length counts more than number, sharpness as brightness."""
    if not found.count:
        return 0.0
    size = np.bincount(found.label).astype(np.float64)
    sharp = _mean(found, (found.peaks.signal_dn / np.maximum(found.peaks.width_px, 0.8)).astype(np.float64))
    return float((size**1.5 * sharp).sum())


def drawn(picture: Image, found: Fragments, is_vertical: bool) -> Image:
    """The picture [row, col] with each fragment in a colour of its own, broad enough to be seen when it is shrunk."""
    grey = np.clip(picture.astype(np.float32) * 0.75, 0, 255).astype(np.uint8)
    canvas = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    hue = (np.arange(max(found.count, 1)) * 67 % 180).astype(np.uint8)
    full = np.full_like(hue, 255)
    colours = cv2.cvtColor(np.stack([hue, full, full], axis=1)[None], cv2.COLOR_HSV2BGR)[0]
    across = np.rint(found.peaks.across_px).astype(np.int64)
    along = found.peaks.along.astype(np.int64)
    reach = 0 if max(picture.shape) < 1000 else 1
    for shift in range(-reach, reach + 1):
        row, col = (along, across + shift) if is_vertical else (across + shift, along)
        inside = (row >= 0) & (row < canvas.shape[0]) & (col >= 0) & (col < canvas.shape[1])
        canvas[row[inside], col[inside]] = colours[found.label[inside]]
    return np.asarray(canvas)
