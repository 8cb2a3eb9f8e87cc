"""The rigid motion between part and template, found so that local wear does not pull it.

A part moved by (dx, dy, dz) and turned by small angles shows, at the place where the template has
height Z and slopes (gx, gy),

    z = template(x - u, y - v) + dz + tilt_x y + tilt_y x
    u = dx - turn y - tilt_y Z + x (dz + tilt_x y + tilt_y x) / D
    v = dy + turn x - tilt_x Z + y (dz + tilt_x y + tilt_y x) / D

the last terms being what a camera at the distance D makes of a nearer surface. Solved by
Gauss-Newton steps of weighted least squares whose loss (Tukey's biweight) tightens from the whole
range of residuals down to the noise (graduated non-convexity): where the part deviates for its own
reasons it ends up with no weight. A move in plane and a worn draw radius look alike, so such a move
is believed only where it explains the part clearly better than none, and only in directions that
the surface determines.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from wearline.config import Settings
from wearline_judge.core.line_grid import BLOCK, F64, Bool

_IN_PLANE = ("dx_mm", "dy_mm", "turn_mrad")
_TUKEY = 4.685
_TIGHTEN = 0.5
_NOISE_FLOOR_MM = 0.006
"""Residual scale below which tightening gains nothing. [mm]"""
_STEPS = 5
"""Gauss-Newton steps at most."""
_SETTLED = 0.004
"""Move in plane below which another step would change nothing that is seen (mm; ten times it in px)."""


class RegistrationSettings(Settings):
    """How far a part may lie from where the template lay."""

    dz_max_mm: float = Field(default=2.0, gt=0)
    """[mm]"""
    tilt_max_mrad: float = Field(default=15.0, gt=0)
    """[mrad]"""
    shift_max_mm: float = Field(default=1.5, ge=0)
    """In plane; without datum zones the move is held to it, with them a part beyond it is refused. [mm]"""
    shift_max_px: float = Field(default=15.0, ge=0)
    """The same where no lateral scale is known. [px]"""
    turn_max_mrad: float = Field(default=15.0, ge=0)
    """In plane. [mrad]"""
    slope_min: float = Field(default=0.02, ge=0)
    """Rise per length below which a cell says nothing about a move in plane (its slope is noise)."""
    shift_sigma_max_mm: float = Field(default=0.05, gt=0)
    """A direction known less well than this counts as undetermined. [mm]"""
    correlation_px: float = Field(default=120.0, gt=0)
    """Distance along a line over which errors are alike. [px]"""
    gain_min: float = Field(default=0.15, ge=0, le=1)
    """Share by which a move in plane must lower the robust cost to be believed."""


Residual = Callable[["Motion"], tuple[F64, F64]]
"""For a motion: (cell,) measured minus moved template, NaN = not seen, and its standard uncertainty. [mm]"""


@dataclass(frozen=True)
class Cells:
    """The template where the part shows it, one entry per cell; lengths in mm, or px without a lateral scale."""

    x: F64
    y: F64
    """From the middle of the part."""
    height_mm: F64
    """From the middle of the template's heights; zero where no scale relates it to x and y. [mm]"""
    slope_x: F64
    slope_y: F64
    """Rise of the template per unit of x and y."""
    distance: float
    """From the camera; infinite when it is not known."""


@dataclass(frozen=True)
class Motion:
    """A rigid motion; lengths in the unit of the coordinates it was fitted in (mm, or px without a scale)."""

    dz_mm: float = 0.0
    tilt_x: float = 0.0
    """Rise per unit of y, about the middle of the part."""
    tilt_y: float = 0.0
    dx: float = 0.0
    dy: float = 0.0
    turn: float = 0.0
    """From x to y. [rad]"""
    undetermined: tuple[str, ...] = ()
    scale_mm: float = 0.0
    """Robust standard deviation of what is left. [mm]"""
    plane_root: tuple[tuple[float, float, float], ...] = ()
    """Rows r with sum r r^T = covariance of (dx, dy, turn); empty when no move in plane was found."""
    height_sigma_mm: float = 0.0
    """Standard uncertainty of dz. [mm]"""

    @property
    def parameters(self) -> F64:
        """(dz, tilt_x, tilt_y, dx, dy, turn)."""
        return np.array([self.dz_mm, self.tilt_x, self.tilt_y, self.dx, self.dy, self.turn])

    def move(self, cells: Cells) -> tuple[F64, F64]:
        """(u, v): how far each point moved in plane, in the unit of x and y."""
        nearer = self.rise(cells) / cells.distance
        return (
            self.dx - self.turn * cells.y - self.tilt_y * cells.height_mm + cells.x * nearer,
            self.dy + self.turn * cells.x - self.tilt_x * cells.height_mm + cells.y * nearer,
        )

    def place_sigma(self, cells: Cells, own: float) -> F64:
        """Uncertainty of heights by where the part lies: that of the move, and `own` of each place by itself. [mm]"""
        gx, gy = cells.slope_x, cells.slope_y
        variance = (gx * gx + gy * gy) * own**2
        for dx, dy, turn in self.plane_root:
            variance = variance + (gx * (dx - turn * cells.y) + gy * (dy + turn * cells.x)) ** 2
        return np.sqrt(variance)

    def rise(self, cells: Cells) -> F64:
        """What dz and the tilts add to the height. [mm]"""
        return np.asarray(self.dz_mm + self.tilt_x * cells.y + self.tilt_y * cells.x)


