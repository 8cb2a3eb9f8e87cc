"""Stripes without a calibration: the line is found, and what only looks like one is left alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.metrology.renderer import Comb, draw, plate
from wearline_reconstruct.core.lines import Fragments, LineSettings
from wearline_reconstruct.core.looking import any_stripes, drawn
from wearline_reconstruct.core.stripes import F64, Image, StripeSettings, strip_image

SHAPE = (480, 640)


def looked(pixels: Image) -> Fragments:
    return any_stripes(strip_image(pixels, False), StripeSettings(), LineSettings())[1]


def with_line(background: F64, brightness: float, width_px: float = 2.5) -> tuple[NDArray[np.uint8], F64]:
    """A bent laser line on a picture, and its true row per column."""
    rng = np.random.default_rng(1)
    row = 240.0 + 0.03 * np.arange(SHAPE[1]) + 12.0 * np.sin(np.arange(SHAPE[1]) / 120.0)
    line = brightness * np.exp(-0.5 * ((np.arange(SHAPE[0])[:, None] - row) / width_px) ** 2)
    image = background + line + rng.normal(0.0, 2.0, SHAPE)
    return np.clip(image, 0, 255).astype(np.uint8), row


def chessboard() -> F64:
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    fields = np.where(((x + 0.15 * y) // 40 + (y - 0.15 * x) // 40) % 2 == 0, 130.0, 30.0)
    return np.asarray(cv2.GaussianBlur(fields, (0, 0), 1.0), np.float64)


@pytest.mark.parametrize("brightness", [110.0, 200.0])
def test_a_laser_line_on_a_chessboard_in_daylight(brightness: float) -> None:
    pixels, row = with_line(chessboard(), brightness)
    found = looked(pixels)
    off = np.abs(found.peaks.across_px - row[found.peaks.along])
    on_line = off < 3.0
    assert len(np.unique(found.peaks.along[on_line])) > 0.75 * SHAPE[1]
    assert float(np.mean(on_line)) > 0.7


def test_a_line_on_a_faint_pattern_stands_alone() -> None:
    pixels, row = with_line(0.08 * chessboard(), 180.0)
    found = looked(pixels)
    off = np.abs(found.peaks.across_px - row[found.peaks.along])
    assert (off < 3.0).all()
    assert len(found.peaks) > 0.95 * SHAPE[1]


def test_edges_are_no_stripes() -> None:
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    step = np.where(y > 200 + 0.05 * x, 170.0, 40.0) + np.random.default_rng(2).normal(0.0, 2.0, SHAPE)
    assert looked(np.clip(step, 0, 255).astype(np.uint8)).count == 0


def test_a_laser_comb_keeps_its_scale() -> None:
    pixels, across, _ = draw(Comb(), plate(1.0), 3)
    found = looked(pixels)
    off = np.nanmin(np.abs(found.peaks.across_px - across[:, found.peaks.along]), axis=0)
    assert float(np.mean(off < 1.0)) > 0.98
    assert len(found.peaks) > 0.97 * np.isfinite(across).sum()


def test_an_even_picture_has_none() -> None:
    noise = np.clip(np.random.default_rng(4).normal(90.0, 4.0, SHAPE), 0, 255).astype(np.uint8)
    assert len(looked(noise).peaks) < 200


@pytest.mark.parametrize("is_vertical", [False, True])
def test_the_picture_shows_the_stripes_where_they_are(is_vertical: bool) -> None:
    comb = Comb(lines=3, pitch_px=90.0, spot_px=0.0, is_vertical=is_vertical)
    pixels, across, _ = draw(comb, plate(1.0), 5)
    found = any_stripes(strip_image(pixels, is_vertical), StripeSettings(), LineSettings())[1]
    canvas = drawn(pixels, found, is_vertical)
    assert canvas.shape == (*pixels.shape, 3)
    coloured = np.ptp(canvas.astype(int), axis=2) > 100
    row, col = np.nonzero(coloured)
    along, over = (row, col) if is_vertical else (col, row)
    assert np.nanmax(np.nanmin(np.abs(over - across[:, along]), axis=0)) < 3.0
