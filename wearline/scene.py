"""The simulated laser head and the wearing part, truth included.

World: x along the laser lines, y across them (image columns and rows), z towards the camera; the
datum z = 0 is the plane that the camera sees squarely. All lengths in mm. The camera is a pinhole
with radial distortion (Brown), the laser a fan of planes through one point, tilted about x. For
each line and integer column the point is solved where laser plane, line of sight and surface meet,
so that the truth is exact to the solver's tolerance, far below a thousandth of a pixel.

Only simulators, benchmarks, demo and tests import this file.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

_SOLVED_MM = 1e-7  # residual that ends the search
_ACCEPTED_MM = 1e-5  # residual of a point that counts as seen: less than 1e-4 px
_BLOCKED_MM = 0.02  # how far a ray must dip below the surface to count as blocked
_DEEP_MM = -200.0  # stands for "nothing there" while solving


@dataclass(frozen=True)
class Head:
    """One camera with its laser, fixed to each other."""

    rows: int = 1224
    cols: int = 1624
    lines: int = 25
    vertical: bool = False
    """The laser lines run along the sensor's rows axis (picture transposed)."""
    focal_px: float = 6000.0
    """Focal length. [px]"""
    distance_mm: float = 600.0
    """From the camera's centre of projection to the datum. [mm]"""
    centre_row_px: float | None = None
    centre_col_px: float | None = None
    """Principal point; None = middle of the sensor. [px]"""
    k1: float = -0.15
    k2: float = 0.4
    """Radial distortion of normalised coordinates (Brown)."""
    laser_angle_deg: float = 30.0
    """Between laser and camera axis; negative = laser from the other side, so that lines move the other way. [deg]"""
    laser_distance_mm: float = 520.0
    """From the fan's point to the middle of the datum. [mm]"""
    pitch_mm: float = 4.0
    """Distance of the lines about the middle of the datum. [mm]"""
    laser_roll_mrad: float = 4.0
    """Rotation of the lines against the sensor's rows. [mrad]"""
    stripe_sigma_px: float = 2.0
    """Gaussian sigma of a stripe, across. [px]"""
    spot_sigma_px: float = 7.0
    """Gaussian sigma of the centre spot. [px]"""
    spot_gain: float = 1.6
    """Height of the centre spot over that of its line."""
    speckle_contrast: float = 0.35
    """Standard deviation over mean of the stripe's intensity."""
    speckle_length_px: float = 1.5
    """Distance at which the speckle's underlying correlation has fallen to 1/e, along and across. [px]"""
    read_noise_dn: float = 1.0
    """[DN]"""
    gain_dn_per_e: float = 0.024
    """Full well of about 10 600 electrons at 255 DN. [DN/e]"""

    @property
    def middle_line(self) -> int:
        """Number of the line that bears the centre spot."""
        return self.lines // 2


DEFAULT_HEAD = Head()


class Surface(Protocol):
    """Anything that the lines may fall on."""

    def height_mm(self, x_mm: Array, y_mm: Array) -> Array:
        """Height over the datum, towards the camera; NaN = nothing there. [mm]"""
        ...


@dataclass(frozen=True)
class Plane:
    """A flat plate."""

    z_mm: float = 0.0
    tilt_x_mrad: float = 0.0
    """Rotation about x: slope dz/dy. [mrad]"""
    tilt_y_mrad: float = 0.0
    """Rotation about y: slope dz/dx. [mrad]"""

    def height_mm(self, x_mm: Array, y_mm: Array) -> Array:
        return self.z_mm + 1e-3 * (self.tilt_x_mrad * y_mm + self.tilt_y_mrad * x_mm) + 0.0 * (x_mm + y_mm)


