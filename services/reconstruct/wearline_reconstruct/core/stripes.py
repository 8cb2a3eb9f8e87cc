"""Stripe peaks: where the laser lines lie in a frame, sub-pixel, column by column.

Everything works on a *strip image* ``[along, across]``: the first axis runs along the laser lines,
the second across them (a frame with horizontal lines is transposed, one with vertical lines is
taken as it is), so that the pixels of one cross section are neighbours in memory.

Extraction follows chapter 4.4 of the thesis (mean filter, comparison with the local mean) up to the
runs of stripe pixels. Their centres are then refined by the centroid of the square root of the
background-free intensity: laser speckle is multiplicative, so the flanks say as much about the
centre as the top does, and the root weighs them nearly as the best linear estimate would.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline.config import Settings

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]
Image = NDArray[Any]

_CHUNK = 4096  # points whose windows fit the second-level cache
_FULL_WIDTH = 2.35482  # full width at half maximum over the Gaussian sigma


class StripeSettings(Settings):
    """How stripes are extracted."""

    average_px: int = 7
    """Pixels averaged along the lines before extraction (odd). [px]"""
    threshold_noise: float = 5.0
    """A stripe rises above the local mean by this many standard deviations of the background."""
    threshold_dn: float = 1.5
    """And at least by this. [DN of an 8-bit frame]"""


@dataclass(frozen=True)
class Scale:
    """What stripes look like in one head's frames."""

    width_px: float
    """Gaussian sigma of a stripe. [px]"""
    pitch_px: float
    """Distance between neighbouring stripes; infinite for a single one. [px]"""


@dataclass(frozen=True)
class Peaks:
    """Stripe peaks of a frame, ordered by `along`, then `across_px`; arrays are [n]."""

    along: NDArray[np.int32]
    """Pixel along the lines."""
    across_px: F32
    """Sub-pixel centre across the lines. [px]"""
    signal_dn: F32
    """Height above the background. [DN]"""
    width_px: F32
    """Gaussian sigma of the profile. [px]"""
    background_dn: F32
    """[DN]"""
    is_saturated: Bool
    noise_dn: float
    """Standard deviation of the background of the averaged image. [DN]"""

    def __len__(self) -> int:
        return len(self.along)

    def take(self, keep: NDArray[Any]) -> Peaks:
        """Some of the peaks, by mask or index."""
        return Peaks(
            self.along[keep], self.across_px[keep], self.signal_dn[keep], self.width_px[keep],
            self.background_dn[keep], self.is_saturated[keep], self.noise_dn,
        )  # fmt: skip


def strip_image(pixels: Image, is_vertical: bool) -> Image:
    """The frame [row, col] as a strip image [along, across], contiguous."""
    return np.ascontiguousarray(pixels) if is_vertical else cv2.transpose(np.ascontiguousarray(pixels))


