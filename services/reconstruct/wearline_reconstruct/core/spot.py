"""The centre spot: the bright dot on the middle line that anchors the line numbers."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from wearline_reconstruct.core.stripes import Image, Scale

_SHRINK = 4
_LEAST_EXCESS = 0.4
"""Light of the spot over that of its line on the same length, at least."""
_LEAST_NOISE = 7.0
"""And in robust standard deviations of that figure over the frame."""


@dataclass(frozen=True)
class Spot:
    """Where the spot is on the strip image."""

    along_px: float
    across_px: float
    excess: float
    """Light beyond that of an ordinary piece of line, as a multiple of it."""


@dataclass(frozen=True)
class Search:
    """Part of the strip image where the spot may be. [px]"""

    along_px: tuple[float, float]
    across_px: tuple[float, float]
    least_excess: float = _LEAST_EXCESS
    """Weaker ones are not the spot of this head."""


def find_spots(strip: Image, scale: Scale, search: Search | None = None, most: int = 4) -> list[Spot]:
    """Candidates for the centre spot, the strongest first.

    The mean over a box one pitch high holds exactly one line wherever it lies, so that it is flat
    over the pattern; what stands out compactly from it is the spot (or a glint).
    """
    pitch = scale.pitch_px if np.isfinite(scale.pitch_px) else 16.0 * scale.width_px
    if search is not None:
        return _within(strip, search, pitch, most)
    return _candidates(strip, pitch, None, most)


def _candidates(strip: Image, pitch: float, search: Search | None, most: int) -> list[Spot]:
    small = cv2.resize(strip, None, fx=1.0 / _SHRINK, fy=1.0 / _SHRINK, interpolation=cv2.INTER_AREA)
    small = small.astype(np.float32)
    unit = pitch / _SHRINK
    period = max(round(unit), 1)
    length = max(round(max(0.35 * unit, 3.0)), 1)
    light = cv2.blur(small, (period, length), borderType=cv2.BORDER_REFLECT_101)
    size = round(4.5 * unit) | 1
    opened = cv2.morphologyEx(light, cv2.MORPH_OPEN, np.ones((size, size), np.uint8), borderType=cv2.BORDER_REPLICATE)
    excess = light - cv2.blur(opened, (period, period))
    ambient = cv2.erode(small, np.ones((1, period | 1), np.uint8))
    line_light = max(float(np.percentile((light - cv2.blur(ambient, (period, length)))[::3, ::4], 70)), 1e-3)
    sparse = excess[::3, ::3]
    noise = float(np.median(np.abs(sparse - np.median(sparse)))) / 0.6745
    share = _LEAST_EXCESS if search is None else search.least_excess
    least = max(share * line_light, _LEAST_NOISE * noise, 0.1)
    # The flank of something bright outside the search is no spot inside it.
    is_top = np.asarray(excess >= cv2.dilate(excess, np.ones((3, 3), np.uint8)))
    allowed = is_top.astype(np.uint8)
    if search is not None:
        inside = np.zeros_like(allowed)
        a0, a1 = (int(v / _SHRINK) for v in search.along_px)
        c0, c1 = (int(v / _SHRINK) for v in search.across_px)
        inside[max(a0, 0) : max(a1 + 1, 0), max(c0, 0) : max(c1 + 1, 0)] = 1
        allowed &= inside
    found: list[Spot] = []
    for _ in range(most):
        if not allowed.any():
            break
        _, value, _, (across, along) = cv2.minMaxLoc(excess, allowed)
        if value < least:
            break
        place, radius = _blob(excess, along, across, round(4.0 * unit))
        at, over = ((v + 0.5) * _SHRINK for v in place)
        # A spot broader than the pitch drowns its own line: nothing sharper is to be had than its middle.
        if radius > 0.75 * unit:
            found.append(Spot(at, over, value / line_light))
        else:
            found.append(_located(strip, pitch, at, over, value / line_light))
        reach = round(max(unit, 2.0 * radius)) + 1
        allowed[max(along - reach, 0) : along + reach + 1, max(across - reach, 0) : across + reach + 1] = 0
    return found


def _blob(excess: Image, along: int, across: int, reach: int) -> tuple[tuple[float, float], float]:
    """Centroid (along, across) of what is above half of a top, and the radius of a disc of that size."""
    a0, c0 = max(along - reach, 0), max(across - reach, 0)
    window = excess[a0 : along + reach + 1, c0 : across + reach + 1]
    half = 0.5 * float(excess[along, across])
    _, label = cv2.connectedComponents((window > half).astype(np.uint8), connectivity=4)
    mine = label == label[along - a0, across - c0]
    weight = np.where(mine, window - half, 0.0).astype(np.float64)
    total = max(float(weight.sum()), 1e-9)
    centre = (
        a0 + float(weight.sum(axis=1) @ np.arange(weight.shape[0])) / total,
        c0 + float(weight.sum(axis=0) @ np.arange(weight.shape[1])) / total,
    )
    return centre, float(np.sqrt(mine.sum() / np.pi))


_MARGIN_PITCHES = 6.0
"""What the statistics of the light need about the part that is searched."""


def _within(strip: Image, search: Search, pitch: float, most: int) -> list[Spot]:
    """As `find_spots`, with no more than the neighbourhood of the search touched."""
    windows = []
    for (low, high), size in ((search.along_px, strip.shape[0]), (search.across_px, strip.shape[1])):
        begin = int(max(low - _MARGIN_PITCHES * pitch, 0.0)) // _SHRINK * _SHRINK
        windows.append(slice(begin, int(max(min(high + _MARGIN_PITCHES * pitch + 1.0, size), begin))))
    along, across = windows
    part = strip[along, across]
    if min(part.shape) < 4 * _SHRINK:
        return []
    inside = Search(
        (search.along_px[0] - along.start, search.along_px[1] - along.start),
        (search.across_px[0] - across.start, search.across_px[1] - across.start), search.least_excess,
    )  # fmt: skip
    return [
        Spot(s.along_px + along.start, s.across_px + across.start, s.excess)
        for s in _candidates(part, pitch, inside, most)
    ]


def _located(strip: Image, pitch: float, along: float, across: float, excess: float) -> Spot:
    """The brightest blob near a coarse place, by the centroid of its squared light."""
    for reach in (0.75 * pitch, 0.5 * pitch):
        a0, c0 = max(int(along - reach), 0), max(int(across - reach), 0)
        window = strip[a0 : int(along + reach) + 1, c0 : int(across + reach) + 1].astype(np.float32)
        if window.size < 9:
            break
        window = np.asarray(cv2.GaussianBlur(window, (0, 0), max(pitch / 12.0, 1.0)), np.float32)
        # What a line leaves without its spot: the lowest along the line.
        window -= np.percentile(window, 25, axis=0)[None, :]
        weight = np.maximum(window - 0.3 * float(window.max()), 0.0) ** 2
        total = float(weight.sum())
        if total <= 0.0:
            break
        along = a0 + float((weight.sum(axis=1) @ np.arange(weight.shape[0])) / total)
        across = c0 + float((weight.sum(axis=0) @ np.arange(weight.shape[1])) / total)
    return Spot(along, across, excess)