def _smooth_step(t: Array) -> Array:
    """0 below t = 0, 1 above t = 1, with two continuous derivatives."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * t * (t * (6.0 * t - 15.0) + 10.0)


@dataclass(frozen=True)
class StampedPart:
    """A drawn tray, bottom up: flange, wall, plateau with an embossed dome; its draw radius wears.

    Heights run from 0.6 mm (flange) to about 7.6 mm (dome).
    """

    wear_mm: float = 0.0
    """Largest depth of material that the worn draw radius lacks. [mm]"""
    dx_mm: float = 0.0
    dy_mm: float = 0.0
    dz_mm: float = 0.0
    tilt_x_mrad: float = 0.0
    tilt_y_mrad: float = 0.0
    spring_mm: float = 0.0
    """Bow of the plateau by spring-back, which scatters from stroke to stroke. [mm]"""

    flange_mm: float = 0.6
    draw_mm: float = 6.0
    dome_mm: float = 1.0
    half_length_mm: float = 50.0
    half_width_mm: float = 30.0
    corner_mm: float = 22.0
    wall_mm: float = 16.0
    """Width over which the wall rises, both radii included. [mm]"""

    def outline_mm(self, x_mm: Array, y_mm: Array) -> Array:
        """Distance to the middle of the wall, negative inside, in the part's own frame. [mm]"""
        qx = np.abs(x_mm) - (self.half_length_mm - self.corner_mm)
        qy = np.abs(y_mm) - (self.half_width_mm - self.corner_mm)
        outside = np.hypot(np.maximum(qx, 0.0), np.maximum(qy, 0.0))
        return np.asarray(outside + np.minimum(np.maximum(qx, qy), 0.0) - self.corner_mm)

    def worn_away_mm(self, x_mm: Array, y_mm: Array) -> Array:
        """Depth of the missing material, in the part's own frame: along the draw radius, deepest at one corner."""
        return self._worn_away(x_mm, y_mm, self.outline_mm(x_mm, y_mm))

    def _worn_away(self, x_mm: Array, y_mm: Array, outline_mm: Array) -> Array:
        across = np.clip((outline_mm + 4.0) / 11.0, -1.0, 1.0)
        band = (1.0 - across * across) ** 2
        spread = ((x_mm - 34.0) / 30.0) ** 2 + ((y_mm - 20.0) / 22.0) ** 2
        return np.asarray(self.wear_mm * band * (0.12 + 0.88 * np.exp(-0.5 * spread)))

    def own_height_mm(self, x_mm: Array, y_mm: Array) -> Array:
        """Height in the part's own frame, without its pose. [mm]"""
        outline = self.outline_mm(x_mm, y_mm)
        inside = _smooth_step(0.5 - outline / self.wall_mm)
        z = self.flange_mm + self.draw_mm * inside
        dome = np.clip(1.0 - ((x_mm + 22.0) ** 2 + y_mm**2) / 14.0**2, 0.0, 1.0)
        z = z + self.dome_mm * dome**3
        if self.spring_mm:
            z = z + self.spring_mm * inside * (1.0 - (x_mm / self.half_length_mm) ** 2)
        if self.wear_mm:
            z = z - self._worn_away(x_mm, y_mm, outline)
        return np.asarray(z)

    def height_mm(self, x_mm: Array, y_mm: Array) -> Array:
        z = self.own_height_mm(x_mm - self.dx_mm, y_mm - self.dy_mm)
        return np.asarray(z + self.dz_mm + 1e-3 * (self.tilt_x_mrad * y_mm + self.tilt_y_mrad * x_mm))


@dataclass(frozen=True)
class Step:
    """Two plates with a sharp edge between them."""

    low_mm: float = 0.0
    high_mm: float = 3.0
    edge_mm: float = 0.0
    across: str = "x"
    """The coordinate that crosses the edge: "x" or "y"; high where it is larger than edge_mm."""

    def height_mm(self, x_mm: Array, y_mm: Array) -> Array:
        place = x_mm + 0.0 * y_mm if self.across == "x" else y_mm + 0.0 * x_mm
        return np.where(place > self.edge_mm, self.high_mm, self.low_mm)


@dataclass(frozen=True)
class Hole:
    """A round hole in another surface."""

    base: Surface
    x_mm: float = 0.0
    y_mm: float = 0.0
    radius_mm: float = 8.0
    depth_mm: float | None = None
    """None = through. [mm]"""

    def height_mm(self, x_mm: Array, y_mm: Array) -> Array:
        z = self.base.height_mm(x_mm, y_mm)
        is_in = np.hypot(x_mm - self.x_mm, y_mm - self.y_mm) < self.radius_mm
        return np.where(is_in, np.nan if self.depth_mm is None else z - self.depth_mm, z)


@dataclass(frozen=True)
class Flake:
    """A square sliver of metal on another surface."""

    base: Surface
    x_mm: float = 0.0
    y_mm: float = 0.0
    size_mm: float = 10.0
    thickness_mm: float = 0.2

    def height_mm(self, x_mm: Array, y_mm: Array) -> Array:
        half = 0.5 * self.size_mm
        is_on = (np.abs(x_mm - self.x_mm) < half) & (np.abs(y_mm - self.y_mm) < half)
        return self.base.height_mm(x_mm, y_mm) + np.where(is_on, self.thickness_mm, 0.0)


