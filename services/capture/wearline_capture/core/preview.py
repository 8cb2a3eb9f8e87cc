"""A small JPEG for the eye."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wearline.config import Settings


class PreviewSettings(Settings):
    """The picture that people see; nothing is measured on it."""

    preview_hz: float = Field(default=3.0, gt=0, le=30)
    preview_step: int = Field(default=2, ge=1, le=8)
    """Sensor pixels per preview pixel. [px]"""
    preview_quality: int = Field(default=80, ge=10, le=100)
    """Of the JPEG."""


def encoded_preview(pixels: NDArray[np.uint8], step: int, quality: int) -> NDArray[np.uint8]:
    """JPEG of uint8 [row, col], made smaller by ``step``; 1-d uint8.

    Raises:
        ValueError: no pixels.
    """
    if pixels.size == 0:
        raise ValueError("a preview needs pixels")
    size = (max(pixels.shape[1] // step, 1), max(pixels.shape[0] // step, 1))
    # Areas are averaged: thin stripes would flicker and vanish if pixels were only skipped.
    small = pixels if step == 1 else cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    is_done, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not is_done:
        raise ValueError(f"JPEG encoder refused {small.shape[1]} x {small.shape[0]} pixels")
    return np.asarray(jpeg, dtype=np.uint8).reshape(-1)
