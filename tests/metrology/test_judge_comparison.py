"""What is reported of a deviation, against what was rendered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.metrology.parts import LIGHTS, Pose, Refixtured, bench, box, true_deviation, worn
from wearline.messages import Decision, LinePoints
from wearline.recipe import Limits, Recipe
from wearline.scene import Flake, StampedPart
from wearline_judge.core.comparison import Comparison
from wearline_judge.core.judgement import Judgement, JudgingSettings, judge_points

pytestmark = pytest.mark.timeout(600)  # the first test calibrates and teaches at full size

PART = StampedPart()


def compared(judged: Judgement) -> Comparison:
    assert judged.comparison is not None
    return judged.comparison


def without(measured: LinePoints, low_px: float, high_px: float) -> LinePoints:
    """The same points less those in a band of columns."""
    col = measured.points[:, 2]
    return measured.model_copy(update={"points": measured.points[(col < low_px) | (col > high_px)]})


@pytest.mark.parametrize("thickness_mm", [0.2, -0.3])
def test_a_flake_is_found_where_it_lies_with_its_size(thickness_mm: float) -> None:
    judged = bench().judge(Flake(PART, -20.0, 22.0, 14.0, thickness_mm), "dark", 61)
    assert judged.fields["decision"] is Decision.FAILED
    (region,) = judged.fields["regions"]
    assert abs(region.col_px - (811.5 - 200.0)) < 25.0 and abs(region.row_px - (611.5 + 220.0)) < 45.0
    assert region.area_mm2 is not None and region.volume_mm3 is not None
    # Whole lines are 4 mm apart: so is what an area can be told by.
    assert 0.65 * 196.0 < region.area_mm2 < 1.4 * 196.0
    assert np.sign(region.volume_mm3) == np.sign(thickness_mm) == np.sign(region.max_mm)
    assert 0.65 * 196.0 * abs(thickness_mm) < abs(region.volume_mm3) < 1.4 * 196.0 * abs(thickness_mm)
    assert 0.75 * abs(thickness_mm) < region.mean_mm < 1.05 * abs(thickness_mm)
    assert region.mean_mm <= region.p95_mm <= abs(region.max_mm) < abs(thickness_mm) + 0.06
    assert 0.002 < region.sigma_mm < 0.03
    assert judged.fields["mean_error_mm"] == pytest.approx(region.mean_mm)


def test_profile_deviation_is_twice_the_largest_and_names_its_datum() -> None:
    judged = bench().judge(worn(0.3), "dark", 62)
    assert judged.fields["profile_mm"] == pytest.approx(2.0 * abs(judged.fields["max_error_mm"]))
    assert 2.0 * 0.27 < judged.fields["profile_mm"] < 2.0 * 0.37
    assert judged.fields["registration"].datum == "best fit"
    flange = (box("far", (-78.0, 40.0), (78.0, 46.0)), box("near", (-78.0, -46.0), (78.0, -38.0)))
    held = bench().judge(worn(0.3), "dark", 62, Recipe(datum_zones=flange))
    assert held.fields["registration"].datum == "zones"


def test_zones_have_their_own_limits() -> None:
    limits = Limits(max_error_mm=0.15)
    worn_zone = box("corner", (10.0, 5.0), (60.0, 45.0), limits)
    other_zone = box("opposite", (-60.0, -45.0), (-10.0, -5.0), limits)
    judged = bench().judge(worn(0.3), "dark", 63, Recipe(zones=(worn_zone, other_zone)))
    corner, opposite = judged.fields["zones"]
    assert judged.fields["decision"] is Decision.FAILED and "zone corner" in judged.fields["reason"]
    assert not corner.is_within and opposite.is_within
    assert corner.max_error_mm == pytest.approx(-0.3, abs=0.04)
    assert "opposite" not in judged.fields["reason"]
    # A zone may also be held to a precision of its own.
    coarse = worn_zone.model_copy(update={"precision_mm": 0.5, "limits": Limits()})
    judged = bench().judge(Flake(PART, 30.0, 20.0, 10.0, 0.2), "dark", 63, Recipe(zones=(coarse,)))
    assert judged.fields["decision"] is Decision.PASSED


def test_what_was_not_seen_is_neither_compared_nor_passed() -> None:
    taught = bench()
    measured = taught.measure(Flake(PART, 20.0, 10.0, 10.0, 0.4), "dark", 64)
    hidden = without(measured, 940.0, 1084.0)
    judged = judge_points(hidden, taught.setup(), JudgingSettings())
    comparison = compared(judged)
    x = taught.setup().cells.x_px
    assert np.isnan(comparison.deviation_mm[(x > 950.0) & (x < 1075.0)]).all()
    assert comparison.coverage < 0.93
    assert judged.fields["decision"] is Decision.PASSED, "nothing that was seen deviates"
    zone = box("flake", (14.0, 4.0), (26.0, 16.0), Limits(max_error_mm=0.3))
    judged = judge_points(hidden, taught.setup(Recipe(zones=(zone,))), JudgingSettings())
    assert judged.fields["decision"] is Decision.NOT_MEASURED and "zone flake" in judged.fields["reason"]
    assert judged.fields["zones"][0].max_error_mm is None


def test_points_at_the_same_place_count_once() -> None:
    taught = bench()
    measured = taught.measure(PART, "dark", 65)
    doubled = measured.model_copy(update={"points": np.concatenate([measured.points, measured.points[::2]])})
    once, twice = (compared(judge_points(m, taught.setup(), JudgingSettings())) for m in (measured, doubled))
    assert twice.coverage == once.coverage <= 1.0
    np.testing.assert_array_equal(once.deviation_mm, twice.deviation_mm)


def test_uncertainty_is_true_in_every_zone_and_light() -> None:
    """Scores of the error of cells in a quarter of the part each, over lights and poses."""
    poses = (Pose(), Pose(0.3, -0.2, 0.1, 1.0, 1.0, 0.5))
    scores: dict[tuple[bool, bool], list[np.ndarray]] = {}
    cells = bench().setup().cells
    for k, light in enumerate(LIGHTS):
        for n, pose in enumerate(poses):
            comparison = compared(bench().judge(Refixtured(PART, pose), light, 6600 + 10 * k + n))
            score = comparison.deviation_mm / comparison.sigma_mm
            for right in (False, True):
                for far in (False, True):
                    at = ((cells.x_px > 811.5) == right) & ((cells.y_px > 611.5) == far) & np.isfinite(score)
                    scores.setdefault((right, far), []).append(score[at])
    for zone, found in scores.items():
        pooled = np.concatenate(found)
        assert 0.8 < float(np.std(pooled)) < 1.2, zone
        assert 0.91 < float(np.mean(np.abs(pooled) < 1.96)) < 0.985, zone


def test_worn_area_and_mean_are_those_of_the_truth() -> None:
    part = replace(PART, wear_mm=0.3)
    judged = bench().judge(part, "dark", 67)
    truth = true_deviation(bench(), part)
    comparison = compared(judged)
    at = np.isfinite(comparison.deviation_mm) & (np.abs(truth) > 0.05)
    area = comparison.area_px[at]
    mean = float(np.sum(np.abs(truth[at]) * area) / np.sum(area))
    assert judged.fields["mean_error_mm"] == pytest.approx(mean, abs=0.02)
    assert judged.fields["deviating_area_mm2"] == pytest.approx(0.01 * float(np.sum(area)), rel=0.15)
    assert judged.fields["wear_mm"] == pytest.approx(float(np.percentile(np.abs(truth[at]), 95)), abs=0.02)


def test_light_on_half_of_the_picture_is_no_defect() -> None:
    comparison = compared(bench().judge(Refixtured(PART, Pose(0.1, 0.1, 0.05)), "half", 68))
    deviation = comparison.deviation_mm
    middle = deviation.shape[1] // 2
    assert comparison.regions == ()
    assert float(np.nanmax(np.abs(deviation))) < 0.5
    # Each half is as good as in even light of its kind.
    assert float(np.nanstd(deviation[:, : middle - 3])) < 0.026
    assert float(np.nanstd(deviation[:, middle + 3 :])) < 0.05