def _flat(cells: Cells) -> F64:
    """(cell, 3): change of the height with dz and the tilts."""
    x, y, gx, gy = cells.x, cells.y, cells.slope_x, cells.slope_y
    away = 1.0 - (gx * x + gy * y) / cells.distance
    return np.stack([away, y * away + gy * cells.height_mm, x * away + gx * cells.height_mm], axis=1)


def _in_plane(cells: Cells) -> F64:
    """(cell, 3): change of the height with dx, dy and turn."""
    gx, gy = cells.slope_x, cells.slope_y
    return np.stack([-gx, -gy, gx * cells.y - gy * cells.x], axis=1)


def _solve(design: F64, target: F64, weight: F64) -> F64:
    scaled = design * weight[:, None]
    normal = scaled.T @ design
    # A part seen on one line alone leaves a tilt open: what is not determined stays at zero.
    values, vectors = np.linalg.eigh(normal)
    known = values > 1e-9 * values[-1]
    share = np.where(known, (vectors.T @ (scaled.T @ target)) / np.where(known, values, 1.0), 0.0)
    return np.asarray(vectors @ share)


def _weight(sigma: F64) -> F64:
    weight = 1.0 / (sigma * sigma + _NOISE_FLOOR_MM**2)
    return np.asarray(np.minimum(weight, 4.0 * float(np.nanmedian(weight))))


def _biweight(residual: F64, reach: float) -> F64:
    inside = np.clip(1.0 - (residual / reach) ** 2, 0.0, None)
    return inside * inside


def _spread_of(residual: F64) -> float:
    return float(1.4826 * np.median(np.abs(residual))) if residual.size else 0.0


def _robust(design: F64, target: F64, weight: F64, reach: float | None = None) -> tuple[F64, float]:
    """Parameters and the final reach of the loss, tightened from `reach` (None = the whole range)."""
    found = np.zeros(design.shape[1])
    residual = target
    if reach is None:
        found = _solve(design, target, weight)
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
    residual_of: Residual, cells: Cells, use: Bool,
    settings: RegistrationSettings, is_in_mm: bool, has_datum: bool,
) -> Motion:  # fmt: skip
    """Fit the motion to cells of the line grid.

    Args:
        residual_of: measured minus moved template and its standard uncertainty.
        cells: the template at the cells.
        use: (cell,), which may be used (datum zones, or all).
        settings: limits.
        is_in_mm: x and y are millimetres.
        has_datum: the recipe names datum zones; a move in plane is then not second-guessed.
    """
    start, sigma = residual_of(Motion())
    use = use & np.isfinite(start) & np.isfinite(sigma) & np.isfinite(cells.x) & np.isfinite(cells.y)
    if np.count_nonzero(use) < 12:
        return Motion(undetermined=("dz_mm", "tilt_x_mrad", "tilt_y_mrad", *_IN_PLANE))
    steep_at = settings.slope_min if is_in_mm else settings.slope_min * 0.1
    steep = np.hypot(cells.slope_x, cells.slope_y)[use] > steep_at
    near = Cells(
        cells.x[use], cells.y[use], cells.height_mm[use], np.where(steep, cells.slope_x[use], 0.0),
        np.where(steep, cells.slope_y[use], 0.0), cells.distance,
    )  # fmt: skip
    sigma = sigma[use]
    weight = _weight(sigma)
    flat, plane = _flat(near), _in_plane(near)

    still, still_reach = _robust(flat, start[use], weight)
    still_motion = Motion(float(still[0]), float(still[1]), float(still[2]))
    still_rest = residual_of(still_motion)[0][use]
    axes, root, names = _determined(plane, flat, sigma, settings, is_in_mm, float(np.mean(np.hypot(near.x, near.y))))
    moved = still_motion
    plane_root: tuple[tuple[float, float, float], ...] = ()
    if axes.shape[1]:
        full, full_reach = _gauss_newton(residual_of, use, flat, plane @ axes, axes, still_motion, is_in_mm)
        held = _held(full, settings, is_in_mm, has_datum)
        if held is not full:
            rest, doubt = (a[use] for a in residual_of(held))
            base, full_reach = _robust(flat, rest, _weight(doubt))
            full = _moved(held, base, np.zeros(3))
        rest, doubt = (a[use] for a in residual_of(full))
        # The move speaks through steep cells alone; the flat ones would only dilute the comparison.
        both = steep & np.isfinite(rest) & np.isfinite(still_rest)
        reach = min(full_reach, still_reach)
        if both.any():
            weight = _weight(doubt)
            before, after = (_cost(r[both], weight[both], reach) for r in (still_rest, rest))
            if has_datum or after < (1.0 - settings.gain_min) * before:
                moved, plane_root = full, root
    left = residual_of(moved)[0][use]
    left = left[np.isfinite(left)]
    scale = _spread_of(left - float(np.median(left))) if left.size else 0.0
    independent = max(left.size * BLOCK / settings.correlation_px, 1.0)
    return Motion(
        moved.dz_mm, moved.tilt_x, moved.tilt_y, moved.dx, moved.dy, moved.turn, names, scale, plane_root,
        max(scale, float(np.median(sigma))) / float(np.sqrt(independent)),
    )  # fmt: skip


