"""Frames that no camera should deliver: a reason or points of real lines, never another exception."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.metrology.chains import comb_calibration, prepared
from tests.metrology.renderer import Comb, draw, plate
from wearline.errors import FrameError
from wearline_reconstruct.core.chain import reconstruct

COMB = Comb()
U8 = NDArray[np.uint8]


def mutated(pixels: U8, rng: np.random.Generator) -> U8:
    """One to three changes at random."""
    image = pixels.copy()
    rows, cols = image.shape
    for _ in range(int(rng.integers(1, 4))):
        r0, c0 = int(rng.integers(0, rows)), int(rng.integers(0, cols))
        r1, c1 = int(rng.integers(r0, rows)) + 1, int(rng.integers(c0, cols)) + 1
        kind = int(rng.integers(0, 12))
        if kind == 0:
            image[r0:r1, c0:c1] = rng.integers(0, 256)
        elif kind == 1:
            image = np.ascontiguousarray(image[::-1])
        elif kind == 2:
            image = np.ascontiguousarray(image[:, ::-1])
        elif kind == 3:
            image = np.roll(image, (r0, c0), (0, 1))
        elif kind == 4:
            image = np.clip(image + rng.normal(0, rng.uniform(1, 60), image.shape), 0, 255).astype(np.uint8)
        elif kind == 5:
            image = np.clip(image + np.linspace(0, rng.uniform(20, 255), cols), 0, 255).astype(np.uint8)
        elif kind == 6:
            cv2.putText(image, "WEARLINE", (c0 // 2, max(r0, 30)), cv2.FONT_HERSHEY_SIMPLEX, 2.0, (255,), 4)
        elif kind == 7:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), float(rng.uniform(1, 12))), np.uint8)
        elif kind == 8:
            image = (image * rng.uniform(0.0, 0.4)).astype(np.uint8)
        elif kind == 9:
            image = np.clip(image * rng.uniform(2.0, 30.0), 0, 255).astype(np.uint8)
        elif kind == 10:
            image[r0:] = 0
        else:
            turned = cv2.warpAffine(
                image, cv2.getRotationMatrix2D((320, 240), float(rng.uniform(0, 360)), 1.0), (cols, rows)
            )
            image = np.asarray(turned, np.uint8)
    return image


@pytest.mark.parametrize("count", [120, pytest.param(10_000, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])])
def test_mutated_frames_never_break_the_chain(count: int) -> None:
    chain = prepared(comb_calibration(COMB, (0.0, 0.0, 3.0, 3.0, 6.0, 6.0)))
    pixels = draw(COMB, plate(2.0), 77)[0]
    low, high = chain.calibration.z_range_mm
    measured = 0
    for seed in range(count):
        image = mutated(pixels, np.random.default_rng([77, seed]))
        try:
            found = reconstruct(image, chain)
        except FrameError as refused:
            assert 10 <= refused.code <= 99 and "\n" not in str(refused), seed
            continue
        measured += 1
        points = found.points
        assert np.isfinite(points).all(), seed
        assert (points[:, 4] > 0).all(), seed
        assert (points[:, 3] > low - 0.5).all() and (points[:, 3] < high + 0.5).all(), seed
        assert 0.0 <= found.coverage <= 1.0, seed
    assert 0.05 * count < measured < 0.95 * count


def test_lines_that_fit_no_number_are_refused() -> None:
    """A frame whose fragments have not one candidate between them."""
    chain = prepared(comb_calibration(COMB, (0.0, 0.0, 3.0, 3.0, 6.0, 6.0)))
    strange = Comb(lines=1, pitch_px=40.0, slant=0.6, bow_px=0.0, spot_px=0.0)
    pixels = draw(strange, plate(0.0), 78)[0]
    with pytest.raises(FrameError):
        reconstruct(pixels, chain)
