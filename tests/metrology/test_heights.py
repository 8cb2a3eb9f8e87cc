"""Heights against known truth, on two renderers that share nothing, and on heads of every kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.metrology.chains import Comparison, comb_calibration, compare, head_calibration, prepared
from tests.metrology.renderer import Comb, draw, plate
from wearline.errors import FrameError
from wearline.recipe import LineConstraint, Recipe
from wearline.scene import Flake, Head, Hole, Light, Plane, StampedPart, Step, Surface, render
from wearline_reconstruct.core.chain import reconstruct
from wearline_reconstruct.core.stripes import F64

PLATES = (0.0, 0.0, 2.0, 2.0, 4.0, 4.0, 6.0, 6.0)
SMALL = Head(rows=720, cols=800, lines=13, pitch_mm=4.4)
HEADS = {
    "as built": SMALL,
    "laser on the other side": replace(SMALL, laser_angle_deg=-30.0),
    "vertical": replace(SMALL, rows=800, cols=720, vertical=True),
    "wide lens, fine lines": replace(SMALL, k1=-0.35, k2=0.9, stripe_sigma_px=1.3, laser_roll_mrad=25.0),
    "broad lines": replace(SMALL, stripe_sigma_px=3.5, speckle_contrast=0.45, laser_angle_deg=22.0),
}
COMBS = {
    "second renderer": Comb(),
    "lines move up": Comb(a_mm_per_px=-0.15, b_per_px=-2.0e-4),
    "vertical": Comb(is_vertical=True),
    "narrow pitch": Comb(pitch_px=21.0, width_px=1.2, lines=19, a_mm_per_px=0.4, slant=-0.05),
    "broad": Comb(pitch_px=56.0, width_px=3.8, lines=7, bow_px=-15.0),
    "bright and noisy": Comb(ambient_dn=90.0, noise_dn=5.0, speckle=0.4),
    "no speckle": Comb(speckle=0.0, noise_dn=0.7),
}


def on_head(head: Head, surface: Surface, seed: int, light: Light | None = None) -> Comparison:
    pixels, truth = render(head, surface, light, seed)
    found = reconstruct(pixels, prepared(head_calibration(head, PLATES)))
    return compare(found, truth.row_px, truth.z_mm, head.vertical)


def on_comb(comb: Comb, surface: object, seed: int) -> Comparison:
    pixels, across, z = draw(comb, surface, seed)  # type: ignore[arg-type]
    found = reconstruct(pixels, prepared(comb_calibration(comb, PLATES)))
    return compare(found, across, z, comb.is_vertical)


@pytest.mark.parametrize("name", HEADS)
def test_planes_on_every_head(name: str) -> None:
    result = on_head(HEADS[name], Plane(3.0, 8.0, -6.0), seed=9101)
    per_px = abs(head_calibration(HEADS[name], PLATES).meta["mm_per_line_px"])
    # Vibration (0.05 px) moves the whole frame; streaks of the sheet stay in single points.
    assert abs(result.bias_mm) < 0.2 * per_px
    assert result.spread_mm < 0.28 * per_px
    assert result.wrong == 0
    assert result.seen > 0.98


@pytest.mark.parametrize("name", COMBS)
def test_planes_on_the_second_renderer(name: str) -> None:
    comb = COMBS[name]
    result = on_comb(comb, plate(2.7), seed=9201)
    per_px = abs(comb.a_mm_per_px)
    assert abs(result.bias_mm) < 0.03 * per_px / 0.15
    assert result.spread_mm < 0.25 * per_px
    assert result.wrong == 0
    assert result.seen > 0.98


@pytest.mark.parametrize("seed", [9301, 9302])
def test_curved_part(seed: int) -> None:
    head = replace(SMALL, rows=1000, cols=1200, lines=17)
    result = on_head(head, StampedPart(), seed)
    assert abs(result.bias_mm) < 0.035
    assert result.spread_mm < 0.06
    assert result.wrong == 0
    assert result.seen > 0.97


def test_uncertainty_is_true() -> None:
    scores = []
    for seed in range(9401, 9407):
        result = on_head(SMALL, Plane(0.4 * (seed - 9400) + 1.0), seed)
        scores.append(result.error_mm / result.sigma_mm)
    pooled = np.concatenate(scores)
    assert 0.6 < float(np.std(pooled)) < 1.3


def test_bright_light() -> None:
    result = on_head(SMALL, Plane(3.0), 9501, Light(ambient_dn=80.0))
    assert result.wrong == 0
    assert result.seen > 0.95
    assert result.spread_mm < 0.12


@pytest.mark.parametrize(
    ("name", "surface", "least"),
    [
        ("step along the lines", Step(1.0, 4.0, 5.0, "x"), 0.97),
        ("step near a pitch", Step(1.0, 6.5, -12.0, "x"), 0.95),
        ("step across the lines", Step(1.0, 5.0, 2.0, "y"), 0.97),
        ("step down", Step(5.0, 1.0, 2.0, "y"), 0.95),
        # The wall swallows a line, or the step is the smaller one the other way: no number is right.
        ("step that could be another", Step(2.13, 6.43, -10.5, "y"), 0.6),
        ("hole", Hole(Plane(2.0), 14.0, 8.0, 9.0), 0.97),
        ("blind hole", Hole(Plane(4.0), -14.0, 8.0, 9.0, depth_mm=2.5), 0.93),
        ("island", Flake(Plane(1.0), 14.0, 9.0, 18.0, 3.0), 0.88),
        ("tilt", Plane(3.0, 40.0, -30.0), 0.98),
    ],
)
def test_no_wrong_number(name: str, surface: Surface, least: float) -> None:
    for seed in (9601, 9602):
        result = on_head(SMALL, surface, seed)
        total = len(result.error_mm) + result.wrong
        assert result.wrong <= 0.001 * total, name
        assert result.seen > least, name


def test_dead_lines_do_not_shift_the_others() -> None:
    whole = Comb()
    calibration = comb_calibration(whole, PLATES)
    comb = replace(whole, dead=(2, 7))
    pixels, across, z = draw(comb, plate(2.0), 9701)
    found = reconstruct(pixels, prepared(calibration))
    result = compare(found, across, z, False)
    assert result.wrong == 0
    assert result.seen > 0.95
    assert not np.isin(found.points[:, 0], (2, 7)).any()


def test_a_swapped_number_would_be_seen() -> None:
    """The comparison that all these tests rely on tells two neighbouring numbers apart."""
    comb = Comb()
    pixels, across, z = draw(comb, plate(2.0), 9801)
    found = reconstruct(pixels, prepared(comb_calibration(comb, PLATES)))
    assert compare(found, across, z, False).wrong == 0
    points = found.points.copy()
    third, fourth = points[:, 0] == 3, points[:, 0] == 4
    points[third, 0], points[fourth, 0] = 4, 3
    swapped = compare(replace(found, points=points), across, z, False)
    assert swapped.wrong == int(third.sum() + fourth.sum())


def test_nothing_is_invented_in_a_hole() -> None:
    comb = Comb()

    def pierced(across: F64, along: F64) -> F64:
        away = np.hypot(across - 300.0, along - 400.0)
        return np.where(away < 60.0, np.nan, 2.0)

    pixels, across, _ = draw(comb, pierced, 9901)
    found = reconstruct(pixels, prepared(comb_calibration(comb, PLATES)))
    line = found.points[:, 0].astype(int)
    place = found.points[:, 2].astype(int)
    # Averaging along the line shows its end some pixels too far at most.
    beyond = np.isnan(across[line, place])
    visible = np.isfinite(across)
    near = np.array([visible[k, max(p - 3, 0) : p + 4].any() for k, p in zip(line, place, strict=True)])
    assert not (beyond & ~near).any()


def test_without_a_spot_nothing_is_guessed_where_lines_could_be_one_off() -> None:
    whole = Comb()
    comb = replace(whole, spot_px=0.0, dead=(0, 10))
    pixels, across, z = draw(comb, plate(2.0), 9951)
    calibration = comb_calibration(whole, PLATES)
    try:
        found = reconstruct(pixels, prepared(calibration))
    except FrameError as refused:
        assert "spot" in str(refused) or "numbered" in str(refused)
        return
    assert compare(found, across, z, False).wrong == 0


def test_a_correction_by_hand_settles_the_numbers() -> None:
    whole = Comb()
    comb = replace(whole, spot_px=0.0, dead=(0,))
    pixels, across, z = draw(comb, plate(2.0), 9961)
    constraint = LineConstraint(row_px=float(across[5, 100]), col_px=100.0, line=5)
    chain = prepared(comb_calibration(whole, PLATES), Recipe(line_constraints=(constraint,)))
    result = compare(reconstruct(pixels, chain), across, z, False)
    assert result.wrong == 0
    assert result.seen > 0.95


def test_same_frame_same_numbers() -> None:
    pixels, *_ = draw(Comb(), plate(2.0), 9971)
    chain = prepared(comb_calibration(Comb(), PLATES))
    first, second = reconstruct(pixels, chain), reconstruct(pixels, chain)
    assert np.array_equal(first.points, second.points)
