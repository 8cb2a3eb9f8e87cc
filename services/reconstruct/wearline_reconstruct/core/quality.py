"""What a frame says of itself, and the reasons to refuse one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wearline.errors import FrameError
from wearline.messages import FrameQuality, ResultCode
from wearline_reconstruct.core.lines import Fragments
from wearline_reconstruct.core.stripes import I64, Image, Peaks, Scale

_BAD = int(ResultCode.BAD_FRAME)


def check_pixels(pixels: Image, shape: tuple[int, int]) -> None:
    """Refuse what can hold no stripes.

    Raises:
        FrameError: code 21, wrong size, black, white or nearly all saturated, uniform.
    """
    if pixels.dtype != np.uint8 or pixels.ndim != 2:
        raise FrameError("is no 8-bit grey picture", cure="set the camera to Mono8", code=_BAD)
    if pixels.shape != shape:
        raise FrameError(
            f"is {pixels.shape[1]} x {pixels.shape[0]} pixels, the calibration is for {shape[1]} x {shape[0]}",
            cure="take the full frame of the calibrated camera", code=_BAD,
        )  # fmt: skip
    count = np.bincount(pixels[::7, ::9].reshape(-1), minlength=256)
    share = np.cumsum(count) / count.sum()
    dark, bright = (int(np.searchsorted(share, level)) for level in (0.05, 0.995))
    if dark >= 250 or float(1.0 - share[253]) > 0.6:
        raise FrameError("is white (saturated)", cure="shorten the exposure or shade the ambient light", code=_BAD)
    if bright < 6:
        raise FrameError("is black", cure="check laser, exposure and lens cap", code=_BAD)
    if bright - dark < 4:
        raise FrameError("shows nothing but even light", cure="check laser and exposure", code=_BAD)


def check_stripes(found: Fragments, peaks: Peaks, expected_points: int) -> None:
    """Refuse a frame without anything that looks like laser lines.

    Raises:
        FrameError: code 21.
    """
    if not found.count or len(found.peaks) < max(100, 0.01 * expected_points):
        raise FrameError("shows no laser lines", cure="check laser, exposure and focus", code=_BAD)
    if len(peaks) > 3 * max(len(found.peaks), 1) and len(found.peaks) < 0.3 * expected_points:
        raise FrameError("shows noise instead of laser lines", cure="check laser and exposure", code=_BAD)


@dataclass(frozen=True)
class Numbered:
    """What became of the stripe points of a frame."""

    wanted: I64
    """Lines that should be in the picture."""
    missing: I64
    """Those of them that are not."""
    spot_found: bool
    coverage: float
    outside: float
    """Share of the numbered points outside the calibrated heights."""
    unnamed: float
    """Share of all stripe points without a certain line number."""
    pitch_ratio: float
    """Distance of the lines over that on the plates."""


def stripe_width(strip: Image, peaks: Peaks, scale: Scale) -> float | None:
    """Gaussian sigma of the stripes as area over height, from a hundred of them and more; None without any. [px]

    The windows of the extraction suit the calibrated width; a stripe out of focus does not fit them.
    """
    if not len(peaks):
        return None
    some = np.arange(0, len(peaks), max(1, len(peaks) // 150))
    pitch = scale.pitch_px if np.isfinite(scale.pitch_px) else 20.0 * scale.width_px
    half = int(max(min(0.45 * pitch, 8.0 * scale.width_px), 4.0))
    along = np.clip(peaks.along[some].astype(np.int64)[:, None] + np.arange(-3, 4), 0, strip.shape[0] - 1)
    across = np.clip(
        np.rint(peaks.across_px[some]).astype(np.int64)[:, None] + np.arange(-half, half + 1), 0, strip.shape[1] - 1
    )
    profile = strip[along[:, :, None], across[:, None, :]].astype(np.float32).mean(axis=1)
    low = np.percentile(profile, 10, axis=1)[:, None]
    top = profile[:, half - 1 : half + 2].mean(axis=1) - low[:, 0]
    area = (profile - low).sum(axis=1)
    return float(np.median(area / np.maximum(top, 1.0))) / 2.50663


def describe(found: Fragments, numbered: Numbered, calibrated_px: float, width_px: float | None) -> FrameQuality:
    """Figures and plain sentences; widths are Gaussian sigmas, at calibration and now. [px]"""
    peaks = found.peaks
    saturated = float(np.mean(peaks.is_saturated)) if len(peaks) else 0.0
    contrast = float(np.median(peaks.signal_dn[::19])) if len(peaks) else 0.0
    ambient = float(np.median(peaks.background_dn[::19])) if len(peaks) else 0.0
    sentences = []
    missing = [str(line) for line in numbered.missing]
    if missing:
        names = ", ".join(missing[:8]) + (", ..." if len(missing) > 8 else "")
        sentences.append(
            f"{len(missing)} of {len(numbered.wanted)} lines were not seen (line {names}):"
            " hidden by the part, outside the picture, or dead in the laser."
        )
    if not numbered.spot_found:
        sentences.append("The centre spot was not found.")
    if numbered.unnamed > 0.3:
        sentences.append(
            f"{numbered.unnamed:.0%} of the stripe points fit no line for certain:"
            " check that this is the calibrated head, and for reflections."
        )
    if not 0.88 < numbered.pitch_ratio < 1.14:
        sentences.append(
            f"Lines lie at {numbered.pitch_ratio:.0%} of their distance on the plates:"
            " a tilted part, or not the calibrated head."
        )
    if numbered.outside > 0.02:
        sentences.append(f"{numbered.outside:.0%} of the points lie outside the calibrated heights.")
    if saturated > 0.1:
        sentences.append(f"{saturated:.0%} of the stripe points are saturated: shorten the exposure.")
    if width_px is not None and saturated < 0.3 and contrast >= 12.0 and width_px > 1.4 * calibrated_px:
        sentences.append(
            f"Stripes are {width_px / calibrated_px:.1f} times as broad as at calibration:"
            " check focus and lens, and that nothing shakes during the exposure."
        )
    if contrast < 12.0:
        sentences.append(f"Stripes rise only {contrast:.0f} DN above the background: lengthen the exposure.")
    if ambient > max(1.5 * contrast, 25.0):
        sentences.append("Ambient light is stronger than the laser: shade it.")
    if numbered.coverage < 0.7:
        sentences.append(f"Only {numbered.coverage:.0%} of the expected points were measured.")
    return FrameQuality(
        lines_seen=len(numbered.wanted) - len(missing), spot_found=numbered.spot_found, stripe_width_px=width_px,
        saturated_fraction=saturated, ambient_dn=ambient, contrast_dn=contrast, sentences=tuple(sentences),
    )  # fmt: skip