@dataclass(frozen=True)
class Light:
    """What falls on the part during one exposure."""

    ambient_dn: float = 12.0
    """Background at 10 ms. [DN]"""
    exposure_us: float = 10000.0
    """Laser and ambient light scale with it. [us]"""
    laser_dn: float = 110.0
    """Mean height of the middle line's stripe at 10 ms. [DN]"""
    texture: float = 0.08
    """Standard deviation of the sheet's reflectivity, streaky along x; laser and ambient light alike."""
    vibration_px: float = 0.05
    """Standard deviation of a shift of the whole picture across the lines, the same for one frame. [px]"""


@dataclass(frozen=True)
class Truth:
    """What is exactly in the picture; arrays are [line, column].

    For a vertical head "row" and "column" change places: `row_px` runs across the lines, which is
    the sensor's column, and `col` counts sensor rows.
    """

    row_px: Array
    """Raw (distorted) position of the stripe's centre across the lines, vibration included; NaN = not visible. [px]"""
    z_mm: Array
    x_mm: Array
    y_mm: Array
    col: NDArray[np.int64]
    """Integer columns, 0 .. columns - 1."""
    spot_row_px: float
    spot_col_px: float
    """Centre of the spot; NaN = not visible. [px]"""


def mm_per_pixel(head: Head) -> float:
    """Lateral scale on the datum. [mm/px]"""
    return head.distance_mm / head.focal_px


def _frame(head: Head) -> tuple[int, int, float, float]:
    """Pixels across the lines and along them, and the principal point in that order."""
    rows, cols = (head.cols, head.rows) if head.vertical else (head.rows, head.cols)
    sensor_row = 0.5 * (head.rows - 1) if head.centre_row_px is None else head.centre_row_px
    sensor_col = 0.5 * (head.cols - 1) if head.centre_col_px is None else head.centre_col_px
    return (rows, cols, sensor_col, sensor_row) if head.vertical else (rows, cols, sensor_row, sensor_col)


def laser_point_mm(head: Head) -> tuple[float, float, float]:
    """The fan's point (x, y, z); y runs across the lines. [mm]"""
    angle = math.radians(head.laser_angle_deg)
    return 0.0, -head.laser_distance_mm * math.sin(angle), head.laser_distance_mm * math.cos(angle)


def laser_planes(head: Head) -> Array:
    """Planes n . p = c through the fan's point, one row (nx, ny, nz, c) per line, top to bottom, n of unit length.

    The angles between neighbours are equal, as behind a diffractive grating.
    """
    step = head.pitch_mm * math.cos(math.radians(head.laser_angle_deg)) / head.laser_distance_mm
    tilt = math.radians(head.laser_angle_deg) + step * (np.arange(head.lines) - head.middle_line)
    roll = 1e-3 * head.laser_roll_mrad
    # A sheet holds its central ray (0, sin, -cos) and the direction of its lines (cos roll, sin roll, 0).
    ray = np.stack([np.zeros_like(tilt), np.sin(tilt), -np.cos(tilt)], axis=1)
    along = np.array([math.cos(roll), math.sin(roll), 0.0])
    normal = np.cross(ray, along)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.column_stack([normal, normal @ np.array(laser_point_mm(head))])


def _stretch(head: Head, xn: Array, yn: Array) -> Array:
    r2 = xn * xn + yn * yn
    return np.asarray(1.0 + r2 * (head.k1 + head.k2 * r2))


def project(head: Head, x_mm: Array, y_mm: Array, z_mm: Array) -> tuple[Array, Array]:
    """World to raw pixels (across the lines, along them), distortion included. [px]"""
    _, _, centre_across, centre_along = _frame(head)
    depth = head.distance_mm - z_mm
    xn, yn = x_mm / depth, y_mm / depth
    stretch = head.focal_px * _stretch(head, xn, yn)
    return centre_across + stretch * yn, centre_along + stretch * xn


class _Turned:
    """A surface as a vertical head's own frame sees it."""

    def __init__(self, surface: Surface) -> None:
        self._surface = surface

    def height_mm(self, x_mm: Array, y_mm: Array) -> Array:
        return self._surface.height_mm(y_mm, x_mm)


