"""The simulated head against an independent ray trace, and what its pictures promise."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from wearline.scene import (
    DEFAULT_HEAD,
    Flake,
    Head,
    Hole,
    Light,
    Plane,
    StampedPart,
    Step,
    Surface,
    mm_per_pixel,
    part_of_stroke,
    project,
    render,
    trace,
    true_errors,
    wear_at,
)

SMALL = replace(DEFAULT_HEAD, rows=420, cols=520, lines=9)
DARK = Light(vibration_px=0.0)
PARTS: list[Surface] = [
    Plane(3.0, tilt_x_mrad=20.0, tilt_y_mrad=-15.0),
    StampedPart(wear_mm=0.3, dx_mm=0.4, dy_mm=-0.3, tilt_y_mrad=1.0),
]


def _ray(head: Head, row: float, col: float) -> NDArray[np.float64]:
    """Direction of sight of a raw pixel; the lens is undone by bisection over the radius."""
    across, along = (row - 0.5 * (head.rows - 1)) / head.focal_px, (col - 0.5 * (head.cols - 1)) / head.focal_px
    bent = math.hypot(across, along)
    low, high = 0.0, 2.0 * bent
    for _ in range(70):
        radius = 0.5 * (low + high)
        if radius + head.k1 * radius**3 + head.k2 * radius**5 > bent:
            high = radius
        else:
            low = radius
    share = 0.5 * (low + high) / bent
    return np.array([along * share, across * share, -1.0])


def _on_sheet(head: Head, line: int, ray: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where a line of sight meets a laser sheet, from three vectors that span it."""
    tilt = math.radians(head.laser_angle_deg)
    step = head.pitch_mm * math.cos(tilt) / head.laser_distance_mm
    source = head.laser_distance_mm * np.array([0.0, -math.sin(tilt), math.cos(tilt)])
    turned = tilt + step * (line - head.lines // 2)
    down = np.array([0.0, math.sin(turned), -math.cos(turned)])
    roll = head.laser_roll_mrad * 1e-3
    along = np.array([math.cos(roll), math.sin(roll), 0.0])
    eye = np.array([0.0, 0.0, head.distance_mm])
    share = np.linalg.solve(np.column_stack([ray, -down, -along]), source - eye)[0]
    met: NDArray[np.float64] = eye + share * ray
    return met


def _brute_row(head: Head, surface: Surface, line: int, col: int) -> float:
    """Bisection over sensor rows: above the stripe the sheet is met over the surface, below it under."""

    def gap(row: float) -> float:
        x, y, z = _on_sheet(head, line, _ray(head, row, col))
        return float(z - surface.height_mm(np.array([x]), np.array([y]))[0])

    low, high = -400.0, head.rows + 400.0
    is_rising = gap(high) > 0
    for _ in range(60):
        middle = 0.5 * (low + high)
        if (gap(middle) > 0) == is_rising:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)


@pytest.mark.parametrize("surface", PARTS, ids=["plane", "part"])
@pytest.mark.parametrize("angle_deg", [30.0, -28.0])
def test_truth_is_exact_to_a_thousandth_of_a_pixel(surface: Surface, angle_deg: float) -> None:
    head = replace(DEFAULT_HEAD, laser_angle_deg=angle_deg)
    truth = trace(head, surface)
    assert np.isfinite(truth.row_px).mean() > 0.99
    for line, col in [(0, 3), (5, 240), (9, 1250), (12, 812), (17, 1301), (20, 700), (24, 1620)]:
        assert truth.row_px[line, col] == pytest.approx(_brute_row(head, surface, line, col), abs=1e-4)


def test_truth_points_lie_on_the_surface_and_project_onto_themselves() -> None:
    part = StampedPart(wear_mm=0.2)
    truth = trace(DEFAULT_HEAD, part)
    np.testing.assert_allclose(truth.z_mm, part.height_mm(truth.x_mm, truth.y_mm), atol=1e-5)
    row, col = project(DEFAULT_HEAD, truth.x_mm, truth.y_mm, truth.z_mm)
    np.testing.assert_allclose(row, truth.row_px, atol=1e-3)
    np.testing.assert_allclose(col, np.broadcast_to(truth.col, col.shape), atol=1e-3)


