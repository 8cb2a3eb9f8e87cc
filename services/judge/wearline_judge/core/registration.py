"""The rigid motion between part and template, found so that local wear does not pull it.

Model, first order in the motion: measured - template = dz + tilt_x y + tilt_y x - slope_x dx -
slope_y dy. Solved by weighted least squares whose loss (Tukey's biweight) tightens from the whole
range of residuals down to the noise (graduated non-convexity): where the part deviates for its own
reasons it ends up with no weight. An in-plane shift and a worn draw radius look alike, so a shift
is believed only where it explains the part clearly better than none, and only in directions that
the surface determines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from wearline.config import Settings
from wearline_judge.core.line_grid import BLOCK, F64, Bool

_NAMES = ("dx_mm", "dy_mm")
_TUKEY = 4.685
_TIGHTEN = 0.6
_NOISE_FLOOR_MM = 0.006
"""Residual scale below which tightening gains nothing. [mm]"""


class RegistrationSettings(Settings):
    """How far a part may lie from where the template lay."""

    dz_max_mm: float = Field(default=2.0, gt=0)
    """[mm]"""
    tilt_max_mrad: float = Field(default=15.0, gt=0)
    """[mrad]"""
    shift_max_mm: float = Field(default=1.0, ge=0)
    """In plane; without datum zones the shift is held to it, with them a part beyond it is refused. [mm]"""
    shift_max_px: float = Field(default=12.0, ge=0)
    """The same where no lateral scale is known. [px]"""
    slope_min: float = Field(default=0.02, ge=0)
    """Rise per length below which a point says nothing about a shift (its slope is noise)."""
    shift_sigma_max_mm: float = Field(default=0.05, gt=0)
    """A direction known less well than this counts as undetermined. [mm]"""
    correlation_px: float = Field(default=24.0, gt=0)
    """Distance along a line over which errors are alike. [px]"""
    gain_min: float = Field(default=0.15, ge=0, le=1)
    """Share by which a shift must lower the robust cost to be believed."""


@dataclass(frozen=True)
class Motion:
    """A rigid motion; lengths in the unit of the coordinates it was fitted in (mm, or px without a scale)."""

    dz_mm: float = 0.0
    tilt_x: float = 0.0
    """Rise per unit of y, about the middle of the part."""
    tilt_y: float = 0.0
    dx: float = 0.0
    dy: float = 0.0
    undetermined: tuple[str, ...] = ()
    scale_mm: float = 0.0
    """Robust standard deviation of what is left. [mm]"""
    shift_sigma: float = 0.0
    """Standard uncertainty of the shift in the directions that were determined."""

    def height(self, x: F64, y: F64) -> F64:
        """What dz and the tilts add at (x, y), counted from the middle of the part. [mm]"""
        return np.asarray(self.dz_mm + self.tilt_x * y + self.tilt_y * x)


def _solve(design: F64, target: F64, weight: F64) -> F64:
    scaled = design * weight[:, None]
    normal = scaled.T @ design
    # A part seen on one line alone leaves a tilt open: the pseudo-inverse leaves it at zero.
    return np.asarray(np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ (scaled.T @ target))


def _biweight(residual: F64, reach: float) -> F64:
    inside = np.clip(1.0 - (residual / reach) ** 2, 0.0, None)
    return inside * inside


def _spread_of(residual: F64) -> float:
    return float(1.4826 * np.median(np.abs(residual - np.median(residual)))) if residual.size else 0.0


def _robust(design: F64, target: F64, weight: F64, start: F64) -> tuple[F64, float]:
    """Parameters and the final reach of the loss."""
    found = start
    residual = target - design @ found
    reach = max(float(np.max(np.abs(residual), initial=0.0)) * 1.5, _NOISE_FLOOR_MM * _TUKEY)
    for _ in range(24):
        found = _solve(design, target, weight * _biweight(residual, reach))
        residual = target - design @ found
        goal = _TUKEY * max(_spread_of(residual), _NOISE_FLOOR_MM)
        if reach <= goal:
            return found, goal
        reach = max(reach * _TIGHTEN, goal)
    return found, reach


def _cost(residual: F64, weight: F64, reach: float) -> float:
    inside = np.clip(1.0 - (residual / reach) ** 2, 0.0, None)
    return float(np.sum(weight * (1.0 - inside**3)) / np.sum(weight))


def register(
    deviation_mm: F64, sigma_mm: F64, x: F64, y: F64, slope_x: F64, slope_y: F64, use: Bool,
    settings: RegistrationSettings, is_in_mm: bool, has_datum: bool,
) -> Motion:  # fmt: skip
    """Fit the motion to cells of the line grid.

    Args:
        deviation_mm: (line, block), measured minus template. [mm]
        sigma_mm: (line, block), its standard uncertainty. [mm]
        x, y: (line, block), counted from the middle of the part; mm, or px without a scale.
        slope_x, slope_y: (line, block), rise of the template per unit of x and y.
        use: (line, block), cells that may be used (datum zones, or all).
        settings: limits.
        is_in_mm: x and y are millimetres.
        has_datum: the recipe names datum zones; a shift is then not second-guessed.
    """
    use = use & np.isfinite(deviation_mm) & np.isfinite(sigma_mm) & np.isfinite(x) & np.isfinite(y)
    if np.count_nonzero(use) < 12:
        return Motion(undetermined=("dz_mm", "tilt_x_mrad", "tilt_y_mrad", *_NAMES))
    d, s, xs, ys, gx, gy = (a[use] for a in (deviation_mm, sigma_mm, x, y, slope_x, slope_y))
    unit = settings.slope_min if is_in_mm else settings.slope_min * 0.1
    steep = np.hypot(gx, gy) > unit
    gx, gy = np.where(steep, gx, 0.0), np.where(steep, gy, 0.0)
    weight = 1.0 / (s * s + _NOISE_FLOOR_MM**2)
    weight = np.minimum(weight, 4.0 * float(np.median(weight)))
    flat = np.column_stack([np.ones_like(d), ys, xs])
    still, still_reach = _robust(flat, d, weight, np.array([float(np.median(d)), 0.0, 0.0]))

    shift_x, shift_y, shift_sigma = 0.0, 0.0, 0.0
    undetermined: tuple[str, ...] = _NAMES
    moved, reach = still, still_reach
    axes, sigmas = _determined(gx, gy, flat, s, settings, is_in_mm)
    if axes.shape[1]:
        limit = settings.shift_max_mm if is_in_mm else settings.shift_max_px
        pull = -np.column_stack([gx, gy]) @ axes
        design = np.column_stack([flat, pull])
        full, full_reach = _robust(design, d, weight, np.concatenate([still, np.zeros(axes.shape[1])]))
        wanted = axes @ full[3:]
        length = float(np.hypot(*wanted))
        if length > limit and not has_datum:
            wanted = wanted * (limit / length)
            rest = d + gx * wanted[0] + gy * wanted[1]
            base, full_reach = _robust(flat, rest, weight, still)
        else:
            base = full[:3]
        # The shift speaks through steep cells alone; the flat ones would only dilute the comparison.
        reach = min(full_reach, still_reach)
        before = _cost((d - flat @ still)[steep], weight[steep], reach)
        after = _cost((d + gx * wanted[0] + gy * wanted[1] - flat @ base)[steep], weight[steep], reach)
        undetermined = tuple(n for n, row in zip(_NAMES, axes, strict=True) if float(np.max(np.abs(row))) < 0.5)
        if has_datum or after < (1.0 - settings.gain_min) * before:
            shift_x, shift_y = float(wanted[0]), float(wanted[1])
            moved, shift_sigma = base, float(np.max(sigmas))
    left = d + gx * shift_x + gy * shift_y - flat @ moved
    return Motion(
        dz_mm=float(moved[0]), tilt_x=float(moved[1]), tilt_y=float(moved[2]), dx=shift_x, dy=shift_y,
        undetermined=undetermined, scale_mm=_spread_of(left), shift_sigma=shift_sigma,
    )  # fmt: skip


def _determined(
    gx: F64, gy: F64, flat: F64, sigma: F64, settings: RegistrationSettings, is_in_mm: bool
) -> tuple[F64, F64]:
    """Directions of shift that the surface determines: unit vectors as columns (2, k), and their sigmas (k,)."""
    alike = max(settings.correlation_px / BLOCK, 1.0)
    weight = 1.0 / (alike * (sigma * sigma + _NOISE_FLOOR_MM**2))
    slopes = np.column_stack([gx, gy])
    root = np.sqrt(weight)[:, None]
    # Information on the shift once dz and the tilts have taken their share (Schur complement).
    rest, *_ = np.linalg.lstsq(flat * root, slopes * root, rcond=None)
    remaining = (slopes - flat @ rest) * root
    values, vectors = np.linalg.eigh(remaining.T @ remaining)
    sigmas = 1.0 / np.sqrt(np.maximum(values, 1e-12))
    enough = sigmas <= (settings.shift_sigma_max_mm if is_in_mm else settings.shift_sigma_max_mm * 10.0)
    if enough.any() and not enough.all():
        axes = vectors[:, enough]
        # Report in the part's axes: a direction that is nearly one of them is that one.
        index = int(np.argmax(np.abs(axes[:, 0])))
        if abs(axes[index, 0]) > 0.98:
            axes = np.eye(2)[:, index : index + 1]
        return axes, sigmas[enough]
    return (np.eye(2), sigmas) if enough.all() else (np.zeros((2, 0)), sigmas[:0])


def out_of_pose(motion: Motion, settings: RegistrationSettings, is_in_mm: bool) -> str | None:
    """Why a part with this motion cannot be judged, or None."""
    if abs(motion.dz_mm) > settings.dz_max_mm:
        return f"part lies {motion.dz_mm:+.2f} mm off in height, {settings.dz_max_mm:g} mm are allowed"
    # Without a scale a tilt is a rise per pixel; a tenth of a millimetre per pixel is a usual head.
    tilt = 1e3 * max(abs(motion.tilt_x), abs(motion.tilt_y)) * (1.0 if is_in_mm else 10.0)
    if tilt > settings.tilt_max_mrad:
        return f"part is tilted by {tilt:.1f} mrad, {settings.tilt_max_mrad:g} mrad are allowed"
    shift = float(np.hypot(motion.dx, motion.dy))
    limit, unit = (settings.shift_max_mm, "mm") if is_in_mm else (settings.shift_max_px, "px")
    if shift > limit * 1.001:
        return f"part is shifted by {shift:.2f} {unit}, {limit:g} {unit} are allowed"
    return None
