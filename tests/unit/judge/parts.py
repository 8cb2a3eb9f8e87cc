"""Line points of parts with known truth, without an image: fast, and independent of reconstruct."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.metrology.renderer import Comb
from wearline.artifact import Calibration, Template, content_hash
from wearline.messages import FrameQuality, LinePoints, MeasureRequest
from wearline.recipe import Recipe, recipe_hash
from wearline_judge.core.judgement import JudgingSettings
from wearline_judge.core.teaching import Sample, teach

F64 = NDArray[np.float64]
COMB = Comb()
MM_PER_PIXEL = 0.1
NOISE_MM = 0.01
FLAW = (330.0, 240.0, 60.0, 60.0)
"""x, y and half axes of where parts are flawed. [px]"""


def calibration(comb: Comb = COMB) -> Calibration:
    """The comb's exact calibration."""
    start = comb.at_datum()
    return Calibration(
        a_mm_per_px=np.full(start.shape, comb.a_mm_per_px), across0_px=start, b_per_px=comb.b_per_px,
        z_sigma_mm=np.full(start.shape, 0.003), z_range_mm=np.array([-3.0, 9.0]),
        image_shape=np.array([comb.along, comb.across] if comb.is_vertical else [comb.across, comb.along]),
        is_vertical=comb.is_vertical, spot_px=np.array([240.0, 320.0]), stripe_width_px=1.8,
        noise=np.array([1.5, 0.02, 0.3, 2.0]), mm_per_pixel=MM_PER_PIXEL,
    )  # fmt: skip


CALIBRATION = calibration()
CALIBRATION_BYTES = CALIBRATION.to_bytes()
CALIBRATION_HASH = content_hash(CALIBRATION_BYTES)


@dataclass(frozen=True)
class Part:
    """A tray with a round hill, and what may be wrong with it."""

    flaw_mm: float = 0.0
    """Height of a smooth bump at FLAW. [mm]"""
    dz_mm: float = 0.0
    tilt_x_mrad: float = 0.0
    dx_px: float = 0.0
    dy_px: float = 0.0
    hidden: tuple[float, float] = (0.0, 0.0)
    """Columns between these are not seen. [px]"""

    def height_mm(self, x: F64, y: F64) -> F64:
        px, py = x - self.dx_px, y - self.dy_px
        z = 1.0 + 2.0 * np.exp(-0.5 * (((px - 300.0) / 90.0) ** 2 + ((py - 240.0) / 70.0) ** 2))
        z = z + 0.8 * np.exp(-0.5 * (((px - 520.0) / 40.0) ** 2 + ((py - 150.0) / 60.0) ** 2))
        r = ((x - FLAW[0]) / FLAW[2]) ** 2 + ((y - FLAW[1]) / FLAW[3]) ** 2
        z = z + self.flaw_mm * np.clip(1.0 - r, 0.0, None) ** 0.5
        z = z + self.dz_mm + 1e-3 * self.tilt_x_mrad * MM_PER_PIXEL * (y - 240.0)
        return np.where((x > self.hidden[0]) & (x < self.hidden[1]), np.nan, z)


def request(stroke: int = 1, object_index: int = 1, is_simulated: bool = False) -> MeasureRequest:
    return MeasureRequest(
        cycle_id=f"c-{stroke:05d}", is_simulated=is_simulated, object_index=object_index, part_id=f"P{stroke}",
        stroke=stroke, measure_number=stroke % 65535 + 1, time_left_ms=2500.0,
    )  # fmt: skip


def line_points(
    part: Part,
    stroke: int = 1,
    *,
    comb: Comb = COMB,
    noise_mm: float = NOISE_MM,
    recipe: Recipe | None = None,
    object_index: int = 1,
    is_simulated: bool = False,
) -> LinePoints:
    """What reconstruct would say of this part; the stroke is the seed of the noise."""
    rng = np.random.default_rng(stroke)
    start = comb.at_datum()
    along = np.broadcast_to(np.arange(comb.along, dtype=np.float64), start.shape)
    # The line lies where the surface is: two steps towards it are enough for slopes far below 1.
    across = start
    for _ in range(6):
        x, y = (across, along) if comb.is_vertical else (along, across)
        z = part.height_mm(x, y)
        across = start + z / (comb.a_mm_per_px - comb.b_per_px * z)
    line, place = np.nonzero(np.isfinite(z) & (across > 2.0) & (across < comb.across - 3.0))
    height = z[line, place] + rng.normal(0.0, noise_mm, line.size)
    row, col = (place, across[line, place]) if comb.is_vertical else (across[line, place], place)
    points = np.column_stack([line, row, col, height, np.full(line.size, noise_mm)]).astype(np.float32)
    asked = request(stroke, object_index, is_simulated)
    return LinePoints(
        cycle_id=asked.cycle_id, is_simulated=is_simulated, request=asked, points=points, sigma_frame_mm=0.002,
        coverage=1.0, quality=FrameQuality(lines_seen=comb.lines, spot_found=True), timings_ms={"total": 12.5},
        frame_hash=f"{stroke:064x}", calibration_hash=CALIBRATION_HASH, recipe_hash=recipe_hash(recipe or Recipe()),
    )  # fmt: skip


def golden_template(recipe: Recipe | None = None, frames: int = 4) -> Template:
    """From good parts that lie a little differently each time."""
    ruling = recipe or Recipe()
    rng = np.random.default_rng(9)
    samples = [
        Sample(
            f"golden {n}",
            line_points(Part(dz_mm=0.02 * rng.normal(), tilt_x_mrad=0.3 * rng.normal()), 9000 + n, recipe=ruling),
        )
        for n in range(frames)
    ]
    return teach(samples, CALIBRATION, CALIBRATION_HASH, ruling, recipe_hash(ruling), JudgingSettings())
