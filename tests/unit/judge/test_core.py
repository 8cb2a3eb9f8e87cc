"""Comparison, registration and decision on parts with known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.metrology.renderer import Comb
from tests.unit.judge.parts import (
    CALIBRATION,
    CALIBRATION_HASH,
    FLAW,
    MM_PER_PIXEL,
    Part,
    calibration,
    golden_template,
    line_points,
)
from wearline.artifact import Template
from wearline.errors import TemplateError
from wearline.messages import Decision, LinePoints, ResultCode
from wearline.recipe import Limits, Recipe, Zone
from wearline_judge.core.golden import make_golden
from wearline_judge.core.judgement import Judgement, JudgingSettings, Setup, judge_points, make_setup
from wearline_judge.core.line_grid import line_grid
from wearline_judge.core.teaching import Sample, teach
from wearline_judge.core.view import make_view

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

SETTINGS = JudgingSettings()
TEMPLATE = golden_template()
FLAW_MM2 = np.pi * FLAW[2] * FLAW[3] * MM_PER_PIXEL**2


def setup(recipe: Recipe | None = None, template: Template = TEMPLATE) -> Setup:
    ruling = recipe or Recipe()
    return make_setup(make_golden(template, ruling.mm_per_pixel), ruling)


def judged(part: Part, recipe: Recipe | None = None, stroke: int = 1) -> Judgement:
    return judge_points(line_points(part, stroke, recipe=recipe), setup(recipe), SETTINGS)


def test_a_good_part_passes_wherever_it_lies() -> None:
    for stroke, part in enumerate((Part(), Part(dz_mm=0.3), Part(dz_mm=-0.2, tilt_x_mrad=3.0), Part(dx_px=2.0))):
        found = judged(part, stroke=stroke + 1).fields
        assert found["decision"] is Decision.PASSED, found
        assert found["code"] == ResultCode.PASSED
        assert found["mean_error_mm"] == 0.0 and found["wear_mm"] == 0.0 and found["regions"] == ()
        assert found["coverage"] > 0.97


@pytest.mark.parametrize("flaw_mm", [0.2, -0.3])
def test_a_flaw_fails_with_its_height_and_place(flaw_mm: float) -> None:
    found = judged(Part(flaw_mm=flaw_mm)).fields
    assert found["decision"] is Decision.FAILED and found["code"] == ResultCode.FAILED
    (region,) = found["regions"]
    # Half an ellipsoid: its mean over the base is 2/3 of its top; the rim below 0.05 mm is not seen.
    assert found["mean_error_mm"] == pytest.approx(abs(flaw_mm) * 2.0 / 3.0, rel=0.12)
    assert found["max_error_mm"] == pytest.approx(flaw_mm, abs=0.03)
    assert found["deviating_area_mm2"] == pytest.approx(FLAW_MM2, rel=0.15)
    assert (region.col_px, region.row_px) == (pytest.approx(FLAW[0], abs=4), pytest.approx(FLAW[1], abs=8))
    assert 0.6 * abs(flaw_mm) < found["wear_mm"] <= 1.02 * abs(flaw_mm)
    assert region.volume_mm3 == pytest.approx(flaw_mm * 2 / 3 * FLAW_MM2, rel=0.15)


def test_the_motion_is_found_and_does_not_hide_the_flaw() -> None:
    found = judged(Part(flaw_mm=0.25, dz_mm=0.4, tilt_x_mrad=-4.0)).fields
    assert found["registration"].dz_mm == pytest.approx(0.4, abs=0.02)
    assert found["registration"].tilt_x_mrad == pytest.approx(-4.0, abs=0.5)
    assert found["mean_error_mm"] == pytest.approx(0.25 * 2 / 3, rel=0.15)


def test_a_part_beyond_the_allowed_pose_is_not_measured() -> None:
    found = judged(Part(dz_mm=2.5)).fields
    assert found["decision"] is Decision.NOT_MEASURED and found["code"] == ResultCode.REGISTRATION
    assert "2.5" in found["reason"] and found.get("mean_error_mm") is None


def test_a_part_that_is_half_hidden_is_not_measured() -> None:
    found = judged(Part(hidden=(0.0, 320.0))).fields
    assert found["decision"] is Decision.NOT_MEASURED and found["code"] == ResultCode.COVERAGE
    assert found["coverage"] == pytest.approx(0.5, abs=0.02)
    assert judged(Part(hidden=(0.0, 320.0)), Recipe(coverage_min=0.3)).fields["decision"] is Decision.PASSED


def test_nothing_seen_and_a_refusal_are_not_measured() -> None:
    points = line_points(Part())
    nothing = points.replace(points=np.zeros((0, 5), np.float32))
    assert judge_points(nothing, setup(), SETTINGS).fields["code"] == ResultCode.COVERAGE
    refused = points.replace(refusal_code=16, refusal="camera does not answer")
    assert judge_points(refused, setup(), SETTINGS).fields == {
        "decision": Decision.NOT_MEASURED, "code": 16, "reason": "camera does not answer",
    }  # fmt: skip


def test_the_area_floor_keeps_a_speck_from_failing_a_part() -> None:
    flawed = Part(flaw_mm=0.3)
    assert judged(flawed, Recipe(area_floor_mm2=2.0 * FLAW_MM2)).fields["decision"] is Decision.PASSED
    assert judged(flawed, Recipe(area_floor_mm2=0.5 * FLAW_MM2)).fields["decision"] is Decision.FAILED


def test_limits_rule_instead_of_the_precision() -> None:
    thesis = Recipe(limits=Limits(mean_error_mm=0.3))
    mild = judged(Part(flaw_mm=0.3), thesis).fields
    assert mild["decision"] is Decision.PASSED and mild["mean_error_mm"] > 0.15
    assert judged(Part(flaw_mm=0.6), thesis).fields["decision"] is Decision.FAILED
    assert judged(Part(flaw_mm=0.3), Recipe(limits=Limits(max_error_mm=0.2))).fields["decision"] is Decision.FAILED
    assert judged(Part(flaw_mm=0.3), Recipe(limits=Limits(area_mm2=50.0))).fields["decision"] is Decision.FAILED


def test_the_guard_band_makes_a_part_unsure_and_the_recipe_says_what_the_plc_hears() -> None:
    mean = judged(Part(flaw_mm=0.3)).fields["mean_error_mm"]
    near = Recipe(limits=Limits(mean_error_mm=mean - 0.001), guard_band=2.0)
    found = judged(Part(flaw_mm=0.3), near).fields
    assert found["decision"] is Decision.UNSURE and found["code"] == ResultCode.UNSURE
    lenient = near.model_copy(update={"unsure_as": "PASSED"})
    assert judged(Part(flaw_mm=0.3), lenient).fields["code"] == ResultCode.PASSED
    sharp = near.model_copy(update={"guard_band": 0.0})
    assert judged(Part(flaw_mm=0.3), sharp).fields["decision"] is Decision.FAILED


def test_zones_have_figures_and_limits_of_their_own() -> None:
    x, y, rx, ry = FLAW
    box = ((x - rx, y - ry), (x + rx, y - ry), (x + rx, y + ry), (x - rx, y + ry))
    away = tuple((px + 200.0, py) for px, py in box)
    recipe = Recipe(
        limits=Limits(mean_error_mm=1.0),
        zones=(Zone(name="radius", polygon_px=box, limits=Limits(max_error_mm=0.1)), Zone(name="rim", polygon_px=away)),
    )
    found = judged(Part(flaw_mm=0.25), recipe).fields
    assert found["decision"] is Decision.FAILED and "zone radius" in found["reason"]
    radius, rim = found["zones"]
    assert (radius.name, radius.is_within, rim.name, rim.is_within) == ("radius", False, "rim", True)
    assert radius.wear_mm == pytest.approx(found["wear_mm"], abs=0.02) and rim.wear_mm == 0.0
    hidden = judged(Part(flaw_mm=0.25, hidden=(x - rx, x + rx)), recipe).fields
    assert hidden["decision"] is Decision.NOT_MEASURED and "zone radius" in hidden["reason"]


def test_the_roi_bounds_what_is_judged() -> None:
    recipe = Recipe(roi=(430, 0, 200, 480))
    template = golden_template(recipe)
    found = judge_points(line_points(Part(flaw_mm=0.5), recipe=recipe), setup(recipe, template), SETTINGS).fields
    assert found["decision"] is Decision.PASSED
    assert template.z_map_mm.shape == (480, 200)
    seen = judge_points(line_points(Part(), recipe=recipe), setup(recipe, template), SETTINGS)
    assert seen.comparison is not None
    maps, _ = make_view(make_golden(template, None), seen.comparison)
    assert maps.shape[0] == 4 and np.isfinite(maps[2]).mean() > 0.5


def test_without_a_lateral_scale_areas_are_pixels() -> None:
    bare = replace(TEMPLATE, meta={**TEMPLATE.meta, "mm_per_pixel": None})
    points = line_points(Part(flaw_mm=0.3))
    found = judge_points(points, setup(template=bare), SETTINGS).fields
    assert found["decision"] is Decision.FAILED
    assert found["deviating_area_mm2"] is None
    assert found["deviating_area_px"] == pytest.approx(FLAW_MM2 / MM_PER_PIXEL**2, rel=0.15)
    limited = setup(Recipe(limits=Limits(area_mm2=1.0)), bare)
    assert "no lateral scale" in judge_points(points, limited, SETTINGS).fields["reason"]


def test_vertical_lines_give_the_same_verdict() -> None:
    comb = Comb(across=640, along=480, is_vertical=True, lines=15)
    held = calibration(comb)
    recipe = Recipe(orientation="vertical")
    samples = [Sample(f"g{n}", line_points(Part(), 50 + n, comb=comb, recipe=recipe)) for n in range(3)]
    template = teach(samples, held, CALIBRATION_HASH, recipe, "r", SETTINGS)
    found = judge_points(line_points(Part(flaw_mm=0.25), comb=comb), setup(recipe, template), SETTINGS).fields
    assert found["decision"] is Decision.FAILED
    assert found["mean_error_mm"] == pytest.approx(0.25 * 2 / 3, rel=0.12)
    (region,) = found["regions"]
    assert (region.col_px, region.row_px) == (pytest.approx(FLAW[0], abs=8), pytest.approx(FLAW[1], abs=4))


def test_points_that_are_not_finite_or_off_the_grid_are_left_out() -> None:
    points = np.array(
        [[0, 10, 5, 1, 0.1], [0, 10, 6, np.nan, 0.1], [99, 1, 1, 1, 0.1], [0, 10, -3, 1, 0.1]], np.float32
    )
    grid = line_grid(points, 3, 20, is_vertical=False)
    assert int(grid.is_seen.sum()) == 1 and grid.z_mm[0, 5] == 1.0


def test_the_maps_for_the_eye_show_the_flaw() -> None:
    found = judged(Part(flaw_mm=0.3))
    assert found.comparison is not None
    maps, step = make_view(setup().golden, found.comparison, longest=160)
    assert maps.shape == (4, 120, 160) and step == 4.0
    standard, measured, difference, error = maps
    place = (int(FLAW[1] / step), int(FLAW[0] / step))
    assert difference[place] == pytest.approx(0.3, abs=0.05) and error[place] == difference[place]
    assert np.nanmax(np.abs(measured - standard - difference)) < 1e-5
    far = (int(400 / step), int(500 / step))
    assert error[far] == 0.0


def test_a_template_holds_mean_spread_and_coverage() -> None:
    assert TEMPLATE.frames == 4 and TEMPLATE.calibration_hash == CALIBRATION_HASH
    expected = TEMPLATE.line_coverage == 1.0
    assert expected.mean() > 0.95
    assert float(np.median(TEMPLATE.line_spread_mm[expected])) == pytest.approx(0.01, rel=0.25)
    # Four frames halve the noise.
    assert float(np.median(TEMPLATE.line_sigma_mm[expected])) == pytest.approx(0.005, rel=0.1)
    again = golden_template()
    assert again.to_bytes() == TEMPLATE.to_bytes()


def sample(part: Part, stroke: int) -> Sample:
    return Sample(f"F{stroke}.png", line_points(part, stroke))


def taught(*samples: Sample, recipe: Recipe | None = None) -> Template:
    return teach(samples, CALIBRATION, CALIBRATION_HASH, recipe or Recipe(), "r", SETTINGS)


@pytest.mark.parametrize("bad", [0, 2])
def test_a_suspicious_golden_frame_is_refused_by_name(bad: int) -> None:
    samples = [sample(Part(flaw_mm=0.25 if n == bad else 0.0), n + 1) for n in range(4)]
    with pytest.raises(TemplateError, match=rf"F{bad + 1}\.png: is suspicious: it deviates .* about x 3\d\d, y 2\d\d"):
        taught(*samples)


def test_two_golden_frames_that_differ_are_both_in_doubt() -> None:
    with pytest.raises(TemplateError, match=r"two golden frames differ by 0\.2"):
        taught(sample(Part(), 1), sample(Part(flaw_mm=0.3), 2))


def test_golden_frames_that_show_too_little_or_nothing_are_refused() -> None:
    with pytest.raises(TemplateError, match=r"F3\.png: shows \d\d % of what the others show"):
        taught(sample(Part(), 1), sample(Part(), 2), sample(Part(hidden=(0, 400)), 3))
    dark: LinePoints = line_points(Part(), 4).replace(refusal_code=21, refusal="is black")
    with pytest.raises(TemplateError, match=r"F4\.png: is black"):
        taught(sample(Part(), 1), Sample("F4.png", dark))
    with pytest.raises(TemplateError, match="no golden frame"):
        taught()
    with pytest.raises(TemplateError, match="orientation"):
        taught(sample(Part(), 1), recipe=Recipe(orientation="vertical"))
    with pytest.raises(TemplateError, match="outside"):
        taught(sample(Part(), 1), recipe=Recipe(roi=(5000, 0, 10, 10)))


def test_a_template_whose_arrays_do_not_fit_is_refused() -> None:
    with pytest.raises(TemplateError, match="do not fit"):
        make_golden(replace(TEMPLATE, line_z_mm=TEMPLATE.line_z_mm[:-1]), None)
    with pytest.raises(TemplateError, match="no point"):
        make_golden(replace(TEMPLATE, line_coverage=TEMPLATE.line_coverage * 0), None)