def test_lines_are_about_a_pitch_apart_and_a_part_moves_them_by_less_than_two() -> None:
    low, high = trace(DEFAULT_HEAD, Plane(0.0)), trace(DEFAULT_HEAD, Plane(8.0))
    pitch = np.diff(low.row_px, axis=0)
    assert pitch.min() > 33.0 and pitch.max() < 50.0
    moved = low.row_px - high.row_px
    assert 1.0 < np.median(moved) / np.median(pitch) < 2.0
    assert low.spot_row_px - high.spot_row_px == pytest.approx(moved[12, 812], abs=0.1)
    other_side = replace(DEFAULT_HEAD, laser_angle_deg=-30.0)
    assert trace(other_side, Plane(8.0)).row_px[12, 812] > trace(other_side, Plane(0.0)).row_px[12, 812]
    assert mm_per_pixel(DEFAULT_HEAD) == pytest.approx(0.1)


def test_stripes_stand_where_the_truth_says() -> None:
    head = replace(SMALL, speckle_contrast=0.0)
    image, truth = render(head, Plane(2.0), replace(DARK, texture=0.0), seed=3)
    found = []
    for col in range(20, 500, 7):
        row = truth.row_px[2, col]
        rows = np.arange(round(row) - 8, round(row) + 9)
        light = image[rows, col].astype(float) - DARK.ambient_dn
        found.append(float((rows * light).sum() / light.sum() - row))
    assert abs(float(np.mean(found))) < 0.03
    assert float(np.std(found)) < 0.25


def test_vibration_moves_picture_and_truth_together() -> None:
    head = replace(SMALL, speckle_contrast=0.0)
    still = trace(head, Plane(2.0))
    image, truth = render(head, Plane(2.0), Light(vibration_px=1.5, texture=0.0), seed=5)
    shift = truth.row_px - still.row_px
    assert abs(shift[0, 0]) > 0.1
    np.testing.assert_allclose(shift, shift[0, 0], atol=1e-9)
    rows = np.arange(round(truth.row_px[3, 100]) - 8, round(truth.row_px[3, 100]) + 9)
    light = image[rows, 60:160].astype(float).sum(axis=1) - 100 * 12.0
    assert float((rows * light).sum() / light.sum()) == pytest.approx(float(truth.row_px[3, 60:160].mean()), abs=0.1)


def test_same_seed_same_pixels_other_seed_other_pixels() -> None:
    first, _ = render(SMALL, Plane(), Light(), seed=7)
    again, _ = render(SMALL, Plane(), Light(), seed=7)
    other, _ = render(SMALL, Plane(), Light(), seed=8)
    assert first.dtype == np.uint8 and first.shape == (420, 520)
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


def test_speckle_is_no_kinder_than_a_lasers_and_correlated_both_ways() -> None:
    head = replace(SMALL, laser_roll_mrad=0.0, read_noise_dn=0.1, gain_dn_per_e=1e-6)
    light = Light(ambient_dn=0.0, laser_dn=60.0, texture=0.0, vibration_px=0.0)
    image, truth = render(head, Plane(), light, seed=2)
    crests = []
    for line in (0, 1, 2, 3, 5, 6, 7, 8):
        row = round(float(truth.row_px[line, 260]))
        band = image[row - 1 : row + 2, 20:-20].astype(float)
        crests.append(band / band.mean(axis=1, keepdims=True) - 1.0)
    crest = np.stack(crests)
    assert 0.33 < float(crest.std()) < 0.38
    along = float((crest[:, :, 1:] * crest[:, :, :-1]).mean() / crest.var())
    across = float((crest[:, 1:] * crest[:, :-1]).mean() / crest.var())
    far = float((crest[:, :, 8:] * crest[:, :, :-8]).mean() / crest.var())
    assert 0.5 < along < 0.8 and 0.5 < across < 0.8 and abs(far) < 0.1


def test_the_middle_line_bears_a_brighter_and_wider_spot() -> None:
    image, truth = render(SMALL, Plane(), Light(), seed=1)
    row, col = round(truth.spot_row_px), round(truth.spot_col_px)
    assert image[row - 3 : row + 4, col - 3 : col + 4].mean() > 150.0
    assert image[row + 7 : row + 10, col - 3 : col + 4].mean() > 60.0
    assert image[row + 9 : row + 12, col + 60 : col + 80].mean() < 30.0
    line = truth.row_px[SMALL.middle_line]
    assert truth.spot_row_px == pytest.approx(float(np.interp(truth.spot_col_px, truth.col, line)), abs=1e-3)


