"""The thesis' own method (chapter 4), so that ours can stand beside it on the same frames.

Extraction (4.2): 5 x 5 mean filter, comparison with the local mean, middle pixel of each run. The bare
local mean of equation 4-3 fires on half of an even background, so that the least offset of our own
extraction is added to it. Search (4.4.2): a line goes on at the first of ten positions that holds a
point (figure 4.10), and short lines go. Heights by equation 4-6, from our calibration and line
numbers. Spatial Kalman filter (4.5.2): each height is estimated anew from its neighbours along and
across the lines. Equation 4-8 is wrong (its numerator is that of a product), but what 4-19 and 4-20
add to a neighbour's height is the difference of two heights by 4-6, so that the measured value z0 is
the point's own height, whatever the neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from wearline.config import Settings
from wearline_reconstruct.core.lines import Fragments, ordered_fragments
from wearline_reconstruct.core.stripes import F64, Image, Peaks, Scale, StripeSettings, background_offset, run_peaks

_POSITIONS = ((1, 0), (1, -1), (1, 1), (2, 0), (2, -1), (2, 1), (3, 0), (3, -1), (3, 1), (4, 0))
"""Along and across, in the order of figure 4.10."""
_QUANTUM_PX = 12.0**-0.5
"""Standard deviation of a position that is rounded to whole pixels. [px]"""


class ThesisSettings(Settings):
    """Figures that the thesis leaves to its user."""

    mean_px: int = 5
    """Edge of the mean filter. [px]"""
    shortest_px: int = 12
    """Shorter lines are noise. [px]"""
    iterations: int = 5
    """Of the Kalman filter; table 5.4 was made with five."""


def thesis_peaks(strip: Image, scale: Scale, stripes: StripeSettings, settings: ThesisSettings) -> Peaks:
    """Middle pixels of the runs above the local mean, of a strip image [along, across]."""
    near = cv2.blur(strip, (settings.mean_px, settings.mean_px), borderType=cv2.BORDER_REPLICATE)
    around, offset, noise = background_offset(near, scale, stripes)
    return run_peaks(near, around, offset, noise)


def thesis_fragments(peaks: Peaks, scale: Scale, settings: ThesisSettings) -> Fragments:
    """Follow each line from column to column."""
    along = peaks.along.astype(np.int64)
    across = np.floor(peaks.across_px).astype(np.int64)
    reach = max(step for step, _ in _POSITIONS)
    label = np.arange(len(peaks))
    columns = int(along.max(initial=-1)) + 1
    first = np.searchsorted(along, np.arange(columns + 1))
    owner = np.full((columns + reach, int(across.max(initial=0)) + 3), -1, np.int64)
    for column in range(columns):
        mine = slice(first[column], first[column + 1])
        place = across[mine] + 1
        came = np.full(len(place), -1, np.int64)
        for step, aside in _POSITIONS:
            before = owner[column - step, place - aside] if column >= step else came
            came = np.where(came < 0, before, came)
        # Two points that would follow one: the nearer in the order of search keeps it.
        fresh = came < 0
        came[fresh] = label[mine][fresh]
        _, index = np.unique(came, return_index=True)
        again = np.ones(len(came), bool)
        again[index] = False
        came[again] = label[mine][again]
        label[mine] = came
        owner[column, place] = came
    return ordered_fragments(peaks, label, scale, settings.mean_px, settings.shortest_px)


@dataclass(frozen=True)
class Filtered:
    """What the iterations left."""

    z_mm: F64
    """(line, along). [mm]"""
    variance_mm2: list[float]
    """The filter's own variance after each iteration, as figure 5.12 plots it. [mm^2]"""


def spatial_kalman(z_mm: F64, noise_mm: float, iterations: int) -> Filtered:
    """Equations 4-17 to 4-23 on the net of points (line, along); NaN = no point.

    In one iteration each point is adjusted by its four neighbours in turn, all points at once. Without
    process noise (the thesis has none) the variance falls with the number of updates and the gain goes
    to 0, so that more iterations smear the surface across the lines ever further.
    """
    measured = np.isfinite(z_mm)
    height, noise = z_mm.copy(), noise_mm * noise_mm
    variance, course = noise, []
    for _ in range(iterations):
        for axis, step in ((1, 1), (1, -1), (0, 1), (0, -1)):
            before = _shifted(height, axis, step)
            prior = np.where(np.isfinite(before), before, height)
            gain = variance / (variance + noise)
            height = np.where(measured, prior + gain * (z_mm - prior), np.nan)
            variance = (1.0 - gain) * variance
        course.append(variance)
    return Filtered(height, course)


def _shifted(values: F64, axis: int, step: int) -> F64:
    """The neighbour of each point; NaN beyond the rim."""
    moved = np.roll(values, step, axis)
    rim: list[slice | int] = [slice(None), slice(None)]
    rim[axis] = 0 if step > 0 else -1
    moved[tuple(rim)] = np.nan
    return moved


def rounding_mm(slope_mm_per_px: F64, sigma_px: F64) -> F64:
    """Standard uncertainty of a height whose position is a whole pixel. [mm]"""
    return np.asarray(np.abs(slope_mm_per_px) * np.maximum(sigma_px, _QUANTUM_PX))
