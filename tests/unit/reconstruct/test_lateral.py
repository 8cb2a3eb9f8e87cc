"""Lateral scale, x and y: targets of every kind, turned and tilted, against the camera that drew them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.metrology.chains import comb_calibration
from tests.metrology.renderer import Comb
from wearline.errors import CalibrationError
from wearline_reconstruct.core.lateral import find_target, fit_lateral, positions_mm, scale_of

SHAPE = (600, 800)
FOCAL_PX, DISTANCE_MM, FIELD_MM = 3000.0, 600.0, 6.0
MATRIX = np.array([[FOCAL_PX, 0.0, 399.5], [0.0, FOCAL_PX, 299.5], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.3, 0.2, 0.0, 0.0, 0.0])
F64 = NDArray[np.float64]


def turned(tilt_deg: float, turn_deg: float) -> F64:
    return np.asarray(cv2.Rodrigues(np.radians([tilt_deg, 0.5 * tilt_deg, turn_deg]))[0], np.float64)


def on_target(turn: F64, col: F64, row: F64, z_mm: F64 | float) -> tuple[F64, F64]:
    """True place in the target's frame of what the camera sees at these pixels, z towards the camera. [mm]"""
    seen = np.stack([col, row], axis=-1).reshape(-1, 1, 2)
    flat = cv2.undistortPoints(seen, MATRIX, DISTORTION).reshape(-1, 2)
    sight = np.column_stack([flat, np.ones(len(flat))]) @ turn
    eye = -turn.T @ np.array([0.0, 0.0, DISTANCE_MM])
    reach = (-np.ravel(np.asarray(z_mm)) - eye[2]) / sight[:, 2]
    return eye[0] + reach * sight[:, 0], eye[1] + reach * sight[:, 1]


def drawn(kind: str, turn: F64, fields: tuple[int, int] = (19, 15)) -> NDArray[np.uint8]:
    row, col = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float64)
    total = np.zeros(SHAPE)
    for dr, dc in ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25)):
        x, y = (v.reshape(SHAPE) / FIELD_MM for v in on_target(turn, col + dc, row + dr, 0.0))
        u, v = x + fields[0] / 2.0, y + fields[1] / 2.0
        inside = (u > 0) & (u < fields[0]) & (v > 0) & (v < fields[1])
        if kind == "chessboard":
            bright = (np.floor(u) + np.floor(v)) % 2 == 0
        else:
            bright = np.hypot(u % 1.0 - 0.5, v % 1.0 - 0.5) > 0.27
        total += np.where(bright | ~inside, 210.0, 40.0) / 4.0
    noisy = cv2.GaussianBlur(total, (0, 0), 0.8) + np.random.default_rng(1).normal(0.0, 2.0, SHAPE)
    return np.clip(255.0 - noisy if kind == "bright dots" else noisy, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("kind", ["chessboard", "dots", "bright dots"])
@pytest.mark.parametrize(("tilt", "turn_deg"), [(0.0, 0.0), (3.0, -25.0), (1.0, 88.0)])
def test_positions_fit_the_camera_that_drew_the_target(kind: str, tilt: float, turn_deg: float) -> None:
    turn = turned(tilt, turn_deg)
    target = find_target(drawn(kind, turn), "t.png")
    assert ("dot" in target.kind) == (kind != "chessboard")
    lateral = fit_lateral(target, FIELD_MM, SHAPE, DISTANCE_MM, "t.png")
    calibration = comb_calibration(Comb(), (0.0, 3.0, 6.0))
    calibration = replace(calibration, image_shape=np.array(SHAPE), meta={**calibration.meta, "lateral": lateral})
    rng = np.random.default_rng(2)
    col, row, z = rng.uniform(150, 650, 40), rng.uniform(120, 480, 40), rng.uniform(-2.0, 6.0, 40)
    found = np.column_stack(positions_mm(calibration, row, col, z))
    true = np.column_stack(on_target(turn, col, row, z))
    # The frame is the sensor's, not the target's: what remains after a rigid motion is the error.
    found, true = found - found.mean(axis=0), true - true.mean(axis=0)
    u, _, v = np.linalg.svd(true.T @ found)
    assert np.linalg.det(u @ v) > 0
    assert np.abs(true @ (u @ v) - found).max() < 0.04
    usual = DISTANCE_MM / FOCAL_PX
    assert scale_of(lateral, SHAPE) == pytest.approx(usual, rel=0.003)
    # x runs with the columns.
    x, y = positions_mm(calibration, np.array([299.5, 299.5]), np.array([300.0, 500.0]), np.zeros(2))
    assert x[1] - x[0] == pytest.approx(200 * usual, rel=0.01)
    assert abs(y[1] - y[0]) < 0.02


def test_a_bare_scale_gives_positions_too() -> None:
    calibration = replace(comb_calibration(Comb(), (0.0, 3.0, 6.0)), mm_per_pixel=0.1)
    x, y = positions_mm(calibration, np.array([239.5, 249.5]), np.array([319.5, 339.5]), np.zeros(2))
    assert x.tolist() == pytest.approx([0.0, 2.0])
    assert y.tolist() == pytest.approx([0.0, 1.0])


def test_what_is_no_target_is_refused() -> None:
    with pytest.raises(CalibrationError, match="neither"):
        find_target(np.full(SHAPE, 90, np.uint8), "blank.png")
    noise = np.random.default_rng(3).integers(0, 256, SHAPE).astype(np.uint8)
    with pytest.raises(CalibrationError):
        fit_lateral(find_target(noise, "noise.png"), 5.0, SHAPE, DISTANCE_MM, "noise.png")
    tilted = find_target(drawn("dots", turned(35.0, 0.0), (11, 9)), "tilted.png")
    with pytest.raises(CalibrationError, match="tilted"):
        fit_lateral(tilted, FIELD_MM, SHAPE, DISTANCE_MM, "tilted.png")