def test_longer_exposure_gives_more_light() -> None:
    short, _ = render(SMALL, Plane(), Light(exposure_us=4000.0), seed=1)
    long, _ = render(SMALL, Plane(), Light(exposure_us=8000.0), seed=1)
    assert long.mean() == pytest.approx(2.0 * short.mean(), rel=0.05)


def test_a_vertical_head_shows_the_transposed_picture() -> None:
    lying = replace(SMALL, rows=520, cols=420)
    standing = replace(SMALL, vertical=True)
    surface = Flake(Plane(1.0), x_mm=6.0, y_mm=2.0, size_mm=8.0, thickness_mm=0.5)
    turned = Flake(Plane(1.0), x_mm=2.0, y_mm=6.0, size_mm=8.0, thickness_mm=0.5)
    image, truth = render(standing, surface, Light(), seed=4)
    upright, expected = render(lying, turned, Light(), seed=4)
    assert image.shape == (standing.rows, standing.cols)
    np.testing.assert_array_equal(image, upright.T)
    np.testing.assert_array_equal(truth.row_px, expected.row_px)
    np.testing.assert_array_equal(truth.x_mm, expected.y_mm)


def test_a_high_edge_throws_a_shadow_without_light() -> None:
    # The laser comes from y < 0: behind a plate that falls there, 10 mm throw a shadow of 5.8 mm.
    surface = Step(low_mm=10.0, high_mm=0.0, edge_mm=0.0, across="y")
    truth = trace(replace(SMALL, pitch_mm=2.0), surface)
    y = truth.y_mm[np.isfinite(truth.y_mm) & (truth.z_mm < 5.0)]
    assert y.size and y.min() > 5.0
    is_high = truth.z_mm[np.isfinite(truth.z_mm)] > 5.0
    assert is_high.any()


def test_steps_along_the_lines_and_holes_are_not_bridged() -> None:
    truth = trace(SMALL, Step(low_mm=0.0, high_mm=3.0, edge_mm=0.0, across="x"))
    seen = truth.z_mm[np.isfinite(truth.z_mm)]
    assert set(np.unique(seen.round(6))) == {0.0, 3.0}
    holed = trace(SMALL, Hole(Plane(), x_mm=0.0, y_mm=0.0, radius_mm=5.0))
    distance = np.hypot(holed.x_mm, holed.y_mm)
    assert np.nanmin(distance) >= 5.0 and np.isnan(holed.row_px).sum() > 100
    assert math.isnan(holed.spot_row_px)
    image, _ = render(SMALL, Hole(Plane(), radius_mm=5.0), Light(), seed=1)
    assert image[205:215, 255:265].max() < 40


def test_wear_rises_from_nothing_and_crosses_the_limit_at_sixty_five() -> None:
    wear = [wear_at(stroke) for stroke in range(200)]
    assert wear[0] == 0.0 and all(b > a for a, b in pairwise(wear))
    assert wear_at(80, [80]) == 0.0 and wear_at(79, [80]) == wear_at(79)
    assert 0.0 < wear_at(81, [80, 20]) < 0.01
    means = {n: true_errors(DEFAULT_HEAD, part_of_stroke(n), StampedPart())[0] for n in (1, 12, 22, 45, 60, 70)}
    assert means[1] == means[12] == means[22] == 0.0
    assert means[45] < 0.085 and means[60] < 0.1 < means[70]


def test_true_errors_ignore_the_pose_and_keep_the_sign() -> None:
    golden = StampedPart()
    assert true_errors(DEFAULT_HEAD, StampedPart(dx_mm=1.0, dz_mm=0.5, tilt_x_mrad=2.0), golden) == (0.0, 0.0)
    mean, largest = true_errors(DEFAULT_HEAD, Flake(golden, 0.0, 0.0, 10.0, 0.2), golden)
    assert mean == pytest.approx(0.2) and largest == pytest.approx(0.2)
    assert true_errors(DEFAULT_HEAD, StampedPart(wear_mm=0.2), golden)[1] == pytest.approx(-0.2, abs=0.01)
