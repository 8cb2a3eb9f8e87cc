"""From line points to the dense map."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from wearline.surface import dense_map

ROWS, COLS = 400, 120
SENSITIVITY = 6.0
"""How far a line moves with the height. [px/mm]"""

F64 = NDArray[np.float64]


def points_of(z_of_row: F64, pitch: float = 40.0, without: tuple[int, ...] = ()) -> NDArray[np.float32]:
    """Line points of a surface that depends on the row alone."""
    found = []
    for line, start in enumerate(np.arange(20.3, ROWS - 20, pitch)):
        if line in without:
            continue
        # The line lies where row = start - sensitivity * z(row).
        row = start
        for _ in range(60):
            row = 0.5 * row + 0.5 * (start - SENSITIVITY * float(np.interp(row, np.arange(ROWS), z_of_row)))
        z = float(np.interp(row, np.arange(ROWS), z_of_row))
        for col in range(COLS):
            found.append((line, row, col, z, 0.01))
    return np.array(found, np.float32)


def test_a_plane_is_exact() -> None:
    z: F64 = np.linspace(0.5, 0.5 + 0.004 * (ROWS - 1), ROWS)
    result = dense_map(points_of(z), (ROWS, COLS))
    drawn = np.isfinite(result.z_mm)
    assert drawn[60:330].all()
    assert np.abs(result.z_mm - z[:, None])[drawn].max() < 1e-4
    assert np.isnan(result.z_mm[:15]).all() and np.isnan(result.z_mm[-10:]).all()
    assert np.array_equal(drawn, np.isfinite(result.sigma_mm))


def test_a_curve_errs_less_than_a_straight_line_would() -> None:
    z = 1.5 * np.sin(np.arange(ROWS) / 60.0)
    result = dense_map(points_of(z), (ROWS, COLS))
    inner = slice(80, 320)
    error = np.abs(result.z_mm[inner, 5] - z[inner])
    straight = 1.5 / 60.0**2 * 40.0**2 / 8.0
    assert np.nanmax(error) < 0.35 * straight
    # The uncertainty covers what the cubic misses.
    assert np.nanmean(error < 2.0 * result.sigma_mm[inner, 5]) > 0.9


def test_uncertainty_grows_between_lines() -> None:
    z = 1.5 * np.sin(np.arange(ROWS) / 60.0)
    sigma = dense_map(points_of(z), (ROWS, COLS)).sigma_mm[:, 5]
    assert np.nanmax(sigma) > 1.2 * np.nanmin(sigma)


def test_nothing_across_a_step_or_a_missing_line() -> None:
    z = np.where(np.arange(ROWS) < 200, 0.0, 3.0)
    stepped = dense_map(points_of(z), (ROWS, COLS)).z_mm[:, 5]
    between = np.flatnonzero(np.isnan(stepped[60:330])) + 60
    assert len(between) > 10
    assert not np.any((stepped > 0.1) & (stepped < 2.9))
    flat = np.zeros(ROWS)
    holed = dense_map(points_of(flat, without=(4,)), (ROWS, COLS)).z_mm[:, 5]
    assert np.isnan(holed[145:215]).all()
    assert np.isfinite(holed[65:135]).all()


def test_a_steep_slope_is_no_step() -> None:
    t = np.clip((np.arange(ROWS) - 100.0) / 180.0, 0.0, 1.0)
    z = 6.0 * t**3 * (t * (6.0 * t - 15.0) + 10.0)
    drawn = np.isfinite(dense_map(points_of(z), (ROWS, COLS)).z_mm[:, 5])
    assert drawn[60:300].all()


def test_vertical_is_the_transpose() -> None:
    z = 1.0 * np.sin(np.arange(ROWS) / 70.0)
    points = points_of(z)
    lying = dense_map(points, (ROWS, COLS))
    standing = dense_map(points[:, [0, 2, 1, 3, 4]], (COLS, ROWS), is_vertical=True)
    assert np.array_equal(lying.z_mm, standing.z_mm.T, equal_nan=True)


def test_roi_is_a_window_of_the_whole() -> None:
    points = points_of(0.5 * np.sin(np.arange(ROWS) / 70.0))
    whole = dense_map(points, (ROWS, COLS)).z_mm
    part = dense_map(points, (ROWS, COLS), roi=(10, 50, 30, 200))
    assert part.roi.tolist() == [10, 50, 30, 200]
    assert np.array_equal(part.z_mm, whole[50:250, 10:40], equal_nan=True)


@pytest.mark.parametrize("n", [0, 1])
def test_too_little_gives_an_empty_map(n: int) -> None:
    points = points_of(np.zeros(ROWS))[:n]
    result = dense_map(points, (ROWS, COLS))
    assert result.z_mm.shape == (ROWS, COLS)
    assert np.isnan(result.z_mm).all()
