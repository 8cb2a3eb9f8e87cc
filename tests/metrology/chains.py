"""Calibrated chains for the tests, on either renderer, and the comparison with the truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from tests.metrology.renderer import Comb, draw, plate
from wearline.artifact import Calibration
from wearline.recipe import Recipe
from wearline.scene import Head, Light, Plane, render
from wearline_reconstruct.core.calibration import CalibrationSettings, Shot, calibrate
from wearline_reconstruct.core.chain import Prepared, Reconstruction, prepare
from wearline_reconstruct.core.lines import LineSettings
from wearline_reconstruct.core.stripes import F64, StripeSettings


def calibrated(shots: list[Shot], lines: int, is_vertical: bool) -> Calibration:
    """A calibration with default settings."""
    return calibrate(
        shots, lines=lines, is_vertical=is_vertical, mm_per_pixel=None, settings=CalibrationSettings(),
        stripes=StripeSettings(), line_settings=LineSettings(),
    )  # fmt: skip


@cache
def comb_calibration(comb: Comb, heights: tuple[float, ...], seed: int = 500) -> Calibration:
    """From plates drawn by the second renderer."""
    shots = [Shot(z, draw(comb, plate(z), seed + k)[0], f"P{z:g}-{k}.png") for k, z in enumerate(heights)]
    return calibrated(shots, comb.lines, comb.is_vertical)


@cache
def head_calibration(head: Head, heights: tuple[float, ...], seed: int = 700) -> Calibration:
    """From plates rendered by the simulated head."""
    shots = [Shot(z, render(head, Plane(z), Light(), seed + k)[0], f"P{z:g}-{k}.png") for k, z in enumerate(heights)]
    return calibrated(shots, head.lines, head.vertical)


def prepared(calibration: Calibration, recipe: Recipe | None = None) -> Prepared:
    """Without a template."""
    return prepare(calibration, recipe or Recipe(), None)


@dataclass(frozen=True)
class Comparison:
    """Measured against true."""

    error_mm: F64
    """Of the points with the right number. [mm]"""
    sigma_mm: F64
    wrong: int
    """Points that bear a number whose line is not there."""
    seen: float
    """Share of the visible points that were measured with the right number."""

    @property
    def spread_mm(self) -> float:
        return float(np.std(self.error_mm))

    @property
    def bias_mm(self) -> float:
        return float(np.mean(self.error_mm))


def compare(found: Reconstruction, across_px: F64, z_mm: F64, is_vertical: bool, near_px: float = 6.0) -> Comparison:
    """Truth (line, along) against what was found; a number is right if its line is within ``near_px``."""
    points: NDArray[np.float64] = found.points.astype(np.float64)
    line = points[:, 0].astype(int)
    across, along = (points[:, 2], points[:, 1]) if is_vertical else (points[:, 1], points[:, 2])
    place = np.rint(along).astype(int)
    off = np.abs(across - across_px[line, place])
    right = off < near_px
    error = points[:, 3] - z_mm[line, place]
    return Comparison(error[right], points[right, 4], int((~right).sum()), float(right.sum() / np.isfinite(z_mm).sum()))
