"""Golden and re-fixtured parts on the full-size simulated head, and their verdicts: what the judge's tests share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from tests.metrology.chains import calibrated, prepared
from wearline.artifact import Calibration
from wearline.messages import LinePoints, MeasureRequest
from wearline.recipe import Limits, Recipe, Zone
from wearline.scene import DEFAULT_HEAD, Array, Head, Light, Plane, StampedPart, Surface, mm_per_pixel, render, trace
from wearline_judge.core.golden import Golden, make_golden
from wearline_judge.core.judgement import Judgement, JudgingSettings, Setup, judge_points, make_setup
from wearline_judge.core.line_grid import F64, block_mean
from wearline_judge.core.teaching import Sample, teach
from wearline_reconstruct.core.calibration import Shot
from wearline_reconstruct.core.chain import Prepared, Reconstruction, prepare, reconstruct

DARK, BRIGHT = Light(ambient_dn=4.0), Light(ambient_dn=60.0)
LIGHTS = ("dark", "half", "bright")
PLATES_MM = (0.0, 2.0, 4.0, 6.0, 8.0)


@dataclass(frozen=True)
class Pose:
    """How a part lies: a rigid motion about the middle of the datum."""

    dx_mm: float = 0.0
    dy_mm: float = 0.0
    dz_mm: float = 0.0
    tilt_x_mrad: float = 0.0
    """Rotation about x: slope dz/dy. [mrad]"""
    tilt_y_mrad: float = 0.0
    """Rotation about -y: slope dz/dx. [mrad]"""
    turn_mrad: float = 0.0
    """Rotation about z, from x to y. [mrad]"""

    def matrix(self) -> Array:
        """Rotation (3, 3) from the part's frame to the world's."""
        a, b, c = 1e-3 * self.tilt_x_mrad, -1e-3 * self.tilt_y_mrad, 1e-3 * self.turn_mrad
        about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
        return np.asarray(about_x @ about_y @ about_z)


@dataclass(frozen=True)
class Refixtured:
    """A surface moved rigidly, exactly."""

    base: Surface
    pose: Pose

    def height_mm(self, x_mm: Array, y_mm: Array) -> Array:
        rotation, p = self.pose.matrix(), self.pose
        z = np.zeros(np.broadcast(x_mm, y_mm).shape) + p.dz_mm
        for _ in range(5):
            world = (x_mm - p.dx_mm, y_mm - p.dy_mm, z - p.dz_mm)
            own = [rotation[0, k] * world[0] + rotation[1, k] * world[1] + rotation[2, k] * world[2] for k in range(3)]
            z = z + (self.base.height_mm(own[0], own[1]) - own[2]) / rotation[2, 2]
        return np.asarray(z)


def random_pose(rng: np.random.Generator, shift_mm: float, tilt_mrad: float, dz_mm: float, turn_mrad: float) -> Pose:
    """Uniform within the bounds."""
    u = rng.uniform(-1.0, 1.0, 6)
    return Pose(shift_mm * u[0], shift_mm * u[1], dz_mm * u[2], tilt_mrad * u[3], tilt_mrad * u[4], turn_mrad * u[5])


def lit(head: Head, surface: Surface, light: str, seed: int) -> NDArray[np.uint8]:
    """One frame in the dark, in bright light, or with the right half of the picture in bright light."""
    if light == "half":
        left, right = render(head, surface, DARK, seed)[0], render(head, surface, BRIGHT, seed)[0]
        return np.concatenate([left[:, : head.cols // 2], right[:, head.cols // 2 :]], axis=1)
    return render(head, surface, {"dark": DARK, "bright": BRIGHT}[light], seed)[0]


@cache
def full_calibration(head: Head = DEFAULT_HEAD, shots: int = 3) -> Calibration:
    """From plates that the simulated head renders."""
    frames = [
        Shot(z, render(head, Plane(z), Light(), 4000 + 10 * k + s)[0], f"plate {z:g} mm")
        for k, z in enumerate(PLATES_MM)
        for s in range(shots)
    ]
    return calibrated(frames, head.lines, head.vertical)


def line_points(found: Reconstruction) -> LinePoints:
    """As reconstruct would send them."""
    request = MeasureRequest(
        cycle_id="c", is_simulated=True, object_index=1, stroke=1, measure_number=1, time_left_ms=2500.0
    )
    return LinePoints(
        cycle_id="c", is_simulated=True, request=request,
        points=found.points, sigma_frame_mm=found.sigma_frame_mm, coverage=found.coverage, quality=found.quality,
    )  # fmt: skip


@dataclass(frozen=True)
class Bench:
    """A taught head: what it takes to judge parts of one object."""

    head: Head
    calibration: Calibration
    chain: Prepared
    golden: Golden

    def points_of(self, pixels: NDArray[np.uint8]) -> LinePoints:
        """One frame, measured."""
        return line_points(reconstruct(pixels, self.chain))

    def measure(self, surface: Surface, light: str, seed: int) -> LinePoints:
        """One frame of a part, measured."""
        return self.points_of(lit(self.head, surface, light, seed))

    def setup(self, recipe: Recipe | None = None) -> Setup:
        """For a recipe."""
        return make_setup(self.golden, recipe or Recipe())

    def judge(self, surface: Surface, light: str, seed: int, recipe: Recipe | None = None) -> Judgement:
        """One frame of a part, judged."""
        return judge_points(self.measure(surface, light, seed), self.setup(recipe), JudgingSettings())


@cache
def bench(head: Head = DEFAULT_HEAD, golden: Surface | None = None, frames: int = 8) -> Bench:
    """Calibrate a head and teach it a part in ordinary light."""
    calibration = full_calibration(head)
    part = golden if golden is not None else StampedPart()
    free = prepared(calibration)
    recipe = Recipe(mm_per_pixel=mm_per_pixel(head))
    taught = [
        Sample(f"golden {k}", line_points(reconstruct(render(head, part, Light(), 5000 + k)[0], free)))
        for k in range(frames)
    ]
    template = teach(taught, calibration, "c", recipe, "r", JudgingSettings())
    return Bench(head, calibration, prepare(calibration, Recipe(), template), make_golden(template, None))


def worn(wear_mm: float) -> StampedPart:
    """The demo part with a worn draw radius."""
    return replace(StampedPart(), wear_mm=wear_mm)


def box(name: str, low_mm: tuple[float, float], high_mm: tuple[float, float], limits: Limits | None = None) -> Zone:
    """A rectangle on the default head's part, corners in mm from the middle of the picture."""
    (x0, y0), (x1, y1) = ((811.5 + 10.0 * x, 611.5 + 10.0 * y) for x, y in (low_mm, high_mm))
    return Zone(name=name, polygon_px=((x0, y0), (x1, y0), (x1, y1), (x0, y1)), limits=limits or Limits())


@cache
def _places(head: Head) -> tuple[F64, F64]:
    """(line, block): x and y on the golden part. [mm]"""
    truth = trace(head, StampedPart())
    seen = np.isfinite(truth.z_mm)
    return block_mean(truth.x_mm, seen), block_mean(truth.y_mm, seen)


def true_deviation(taught: Bench, part: StampedPart) -> F64:
    """(line, block): what wear took from the golden part. [mm]"""
    return -part.worn_away_mm(*_places(taught.head))