def trace(head: Head, surface: Surface) -> Truth:
    """Where the lines fall, without any light: exact geometry, occlusion included."""
    rows, cols, centre_across, centre_along = _frame(head)
    own: Surface = _Turned(surface) if head.vertical else surface
    half_x, half_y = (0.55 * n * mm_per_pixel(head) for n in (cols, rows))
    grid_x, grid_y = np.meshgrid(np.linspace(-half_x, half_x, 97), np.linspace(-half_y, half_y, 97))
    top = float(np.nanmax(own.height_mm(grid_x, grid_y))) + 0.5

    xd: Array = (np.arange(cols, dtype=np.float64) - centre_along)[None, :] / head.focal_px
    row, x, y, z = _solve(head, own, laser_planes(head), xd, top, centre_across)
    is_seen = np.isfinite(z) & (row >= 0.0) & (row <= rows - 1.0)
    for source in (laser_point_mm(head), (0.0, 0.0, head.distance_mm)):
        is_seen &= ~_is_blocked(own, x, y, z, source, max(top, float(np.max(z[is_seen], initial=top))))

    # The spot is where the middle sheet crosses x = 0; the column follows from the projection.
    spot_row, _, _, spot_z = _solve(
        head, own, laser_planes(head)[head.middle_line : head.middle_line + 1], np.zeros((1, 1)), top, centre_across
    )
    spot = float(spot_row[0, 0]) if np.isfinite(spot_z[0, 0]) else math.nan
    nearest = int(np.clip(round(centre_along), 0, cols - 1))
    if not is_seen[head.middle_line, nearest]:
        spot = math.nan
    row, x, y, z = (np.where(is_seen, a, np.nan) for a in (row, x, y, z))
    if head.vertical:
        x, y = y, x
    return Truth(row, z, x, y, np.arange(cols), spot, centre_along if math.isfinite(spot) else math.nan)


def _solve(
    head: Head, surface: Surface, planes: Array, xd: Array, top_mm: float, centre_across: float
) -> tuple[Array, Array, Array, Array]:
    """Row, x, y, z where sheet, column of sight and surface meet; NaN where no point was found.

    Starts above the surface, so that of several crossings the one is found that the laser meets first.
    """
    nx, ny, nz, c = (planes[:, i : i + 1] for i in range(4))
    shape = (planes.shape[0], xd.shape[1])
    xn = np.broadcast_to(xd, shape).copy()
    yn = np.zeros(shape)
    z = np.full(shape, top_mm)
    z_before = z
    gap_before = np.full(shape, np.nan)
    for turn in range(16):
        # Distortion couples column and row so weakly (about 0.005) that it settles within the same loop.
        xn = xd / _stretch(head, xn, yn)
        depth = head.distance_mm - z
        x = xn * depth
        y = (c - nx * x - nz * z) / ny
        yn = y / depth
        height = surface.height_mm(x, y)
        gap = z - np.where(np.isnan(height), _DEEP_MM, height)
        if turn == 15 or (turn > 5 and float(np.max(np.abs(gap))) < _SOLVED_MM):
            break
        # Plain substitution first, which is robust; then the secant, which is fast.
        slope = np.ones(shape)
        if turn >= 4:
            moved = z - z_before
            np.divide(gap - gap_before, moved, out=slope, where=np.abs(moved) > 1e-12)
            slope = np.clip(slope, 0.25, 4.0)
        z_before, gap_before = z, gap
        z = z - gap / slope
    row = centre_across + head.focal_px * yn * _stretch(head, xn, yn)
    is_solved = (np.abs(gap) < _ACCEPTED_MM) & np.isfinite(height)
    return (
        np.where(is_solved, row, np.nan),
        np.where(is_solved, x, np.nan),
        np.where(is_solved, y, np.nan),
        np.where(is_solved, z, np.nan),
    )


def _is_blocked(
    surface: Surface, x: Array, y: Array, z: Array, source: tuple[float, float, float], top_mm: float
) -> NDArray[np.bool_]:
    """Whether the surface stands between each point and the source; NaN points are not."""
    blocked = np.zeros(x.shape, dtype=np.bool_)
    share_to_top = np.clip((top_mm - z) / (source[2] - z), 0.0, 1.0)
    # Denser near the point, where a wall that blocks grazing light stands.
    for step in np.linspace(0.0, 1.0, 15)[1:] ** 1.5:
        share = step * share_to_top
        height = surface.height_mm(x + share * (source[0] - x), y + share * (source[1] - y))
        blocked |= height > z + share * (source[2] - z) + _BLOCKED_MM
    return blocked


