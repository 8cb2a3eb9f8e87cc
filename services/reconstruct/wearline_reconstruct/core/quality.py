"""What a frame says of itself, and the reasons to refuse one."""

from __future__ import annotations

import numpy as np

from wearline.errors import FrameError
from wearline.messages import FrameQuality, ResultCode
from wearline_reconstruct.core.lines import Fragments
from wearline_reconstruct.core.stripes import Image, Peaks

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


def describe(
    found: Fragments, numbered_lines: int, lines: int, spot_found: bool, width_px: float, coverage: float
) -> FrameQuality:
    """Figures and plain sentences."""
    peaks = found.peaks
    saturated = float(np.mean(peaks.is_saturated)) if len(peaks) else 0.0
    width = float(np.median(peaks.width_px[::19])) if len(peaks) else None
    contrast = float(np.median(peaks.signal_dn[::19])) if len(peaks) else 0.0
    ambient = float(np.median(peaks.background_dn[::19])) if len(peaks) else 0.0
    sentences = []
    if numbered_lines < lines:
        sentences.append(f"{lines - numbered_lines} of {lines} lines were not seen.")
    if not spot_found:
        sentences.append("The centre spot was not found.")
    if saturated > 0.1:
        sentences.append(f"{saturated:.0%} of the stripe points are saturated: shorten the exposure.")
    if width is not None and width > 1.5 * width_px:
        sentences.append("Stripes are broader than at calibration: check focus and lens.")
    if contrast < 12.0:
        sentences.append(f"Stripes rise only {contrast:.0f} DN above the background: lengthen the exposure.")
    if ambient > 1.5 * contrast:
        sentences.append("Ambient light is stronger than the laser: shade it.")
    if coverage < 0.7:
        sentences.append(f"Only {coverage:.0%} of the expected points were measured.")
    return FrameQuality(
        lines_seen=numbered_lines, spot_found=spot_found, stripe_width_px=width, saturated_fraction=saturated,
        ambient_dn=ambient, contrast_dn=contrast, sentences=tuple(sentences),
    )  # fmt: skip
