"""The thesis' own method: what it finds, and what its filter does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.metrology.chains import comb_calibration, compare, prepared
from tests.metrology.renderer import Comb, draw, plate
from wearline.recipe import Recipe
from wearline_reconstruct.core.chain import ChainSettings, prepare, reconstruct
from wearline_reconstruct.core.stripes import F64, StripeSettings, estimate_scale, strip_image
from wearline_reconstruct.core.thesis import ThesisSettings, spatial_kalman, thesis_fragments, thesis_peaks

PLATES = (0.0, 0.0, 3.0, 3.0, 6.0, 6.0)
COMB = Comb()
BY_THESIS = Recipe(method="thesis")


def test_the_recipe_chooses_the_method() -> None:
    calibration = comb_calibration(COMB, PLATES)
    pixels, across, z = draw(COMB, plate(2.0), 1001)
    theirs = compare(reconstruct(pixels, prepared(calibration, BY_THESIS)), across, z, False)
    ours = compare(reconstruct(pixels, prepared(calibration)), across, z, False)
    assert theirs.wrong == 0
    assert theirs.seen > 0.97
    assert abs(theirs.bias_mm) < 0.02
    assert ours.spread_mm < 0.5 * theirs.spread_mm


def test_positions_are_whole_pixels_of_the_line() -> None:
    pixels, across, _ = draw(COMB, plate(1.0), 1002)
    strip = strip_image(pixels, False)
    peaks = thesis_peaks(strip, estimate_scale(strip), StripeSettings(), ThesisSettings())
    assert np.array_equal(peaks.across_px, np.rint(peaks.across_px))
    off = np.nanmin(np.abs(peaks.across_px - across[:, peaks.along]), axis=0)
    # The spot is no line; beside it the middle pixel is the nearest or the next one.
    assert float(np.mean(off < 1.5)) > 0.99


def test_search_bridges_a_gap_and_drops_short_lines() -> None:
    comb = replace(COMB, lines=3, pitch_px=90.0, spot_px=0.0)

    def broken(across: F64, along: F64) -> F64:
        gone = ((along > 150) & (along < 153)) | ((along > 400) & (along < 440)) | ((along > 446) & (along < 470))
        return np.where(gone, np.nan, 1.0)

    pixels, *_ = draw(comb, broken, 1003)
    strip = strip_image(pixels, False)
    scale = estimate_scale(strip)
    found = thesis_fragments(
        thesis_peaks(strip, scale, StripeSettings(), ThesisSettings()), scale, ThesisSettings(shortest_px=30)
    )
    spans = [(int(found.peaks.along[a]), int(found.peaks.along[b - 1]))
             for a, b in zip(found.first[:-1], found.first[1:], strict=True)]  # fmt: skip
    assert len(spans) == 6
    assert sum(begin < 5 and 395 < end < 410 for begin, end in spans) == 3
    assert sum(460 < begin < 475 and end > 630 for begin, end in spans) == 3


def test_filter_variance_falls_with_the_updates_and_a_plane_stays() -> None:
    z = np.full((5, 40), 2.0)
    z[2, 20] = np.nan
    filtered = spatial_kalman(z, 0.05, 4)
    # Starting from the noise of one measurement, 1 / P grows by 1 / R with each update.
    assert filtered.variance_mm2 == pytest.approx([0.0025 / (1 + 4 * n) for n in (1, 2, 3, 4)])
    assert np.allclose(filtered.z_mm[np.isfinite(z)], 2.0)
    assert np.isnan(filtered.z_mm[2, 20])


def test_filter_takes_noise_away_and_smears_a_step() -> None:
    rng = np.random.default_rng(1004)
    z = rng.normal(0.0, 0.05, (9, 200))
    assert float(np.std(spatial_kalman(z, 0.05, 3).z_mm)) < 0.7 * float(np.std(z))
    step = np.where(np.arange(9)[:, None] < 4, 0.0, 1.0) + np.zeros((9, 200))
    once, often = (spatial_kalman(step, 0.05, n).z_mm[3, 100] for n in (1, 10))
    assert 0.05 < once < often


def test_more_iterations_are_a_setting() -> None:
    calibration = comb_calibration(COMB, PLATES)
    pixels, *_ = draw(COMB, plate(2.0), 1005)
    few, many = (
        reconstruct(
            pixels, prepare(calibration, BY_THESIS, None, ChainSettings(thesis=ThesisSettings(iterations=count)))
        )
        for count in (1, 10)
    )
    assert float(np.std(many.points[:, 3])) < float(np.std(few.points[:, 3]))
