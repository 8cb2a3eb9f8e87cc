"""A second renderer, independent of `wearline.scene`: lines as curves on the sensor, moved by d = z / (a - b z).

It knows no camera and no laser, only what the picture shows: so a test that passes here does not
lean on the geometry, noise or light of the simulated head.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Surface = Callable[[F64, F64], F64]
"""Height [mm] of the point where a line lies at z = 0: (across_px, along_px) -> z, NaN = no light comes back."""


@dataclass(frozen=True)
class Comb:
    """Lines on a sensor, in the direction across and along them."""

    across: int = 480
    along: int = 640
    lines: int = 11
    pitch_px: float = 38.0
    width_px: float = 1.8
    a_mm_per_px: float = 0.15
    """Negative: lines move towards row 0 when the surface rises."""
    b_per_px: float = 2.0e-4
    slant: float = 0.02
    """Slope of the lines against the sensor."""
    bow_px: float = 6.0
    """Sagitta of each line over the picture, by lens distortion."""
    signal_dn: float = 100.0
    ambient_dn: float = 15.0
    ambient_slope_dn: float = 10.0
    """Over the picture, across the lines."""
    noise_dn: float = 1.5
    speckle: float = 0.3
    spot_px: float = 5.0
    """Gaussian sigma of the centre spot; 0 = none."""
    dead: tuple[int, ...] = ()
    is_vertical: bool = False

    def at_datum(self) -> F64:
        """(line, along): where the lines lie at z = 0. [px]"""
        u = np.linspace(-1.0, 1.0, self.along)
        offset = (np.arange(self.lines) - self.lines // 2)[:, None] * self.pitch_px
        middle = 0.5 * (self.across - 1)
        stretch = 1.0 + 0.01 * u**2
        return np.asarray(middle + offset * stretch + self.slant * self.along * 0.5 * u + self.bow_px * (u**2 - 0.5))


def draw(comb: Comb, surface: Surface, seed: int) -> tuple[NDArray[np.uint8], F64, F64]:
    """Picture uint8 [row, col], and the truth: across [px] and z [mm], both (line, along), NaN = not visible."""
    rng = np.random.default_rng(seed)
    start = comb.at_datum()
    along = np.broadcast_to(np.arange(comb.along, dtype=np.float64), start.shape)
    z = surface(start, along) + 0.0 * start
    for line in comb.dead:
        z[line] = np.nan
    across = start + z / (comb.a_mm_per_px - comb.b_per_px * z)
    inside = (across > 2.0) & (across < comb.across - 3.0)
    across, z = np.where(inside, across, np.nan), np.where(inside, z, np.nan)
    image = np.zeros((comb.across, comb.along))
    rows = np.arange(comb.across)[:, None]
    middle, place = comb.lines // 2, comb.along // 2
    for line in range(comb.lines):
        shape = np.exp(-0.5 * ((rows - across[line]) / comb.width_px) ** 2)
        image += comb.signal_dn * np.nan_to_num(shape)
    if comb.spot_px > 0 and np.isfinite(across[middle, place]):
        blob = np.exp(-0.5 * (((rows - across[middle, place]) ** 2 + (along[:1] - place) ** 2) / comb.spot_px**2))
        image += 1.5 * comb.signal_dn * blob
    # Speckle of gamma statistics, alike over two pixels each way.
    grains = rng.gamma(1.0 / (1.6 * comb.speckle) ** 2, (1.6 * comb.speckle) ** 2, image.shape) if comb.speckle else 1.0
    if comb.speckle:
        grains = 0.25 * (grains + np.roll(grains, 1, 0) + np.roll(grains, 1, 1) + np.roll(grains, (1, 1), (0, 1)))
    image = image * grains + comb.ambient_dn + comb.ambient_slope_dn * (rows / comb.across - 0.5)
    image += rng.normal(0.0, 1.0, image.shape) * np.sqrt(comb.noise_dn**2 + 0.02 * image)
    pixels = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return np.ascontiguousarray(pixels.T if comb.is_vertical else pixels), across, z


def plate(z_mm: float) -> Surface:
    """A flat plate."""
    return lambda across, along: np.full_like(across, z_mm)
