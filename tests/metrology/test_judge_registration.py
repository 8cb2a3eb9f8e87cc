"""Re-fixturing is removed, wear is not: full-size rendered parts with exact rigid motions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from tests.metrology.parts import Pose, Refixtured, bench, box, true_deviation, worn
from wearline.messages import Decision
from wearline.recipe import Recipe
from wearline.scene import DEFAULT_HEAD, Array, StampedPart
from wearline_judge.core.judgement import JudgingSettings, judge_points
from wearline_judge.core.line_grid import F64

pytestmark = pytest.mark.timeout(600)  # the first test calibrates and teaches at full size

HALF_DEGREE = 8.727
PART = StampedPart()


@dataclass(frozen=True)
class Channel:
    """A profile drawn along x: a shift along x cannot be seen on it."""

    def height_mm(self, x_mm: Array, y_mm: Array) -> Array:
        return 2.0 + 2.0 * np.sin(y_mm / 9.0) + 0.0 * x_mm


@pytest.mark.parametrize(
    "pose",
    [
        Pose(dx_mm=1.0),
        Pose(dx_mm=-0.8, dy_mm=-0.6),
        Pose(dy_mm=1.0),
        Pose(dz_mm=1.0),
        Pose(tilt_x_mrad=HALF_DEGREE),
        Pose(tilt_y_mrad=-HALF_DEGREE),
        Pose(turn_mrad=HALF_DEGREE),
        Pose(0.7, -0.7, 0.5, HALF_DEGREE, -HALF_DEGREE, HALF_DEGREE),
    ],
)
def test_refixturing_is_removed(pose: Pose) -> None:
    judged = bench().judge(Refixtured(PART, pose), "dark", 41)
    assert judged.fields["decision"] is Decision.PASSED, judged.fields["reason"]
    assert judged.comparison is not None
    found = judged.comparison.motion
    assert abs(found.dx - pose.dx_mm) < 0.06 and abs(found.dy - pose.dy_mm) < 0.06
    assert abs(found.dz_mm - pose.dz_mm) < 0.04
    assert abs(1e3 * found.tilt_x - pose.tilt_x_mrad) < 0.3 and abs(1e3 * found.tilt_y - pose.tilt_y_mrad) < 0.3
    assert abs(1e3 * found.turn - pose.turn_mrad) < 1.0


def test_what_the_surface_does_not_determine_stays_zero_and_is_named() -> None:
    taught = bench(DEFAULT_HEAD, Channel())
    judged = taught.judge(Refixtured(Channel(), Pose(dx_mm=0.8, dy_mm=0.5, dz_mm=0.3)), "dark", 42)
    registration = judged.fields["registration"]
    assert registration.undetermined == ("dx_mm",)
    assert registration.dx_mm == 0.0
    assert abs(registration.dy_mm - 0.5) < 0.03
    assert abs(registration.dz_mm - 0.3) < 0.03
    assert judged.fields["decision"] is Decision.PASSED


def reported_over_true(wear_mm: float, pose: Pose, recipe: Recipe, seed: int) -> float:
    """Deviation over the worn cells, as reported over as rendered."""
    part = worn(wear_mm)
    comparison = bench().judge(Refixtured(part, pose), "dark", seed, recipe).comparison
    assert comparison is not None
    truth = true_deviation(bench(), part)
    at = np.isfinite(comparison.deviation_mm) & (np.abs(truth) > 0.05)
    area: F64 = comparison.area_px[at]
    return float(np.sum(comparison.deviation_mm[at] * area) / np.sum(truth[at] * area))


POSES = (Pose(), Pose(-0.3, 0.2, 0.2, -2.0, 2.0, -1.0))
# The opposite side of the part, with walls in both directions, and the flange all round.
DATUM = (
    box("left", (-78.0, -46.0), (-15.0, 46.0)),
    box("near", (-78.0, -46.0), (78.0, -39.0)),
    box("far", (-78.0, 40.0), (78.0, 46.0)),
    box("right", (60.0, -46.0), (78.0, 46.0)),
)


@pytest.mark.parametrize("wear_mm", [0.15, 0.3])
def test_wear_is_not_taken_for_a_move(wear_mm: float) -> None:
    free = [reported_over_true(wear_mm, pose, Recipe(), 43) for pose in POSES]
    held = [reported_over_true(wear_mm, pose, Recipe(datum_zones=DATUM), 43) for pose in POSES]
    assert min(free) >= 0.85, free
    assert min(held) >= 0.95, held


def test_the_same_points_give_the_same_bits() -> None:
    taught = bench()
    measured = taught.measure(Refixtured(worn(0.2), Pose(0.4, -0.3, 0.1, 2.0, 1.0, 3.0)), "dark", 44)
    first, second = (judge_points(measured, taught.setup(), JudgingSettings()) for _ in range(2))
    assert first.comparison is not None and second.comparison is not None
    assert first.fields == second.fields
    assert first.comparison.deviation_mm.tobytes() == second.comparison.deviation_mm.tobytes()


def test_a_part_too_far_off_is_not_measured() -> None:
    judged = bench().judge(Refixtured(PART, Pose(tilt_y_mrad=25.0)), "dark", 45)
    assert judged.fields["decision"] is Decision.NOT_MEASURED
    assert "tilted" in judged.fields["reason"]