def _speckle(head: Head, shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float32]:
    """Gamma distributed intensity of mean 1 (Wilson and Hilferty's cube of a smooth normal field)."""
    field = rng.standard_normal(shape, dtype=np.float32)
    sigma = 0.5 * head.speckle_length_px
    if sigma > 0.1:
        offset = np.arange(-math.ceil(3.0 * sigma), math.ceil(3.0 * sigma) + 1)
        taps = np.exp(-0.5 * (offset / sigma) ** 2)
        taps /= np.linalg.norm(taps)  # keeps the variance at 1
        cv2.sepFilter2D(field, -1, taps, taps, dst=field, borderType=cv2.BORDER_REFLECT_101)
    c = head.speckle_contrast
    field *= np.float32(c / 3.0)
    field += np.float32(1.0 - c * c / 9.0)
    np.maximum(field, 0.0, out=field)
    return field * field * field


def _sheet(light: Light, shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float32]:
    """Reflectivity about 1: streaks of rolling along the lines."""
    coarse = rng.standard_normal((shape[0] // 5 + 2, shape[1] // 60 + 2), dtype=np.float32)
    # Linear interpolation of independent nodes keeps 2/3 of the standard deviation.
    coarse = np.float32(1.5 * light.texture) * coarse + np.float32(1.0)
    fine = cv2.resize(np.maximum(coarse, np.float32(0.1)), (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(fine, dtype=np.float32)


def render(head: Head, surface: Surface, light: Light | None = None, seed: int = 0) -> tuple[NDArray[np.uint8], Truth]:
    """One frame, uint8 [head.rows, head.cols], and its truth; the same arguments give the same pixels."""
    light = light or Light()
    rng = np.random.Generator(np.random.SFC64(seed))
    truth = trace(head, surface)
    shift = light.vibration_px * float(rng.standard_normal())
    truth = replace(truth, row_px=truth.row_px + shift, spot_row_px=truth.spot_row_px + shift)
    rows, cols, _, _ = _frame(head)
    exposed = light.exposure_us / 10000.0

    image = np.zeros((rows, cols), dtype=np.float32)
    _draw_lines(image, head, truth, light.laser_dn * exposed)
    _draw_spot(image, head, truth, light.laser_dn * exposed * head.spot_gain)
    image *= _speckle(head, (rows, cols), rng)
    image += np.float32(light.ambient_dn * exposed)
    image *= _sheet(light, (rows, cols), rng)
    noise = rng.standard_normal((rows, cols), dtype=np.float32)
    noise *= np.sqrt(image * np.float32(head.gain_dn_per_e) + np.float32(head.read_noise_dn**2))
    image += noise
    np.rint(image, out=image)
    np.clip(image, 0.0, 255.0, out=image)
    pixels = image.astype(np.uint8)
    return (np.ascontiguousarray(pixels.T) if head.vertical else pixels), truth


def _draw_lines(image: NDArray[np.float32], head: Head, truth: Truth, peak_dn: float) -> None:
    rows, cols = image.shape
    is_seen = np.isfinite(truth.row_px)
    row = np.where(is_seen, truth.row_px, 0.0)
    # Where a line climbs, the section along the sensor's column is wider than the one across the line.
    climb = np.abs(np.gradient(row, axis=1))
    climb[climb > 3.0] = 0.0  # a jump between two pieces, no slope
    sigma = (head.stripe_sigma_px * np.sqrt(1.0 + climb * climb)).astype(np.float32)
    centre = np.rint(row).astype(np.int64)
    offset = (row - centre).astype(np.float32)
    along = (np.arange(cols) - 0.5 * (cols - 1)) / (0.5 * cols)
    across = (np.arange(head.lines) - head.middle_line) / max(head.middle_line, 1)
    power = peak_dn * (1.0 - 0.2 * across[:, None] ** 2) * (1.0 - 0.2 * along[None, :] ** 2)
    power = np.where(is_seen, power, 0.0).astype(np.float32)
    scale = np.float32(-0.5) / (sigma * sigma)
    column = np.broadcast_to(np.arange(cols), row.shape)
    flat = image.reshape(-1)
    for k in range(-math.ceil(4.0 * float(sigma.max())), math.ceil(4.0 * float(sigma.max())) + 1):
        target = centre + k
        distance = np.float32(k) - offset
        value = power * np.exp(scale * distance * distance)
        value[(target < 0) | (target >= rows)] = 0.0
        index = np.clip(target, 0, rows - 1) * cols + column
        # Line by line in halves: neighbours never share a pixel within one, so nothing is lost.
        for first in (0, 1):
            flat[index[first::2]] += value[first::2]


def _draw_spot(image: NDArray[np.float32], head: Head, truth: Truth, peak_dn: float) -> None:
    if not math.isfinite(truth.spot_row_px):
        return
    rows, cols = image.shape
    reach = math.ceil(4.0 * head.spot_sigma_px)
    top, left = max(round(truth.spot_row_px) - reach, 0), max(round(truth.spot_col_px) - reach, 0)
    r = np.arange(top, min(top + 2 * reach + 1, rows)) - truth.spot_row_px
    c = np.arange(left, min(left + 2 * reach + 1, cols)) - truth.spot_col_px
    spot = np.exp(-0.5 * (r[:, None] ** 2 + c[None, :] ** 2) / head.spot_sigma_px**2)
    image[top : top + r.size, left : left + c.size] += (peak_dn * spot).astype(np.float32)


WEAR_AT_LIMIT_MM = 0.173
"""Wear at which the true mean error of the demo part reaches 0.10 mm. [mm]"""
STROKES_TO_LIMIT = 65.0
"""From service to that wear. [strokes]"""


def wear_at(stroke: int, regrinds: Sequence[int] = ()) -> float:
    """Wear of the demo die, for `StampedPart.wear_mm`: from nothing after each regrind, rising ever faster. [mm]

    The steps differ from stroke to stroke, always in the same way, and never go back.
    """
    done = sorted(regrinds)
    at = bisect.bisect_right(done, stroke)
    count = stroke - (done[at - 1] if at else 0)
    if count <= 0:
        return 0.0
    jitter = ((stroke * 2654435761) % 4294967296) / 4294967296.0
    return WEAR_AT_LIMIT_MM * float(((count + 0.9 * (jitter - 0.5)) / STROKES_TO_LIMIT) ** 1.5)


def part_of_stroke(stroke: int, regrinds: Sequence[int] = (), seed: int = 1) -> StampedPart:
    """What the demo die makes of one stroke: worn, with a pose and spring-back that scatter; always the same part."""
    rng = np.random.default_rng([seed, stroke, 20])
    dx, dy, dz, tilt_x, tilt_y, spring = (float(v) for v in rng.standard_normal(6))
    return StampedPart(
        wear_mm=wear_at(stroke, regrinds),
        dx_mm=0.03 * dx,
        dy_mm=0.03 * dy,
        dz_mm=0.03 * dz,
        tilt_x_mrad=0.2 * tilt_x,
        tilt_y_mrad=0.2 * tilt_y,
        spring_mm=0.004 * spring,
    )


def true_errors(head: Head, worn: Surface, golden: Surface, precision_mm: float = 0.05) -> tuple[float, float]:
    """Mean absolute deviation where it exceeds `precision_mm` (0 = nowhere) and largest signed one, worn - golden. [mm]

    Over the field that the lines cover on the datum, from exact geometry. Poses of stamped parts do
    not count: a rigid motion is no wear.
    """
    half = mm_per_pixel(head) * 0.5 * (head.rows if head.vertical else head.cols)
    reach = 0.5 * head.lines * head.pitch_mm
    x, y = np.meshgrid(np.arange(-half, half, 0.25), np.arange(-reach, reach, 0.25))
    if head.vertical:
        x, y = y, x
    deviation = _own_height(worn, x, y) - _own_height(golden, x, y)
    size = np.abs(deviation)
    is_deviating = size > precision_mm
    mean = float(np.mean(size[is_deviating])) if bool(is_deviating.any()) else 0.0
    flat = deviation[np.isfinite(deviation)]
    return mean, float(flat[np.argmax(np.abs(flat))]) if flat.size else 0.0


def _own_height(surface: Surface, x: Array, y: Array) -> Array:
    return surface.own_height_mm(x, y) if isinstance(surface, StampedPart) else surface.height_mm(x, y)