def estimate_scale(strip: Image) -> Scale:
    """Stripe width and pitch from the picture itself.

    The width is the scale at which the difference of two means is strongest on the strongest
    ridges, refined by the runs above half height; the pitch is the usual distance of neighbours.
    """
    step = max(1, strip.shape[0] // 160)
    sample = _averaged(strip, 7)[::step]
    across = strip.shape[1]
    best, best_width = 0.0, 2.0
    for width in (1.2, 1.8, 2.7, 4.0, 6.0, 9.0, 13.5, 20.0, 30.0):
        inner, outer = _odd(2.0 * width), _odd(6.0 * width)
        if outer >= across:
            break
        ridge = cv2.blur(sample, (inner, 1)) - cv2.blur(sample, (outer, 1))
        # Strongest ridges of each cross section, so that one bright corner does not decide.
        top = np.partition(ridge[:, :: max(1, inner // 3)], -3, axis=1)[:, -3:]
        score = float(np.median(top)) + 0.25 * float(np.mean(top))
        if score > 1.04 * best:
            best, best_width = score, width
    width, pitch = best_width, float("inf")
    for _ in range(2):
        width, pitch = _measured_scale(sample, width, pitch)
    return Scale(float(np.clip(width, 0.8, 40.0)), pitch)


def _measured_scale(sample: F32, width: float, pitch: float) -> tuple[float, float]:
    window = _odd(min(pitch, 10.0 * width))
    near = cv2.blur(sample, (_odd(width), 1))
    rise = near - cv2.blur(sample, (window, 1))
    level = 4.0 * _background_noise(rise, near, width)
    where, start, stop = _runs((rise > max(level, 0.02 * float(np.ptp(rise)))).astype(np.uint8))
    found = _period(rise, width)
    if len(start) < 8:
        return width, found
    middle = (start + stop) // 2
    height = rise[where, np.clip(middle, 0, sample.shape[1] - 1)]
    strong = height > 0.4 * np.percentile(height, 90)
    where, middle = where[strong], middle[strong]
    half = int(min(max(3.0 * width, 6), 0.5 * min(found, 1e6)))
    offset = np.arange(-half, half + 1)
    index = np.clip(middle[:, None] + offset, 0, sample.shape[1] - 1)
    profile = sample[where[:, None], index]
    low = np.percentile(profile, 15, axis=1)[:, None]
    top = profile[:, max(half - 1, 0) : half + 2].max(axis=1)[:, None]
    # Area over height: speckle splits the half-height run, but leaves the area.
    area = np.maximum(profile - low, 0.0).sum(axis=1) / np.maximum(top - low, 1e-3)[:, 0]
    above = profile - low > 0.5 * (top - low)
    right = np.cumprod(above[:, half:], axis=1).sum(axis=1)
    left = np.cumprod(above[:, half::-1], axis=1).sum(axis=1)
    run = (right + left - 1) / _FULL_WIDTH
    measured = float(np.median(np.maximum(run, np.minimum(area / 2.50663, 1.3 * run))))
    return max(measured, 0.8), found


def period_of(strip: Image, width: float) -> float:
    """Distance of neighbouring stripes of a known width; infinite without one. [px]"""
    sample = _averaged(strip, 7)[:: max(1, strip.shape[0] // 160)]
    near = cv2.blur(sample, (_odd(width), 1))
    return _period(near - cv2.blur(sample, (_odd(10.0 * width), 1)), width)


def _period(rise: F32, width: float) -> float:
    """Distance of neighbouring stripes from the autocorrelation across the lines; infinite without one."""
    across = rise.shape[1]
    spectrum = np.fft.rfft(np.maximum(rise, 0.0) - np.maximum(rise, 0.0).mean(axis=1, keepdims=True), 2 * across)
    alike = np.fft.irfft((np.abs(spectrum) ** 2).mean(axis=0))[: across // 2]
    alike = alike / max(float(alike[0]), 1e-9)
    shortest = max(int(3.0 * width), 4)
    valley = alike[1:-1] < alike[2:]
    rising = np.flatnonzero(valley[shortest // 2 :])
    if not len(rising):
        return float("inf")
    first = int(rising[0]) + shortest // 2
    tops = np.flatnonzero((alike[1:-1] >= alike[:-2]) & (alike[1:-1] > alike[2:])) + 1
    tops = tops[tops > max(first, shortest - 1)]
    if not len(tops):
        return float("inf")
    best = float(alike[tops].max())
    if best < 0.12:
        return float("inf")
    # The first top that is nearly as high as the highest: multiples of the pitch are as high.
    return float(tops[np.argmax(alike[tops] > 0.6 * best)])


def _odd(size: float) -> int:
    return 2 * max(round(0.5 * (size - 1.0)), 0) + 1


def _averaged(strip: Image, size: int) -> F32:
    return np.asarray(cv2.boxFilter(strip, cv2.CV_32F, (1, size), borderType=cv2.BORDER_REPLICATE))


def _background_noise(rise: Image, near: Image, width: float) -> float:
    """Standard deviation of the background over a stripe's width: noise of the sensor and texture of the part.

    ``near`` is the averaged image, ``rise`` what it has above its local mean; second differences
    across the lines, where nothing rises, cancel a slope of the ambient light.
    """
    lag = max(2, round(1.5 * width))
    low = rise[:, : -2 * lag], rise[:, lag:-lag], rise[:, 2 * lag :]
    dark = (low[0] <= 0.0) & (low[1] <= 0.0) & (low[2] <= 0.0)
    if int(dark.sum()) < 50:
        dark = low[1] <= 0.0
    if int(dark.sum()) < 50:
        return 0.3
    second = (near[:, lag:-lag] - 0.5 * (near[:, : -2 * lag] + near[:, 2 * lag :]))[dark][::3]
    return max(float(np.median(np.abs(second))) / (0.6745 * 1.2247), 0.15)


_BANDS = 6


def _ruling_noise(rise: Image, near: Image, width: float) -> float:
    """Noise of the noisiest band along the lines: where light falls on a part of the picture, settings for the dark
    rest would take texture for stripes; those for the bright part cost the dark one little."""
    whole = _background_noise(rise, near, width)
    if len(rise) < 10 * _BANDS:
        return whole
    bands = zip(np.array_split(rise, _BANDS), np.array_split(near, _BANDS), strict=True)
    # Bands scatter: in even light the whole picture knows best.
    return max(whole, 0.9 * max(_background_noise(r, n, width) for r, n in bands))


def _runs(mask: NDArray[np.uint8]) -> tuple[I64, I64, I64]:
    """Runs of what is not 0 along the last axis: row, first and one past last. Blanks the first and last column."""
    mask[:, 0] = 0
    mask[:, -1] = 0
    flat = mask.reshape(-1)
    edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    start, stop = edges[0::2], edges[1::2]
    row = start // mask.shape[1]  # a run never crosses rows: their ends are blank
    base = row * mask.shape[1]
    return row, start - base, stop - base


def background_offset(near: Image, scale: Scale, settings: StripeSettings) -> tuple[Image, float, float]:
    """Local mean of an averaged image, how far a stripe must rise above it, and the noise of the background. [DN]"""
    pitch = scale.pitch_px if np.isfinite(scale.pitch_px) else 20.0 * scale.width_px
    window = _odd(min(pitch, max(14.0 * scale.width_px, 9.0)))
    around = cv2.blur(near, (window, 1), borderType=cv2.BORDER_REFLECT_101)
    sparse = near[::23].astype(np.float32)
    noise = _ruling_noise(sparse - around[::23], sparse, scale.width_px)
    return around, max(settings.threshold_noise * noise, settings.threshold_dn), noise


def _stripe_runs(near: Image, around: Image, offset: float) -> tuple[I64, I64, I64]:
    """Runs above the local mean (equation 4-3 with an offset): along, first and one past last across."""
    _, mask = cv2.threshold(cv2.subtract(near, around), offset, 255, cv2.THRESH_BINARY)
    return _runs(np.asarray(mask).astype(np.uint8, copy=False))


def run_peaks(near: Image, around: Image, offset: float, noise: float) -> Peaks:
    """The middle pixel of each run: what section 4.3.2 of the thesis calls the line.

    An even run has two; to the even one of them, so that there is no bias to one side.
    """
    along, start, stop = _stripe_runs(near, around, offset)
    middle = np.rint(0.5 * (start + stop - 1)).astype(np.int64)
    height = near[along, middle].astype(np.float32)
    low = around[along, middle].astype(np.float32)
    return Peaks(
        along.astype(np.int32), middle.astype(np.float32), height - low,
        ((stop - start) / _FULL_WIDTH).astype(np.float32), low, height >= 254.0, noise,
    )  # fmt: skip


def stripe_peaks(strip: Image, scale: Scale, settings: StripeSettings) -> Peaks:
    """All stripe peaks of a strip image [along, across] of uint8, or float32 in DN of an 8-bit frame."""
    pitch = scale.pitch_px if np.isfinite(scale.pitch_px) else 20.0 * scale.width_px
    length = max(settings.average_px | 1, 1)
    inner = _odd(1.6 * scale.width_px)
    near = cv2.blur(strip, (inner, length), borderType=cv2.BORDER_REPLICATE)
    around, offset, noise = background_offset(near, scale, settings)
    along, start, stop = _stripe_runs(near, around, offset)
    long_enough = stop - start >= max(2, int(0.8 * scale.width_px))
    along, start, stop = along[long_enough], start[long_enough], stop[long_enough]
    along, seed = _seeds(near, along, start, stop, scale)
    if strip.dtype == np.uint8:
        # Whole sums of a few pixels: exact in 16 bit, half the memory traffic of floats.
        summed = cv2.boxFilter(strip, cv2.CV_16U, (1, length), normalize=False, borderType=cv2.BORDER_REPLICATE)
        share = np.float32(1.0 / length)
    else:
        summed = _averaged(strip, length)
        share = np.float32(1.0)
    return _refined(summed, share, along, seed, scale, pitch, float(noise))


def _seeds(near: Image, along: I64, start: I64, stop: I64, scale: Scale) -> tuple[I64, I64]:
    """One whole-pixel seed per stripe: the middle of a run, or the tops of a run too long for one stripe."""
    length = stop - start
    limit = max(1.9 * float(np.median(length[::19])), 6.0 * scale.width_px) if len(length) else 0.0
    is_long = length > limit
    seed = (start + stop - 1) // 2
    if not is_long.any():
        return along, seed
    reach = int(min(length[is_long].max(), 8 * limit)) + 2
    offset = np.arange(reach)
    rows, first = along[is_long], start[is_long]
    index = np.clip(first[:, None] + offset - 1, 0, near.shape[1] - 1)
    profile = cv2.blur(near[rows[:, None], index].astype(np.float32), (_odd(1.5 * scale.width_px), 1))
    # A top is the largest value within a stripe's width, and there is a valley before the next one.
    wide = cv2.dilate(profile, np.ones((1, _odd(3.0 * scale.width_px)), np.uint8))
    inside = offset[None, :] < length[is_long][:, None]
    top = (profile >= wide) & inside & (offset > 0)[None, :]
    top[:, 1:] &= ~top[:, :-1]
    which, place = np.nonzero(top)
    all_along = np.concatenate([along[~is_long], rows[which]])
    all_seed = np.concatenate([seed[~is_long], first[which] + place - 1])
    order = np.lexsort((all_seed, all_along))
    return all_along[order], all_seed[order]


def _refined(
    summed: Image, share: np.float32, along: I64, seed: I64, scale: Scale, pitch: float, noise_dn: float
) -> Peaks:
    width = scale.width_px
    strength = summed[along, seed].astype(np.float32) * share
    strength -= np.float32(np.percentile(summed[::64, ::7], 30)) * share
    ratio = noise_dn / max(float(np.median(strength[::7])), 1.0) if len(seed) else 1.0
    # In the dark the tails carry the best part of what speckle leaves; in bright light they carry the
    # texture of the background, and only what stands clear of it counts.
    reach = float(np.interp(ratio, (0.008, 0.025), (3.1, 2.4)))
    floor = float(np.interp(ratio, (0.008, 0.025), (0.0, 0.3)))
    core = int(np.ceil(min(reach * width + 0.5, 0.5 * pitch)))
    flank = max(2, min(4, int(0.5 * pitch) - core))
    half = core + flank
    across = summed.shape[1]
    inside = (seed >= half) & (seed < across - half)
    along, seed = along[inside], seed[inside]
    n = len(seed)
    out = np.empty((5, n), np.float32)
    x = np.arange(-half, half + 1, dtype=np.float32)
    # Each row of this view is the window that begins there; taking rows copies neighbouring pixels at once.
    windows = np.lib.stride_tricks.sliding_window_view(summed.reshape(-1), 2 * half + 1)
    begin = along * across + seed - half
    for first in range(0, n, _CHUNK):
        part = slice(first, min(first + _CHUNK, n))
        window = windows[begin[part]].astype(np.float32)
        window *= share
        _refine_chunk(window, x, core, flank, width, noise_dn, floor, out[:, part])
    shift, signal, spread, low, top = out
    centre = seed.astype(np.float32) + shift
    good = (signal > 2.0 * noise_dn) & (np.abs(shift) < max(1.6 * width, 1.5)) & np.isfinite(centre)
    good &= spread < 2.6 * width
    # Two seeds of one stripe end on the same centre: keep the first.
    near = np.zeros(n, bool)
    near[1:] = (along[1:] == along[:-1]) & (np.abs(centre[1:] - centre[:-1]) < 0.8 * width)
    good &= ~near
    ordered = np.ones(n, bool)
    ordered[1:] = (along[1:] != along[:-1]) | (centre[1:] > centre[:-1])
    good &= ordered
    return Peaks(
        along[good].astype(np.int32), centre[good], signal[good], spread[good], low[good], top[good] >= 253.5, noise_dn
    )


def _refine_chunk(
    window: F32, x: F32, core: int, flank: int, width: float, noise_dn: float, floor: float, out: F32
) -> None:
    """Shift from the seed, signal, width, background and top of each window [n, 2 half + 1] into ``out`` [5, n]."""
    half = core + flank
    # Products with vectors: far quicker than sums over short rows.
    top = np.maximum(np.maximum(window[:, half - 1], window[:, half]), window[:, half + 1])
    even = np.full(flank, 1.0 / flank, np.float32)
    left = window[:, :flank] @ even
    right = window[:, -flank:] @ even
    # A neighbouring stripe in one flank must not pass for background.
    lower = np.minimum(left, right) + np.float32(8.0 * noise_dn)
    left, right = np.minimum(left, lower), np.minimum(right, lower)
    span = np.float32(2 * half + 1 - flank)
    middle = 0.5 * (left + right)
    inner = window[:, flank:-flank]
    xi = x[flank:-flank]
    root = inner - middle[:, None]
    root -= ((right - left) / span)[:, None] * xi
    root -= np.maximum(np.float32(floor) * (top - middle), np.float32(2.0 * noise_dn))[:, None]
    np.maximum(root, 0.0, out=root)
    np.sqrt(root, out=root)
    edge = np.float32(core)
    ramp = np.float32(max(0.8 * width, 1.0))
    ones = np.ones(len(xi), np.float32)
    # A turn without a taper, and one with it, leave a hundredth of a pixel to the fixed point, far below the noise.
    total = root @ ones
    np.maximum(total, 1e-6, out=total)
    shift = np.asarray((root @ xi) / total, np.float32)
    np.clip(shift, 1 - core, core - 1, out=shift)
    # The taper moves with the centre, so that what noise leaves in the tails is symmetric about it.
    distance = xi - shift[:, None]
    np.abs(distance, out=distance)
    np.subtract(edge, distance, out=distance)
    distance *= np.float32(1.0 / ramp)
    np.maximum(distance, 0.0, out=distance)
    np.minimum(distance, 1.0, out=distance)
    distance *= root
    total = distance @ ones
    np.maximum(total, 1e-6, out=total)
    shift = np.asarray((distance @ xi) / total, np.float32)
    np.clip(shift, 1 - core, core - 1, out=shift)
    second = (distance @ (xi * xi)) / total - shift * shift
    out[0], out[3], out[4] = shift, middle, top
    out[2] = np.sqrt(np.maximum(0.5 * second, 0.05))
    out[1] = top - middle