def _moved(motion: Motion, flat: F64, plane: F64) -> Motion:
    dz, tilt_x, tilt_y, dx, dy, turn = (float(v) for v in motion.parameters + np.concatenate([flat, plane]))
    return Motion(dz, tilt_x, tilt_y, dx, dy, turn)


def _gauss_newton(
    residual_of: Residual, use: Bool, flat: F64, pull: F64, axes: F64, start: Motion, is_in_mm: bool
) -> tuple[Motion, float]:
    """The whole motion, and the final reach of the loss."""
    design = np.concatenate([flat, pull], axis=1)
    motion, reach = start, None
    settled = _SETTLED if is_in_mm else 10.0 * _SETTLED
    for _ in range(_STEPS):
        rest, sigma = (a[use] for a in residual_of(motion))
        seen = np.isfinite(rest) & np.isfinite(sigma)
        step, final = _robust(design[seen], rest[seen], _weight(sigma[seen]), reach)
        # From the second step on the start is good: a moderate reach keeps what wear looks like out.
        reach = 2.0 * final
        shift = axes @ step[3:]
        motion = _moved(motion, step[:3], shift)
        if float(np.hypot(shift[0], shift[1])) < settled and abs(shift[2]) < 1e-4:
            break
    return motion, final


def _held(motion: Motion, settings: RegistrationSettings, is_in_mm: bool, has_datum: bool) -> Motion:
    """The motion with its move in plane inside its bound, where no datum zone vouches for it."""
    limit = settings.shift_max_mm if is_in_mm else settings.shift_max_px
    length = float(np.hypot(motion.dx, motion.dy))
    turn = min(max(motion.turn, -1e-3 * settings.turn_max_mrad), 1e-3 * settings.turn_max_mrad)
    if has_datum or (length <= limit and turn == motion.turn):
        return motion
    share = limit / length if length > limit else 1.0
    return Motion(motion.dz_mm, motion.tilt_x, motion.tilt_y, motion.dx * share, motion.dy * share, turn)


def _determined(
    plane: F64, flat: F64, sigma: F64, settings: RegistrationSettings, is_in_mm: bool, radius: float
) -> tuple[F64, tuple[tuple[float, float, float], ...], tuple[str, ...]]:
    """Moves in plane that the surface determines.

    Returns:
        directions as columns (3, k) over (dx, dy, turn); rows whose outer products add up to the covariance
        of these three; the names of what is not determined.
    """
    alike = max(settings.correlation_px / BLOCK, 1.0)
    root = 1.0 / np.sqrt(alike * (sigma * sigma + _NOISE_FLOOR_MM**2))[:, None]
    lengths = np.array([1.0, 1.0, 1.0 / max(radius, 1e-9)])
    pulls = plane * lengths * root
    # Information on the move once dz and the tilts have taken their share (Schur complement).
    rest, *_ = np.linalg.lstsq(flat * root, pulls, rcond=None)
    remaining = pulls - (flat * root) @ rest
    information = remaining.T @ remaining
    values, vectors = np.linalg.eigh(information)
    sigmas = 1.0 / np.sqrt(np.maximum(values, 1e-12))
    enough = sigmas <= (settings.shift_sigma_max_mm if is_in_mm else settings.shift_sigma_max_mm * 10.0)
    if enough.all():
        axes = np.eye(3)
    else:
        lost = vectors[:, ~enough]
        # An undetermined direction that is nearly one of the part's axes is that one: the others stay pure.
        snapped = np.eye(3)[:, [int(np.argmax(np.abs(v))) for v in lost.T]]
        if np.all(np.max(np.abs(lost), axis=0) > 0.95) and np.linalg.matrix_rank(snapped) == lost.shape[1]:
            axes = np.eye(3)[:, ~snapped.any(axis=1)]
        else:
            axes = vectors[:, enough]
    share = np.sum(axes * axes, axis=1)
    names = tuple(n for n, s in zip(_IN_PLANE, share, strict=True) if s < 0.75)
    rows = (lengths[:, None] * vectors[:, enough] * sigmas[enough]).T
    return lengths[:, None] * axes, tuple((float(r[0]), float(r[1]), float(r[2])) for r in rows), names


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
    if 1e3 * abs(motion.turn) > settings.turn_max_mrad * 1.001:
        return f"part is turned by {1e3 * motion.turn:+.1f} mrad, {settings.turn_max_mrad:g} mrad are allowed"
    return None
