"""Closed-form heights: z = a d / (1 + b d), d = across - across0, at every point from its own peak."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wearline.artifact import Calibration
from wearline_reconstruct.core.stripes import F64


def heights(calibration: Calibration, line: NDArray[np.int64], along: NDArray[np.int64], across_px: F64) -> F64:
    """Heights of points [n]; NaN where the calibration knows nothing. [mm]"""
    d = across_px - calibration.across0_px[line, along]
    return np.asarray(calibration.a_mm_per_px[line, along] * d / (1.0 + calibration.b_per_px * d))


def height_slope(calibration: Calibration, line: NDArray[np.int64], along: NDArray[np.int64], across_px: F64) -> F64:
    """dz/d(across) of points [n]. [mm/px]"""
    d = across_px - calibration.across0_px[line, along]
    return np.asarray(calibration.a_mm_per_px[line, along] / (1.0 + calibration.b_per_px * d) ** 2)


def across_at(calibration: Calibration, z_mm: float) -> F64:
    """Where each line lies at one height: (line, along). [px]"""
    a, b = calibration.a_mm_per_px, calibration.b_per_px
    return np.asarray(calibration.across0_px + z_mm / (a - b * z_mm))
