"""Each step of the chain for itself."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from tests.metrology.chains import calibrated, comb_calibration, compare, prepared
from tests.metrology.renderer import Comb, Surface, draw, plate
from wearline.artifact import Calibration, Template
from wearline.errors import CalibrationError, FrameError
from wearline.messages import ResultCode
from wearline.recipe import Recipe
from wearline_reconstruct.core.calibration import Shot
from wearline_reconstruct.core.chain import Prepared, prepare, reconstruct
from wearline_reconstruct.core.heights import across_at, height_slope, heights
from wearline_reconstruct.core.lines import LineSettings, fragments
from wearline_reconstruct.core.smoothing import SmoothingSettings, smooth
from wearline_reconstruct.core.spot import find_spots
from wearline_reconstruct.core.stripes import F64, StripeSettings, estimate_scale, strip_image, stripe_peaks

PLATES = (0.0, 0.0, 3.0, 3.0, 6.0, 6.0)
COMB = Comb()


@pytest.mark.parametrize(
    ("width", "pitch"),
    [(1.2, 21.0), (1.8, 21.0), (2.6, 21.0), (1.2, 38.0), (2.6, 38.0), (4.0, 38.0), (1.8, 59.0), (4.0, 59.0)],
)
def test_width_and_pitch_come_from_the_picture(width: float, pitch: float) -> None:
    lines = 2 * int(200 / pitch) + 1
    comb = Comb(pitch_px=pitch, width_px=width, lines=lines, bow_px=2.0)
    pixels, *_ = draw(comb, plate(0.0), 1)
    scale = estimate_scale(strip_image(pixels, False))
    assert scale.pitch_px == pytest.approx(pitch, abs=2.0)
    assert scale.width_px == pytest.approx(width, rel=0.3)


@pytest.mark.parametrize("is_vertical", [False, True])
def test_peaks_are_unbiased(is_vertical: bool) -> None:
    comb = replace(COMB, speckle=0.0, noise_dn=0.5, spot_px=0.0, is_vertical=is_vertical)
    pixels, across, _ = draw(comb, plate(1.0), 2)
    strip = strip_image(pixels, is_vertical)
    peaks = stripe_peaks(strip, estimate_scale(strip), StripeSettings())
    off = peaks.across_px - across[:, peaks.along]
    nearest = off[np.nanargmin(np.abs(off), axis=0), np.arange(len(peaks))]
    assert len(peaks) == pytest.approx(np.isfinite(across).sum(), rel=0.005)
    assert abs(float(np.mean(nearest))) < 0.01
    assert float(np.std(nearest)) < 0.06


def test_peak_uncertainty_fits_the_scatter() -> None:
    pixels, across, _ = draw(replace(COMB, spot_px=0.0), plate(1.0), 3)
    strip = strip_image(pixels, False)
    scale = estimate_scale(strip)
    found = fragments(stripe_peaks(strip, scale, StripeSettings()), scale, 7, LineSettings())
    off = found.peaks.across_px - across[:, found.peaks.along]
    nearest = off[np.nanargmin(np.abs(off), axis=0), np.arange(len(found.peaks))]
    assert 0.7 < float(np.std(nearest / found.sigma_px)) < 1.4


def test_one_line_joined_over_a_gap_and_broken_at_a_jump() -> None:
    comb = replace(COMB, lines=3, pitch_px=90.0, spot_px=0.0)

    def jump(across: F64, along: F64) -> F64:
        return np.where(along < 300, 1.0, 2.2) + np.where((along > 150) & (along < 154), np.nan, 0.0)

    pixels, *_ = draw(comb, jump, 4)
    strip = strip_image(pixels, False)
    scale = estimate_scale(strip)
    found = fragments(stripe_peaks(strip, scale, StripeSettings()), scale, 7, LineSettings())
    assert found.count == 6
    edges = found.first
    ends = [(int(found.peaks.along[a]), int(found.peaks.along[b - 1])) for a, b in pairwise(edges)]
    for begin, end in ends:
        assert (begin < 5 and abs(end - 299) < 8) or (abs(begin - 300) < 8 and end > 630)


def test_noise_gives_no_lines() -> None:
    rng = np.random.default_rng(5)
    strip = np.clip(rng.normal(40.0, 6.0, (640, 480)), 0, 255).astype(np.uint8)
    scale = estimate_scale(strip)
    found = fragments(stripe_peaks(strip, scale, StripeSettings()), scale, 7, LineSettings())
    assert len(found.peaks) < 0.02 * 640 * 10


def test_spot_is_found_where_it_is() -> None:
    pixels, across, _ = draw(COMB, plate(2.0), 6)
    strip = strip_image(pixels, False)
    spots = find_spots(strip, estimate_scale(strip))
    assert spots
    assert spots[0].along_px == pytest.approx(COMB.along // 2, abs=4.0)
    assert spots[0].across_px == pytest.approx(across[COMB.lines // 2, COMB.along // 2], abs=4.0)
    bare, *_ = draw(replace(COMB, spot_px=0.0), plate(2.0), 7)
    assert find_spots(strip_image(bare, False), estimate_scale(strip)) == []


def test_heights_invert_the_model() -> None:
    calibration = comb_calibration(COMB, PLATES)
    line, along = np.array([2, 5, 8]), np.array([10, 300, 600])
    for z in (-0.5, 0.0, 3.3, 6.0):
        across = across_at(calibration, z)[line, along]
        assert heights(calibration, line, along, across) == pytest.approx(np.full(3, z), abs=1e-9)
        slope = (heights(calibration, line, along, across + 1e-4) - z) / 1e-4
        assert height_slope(calibration, line, along, across) == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize(
    ("comb", "planes"),
    [
        (COMB, (0.0, 3.0)),
        (COMB, (0.0, 2.0, 4.0, 6.0, 8.0)),
        (replace(COMB, a_mm_per_px=-0.15, b_per_px=-2e-4), (0.0, 3.0, 6.0)),
        (COMB, (10.0, 12.0, 14.0)),
        (replace(COMB, is_vertical=True), (-2.0, 1.0, 4.0)),
    ],
    ids=["two", "five", "other way", "without zero", "vertical"],
)
def test_calibration_measures_between_its_planes(comb: Comb, planes: tuple[float, ...]) -> None:
    calibration = comb_calibration(comb, planes)
    assert calibration.is_vertical is comb.is_vertical
    assert calibration.image_shape.tolist() == ([640, 480] if comb.is_vertical else [480, 640])
    low, high = calibration.z_range_mm
    assert low < min(planes) < max(planes) < high
    for z in (min(planes), float(np.mean(planes)), max(planes)):
        start = comb.at_datum()
        across = start + z / (comb.a_mm_per_px - comb.b_per_px * z)
        line, along = np.nonzero((across > 45) & (across < 435))
        error = heights(calibration, line, along, across[line, along]) - z
        assert float(np.nanstd(error)) < 0.012
        assert abs(float(np.nanmean(error))) < 0.008
        assert np.isfinite(error).mean() > 0.98


def test_calibration_knows_its_own_uncertainty() -> None:
    errors = []
    for seed in (11, 12, 13, 14):
        calibration = comb_calibration(COMB, (0.0, 3.0, 6.0), seed * 100)
        across = COMB.at_datum() + 2.0 / (COMB.a_mm_per_px - COMB.b_per_px * 2.0)
        line, along = np.nonzero(np.isfinite(across))
        error = heights(calibration, line, along, across[line, along]) - 2.0
        errors.append(error / calibration.z_sigma_mm[line, along])
    # Nothing vibrates in this renderer, so that the allowance for it makes the figure generous.
    assert float(np.sqrt(np.mean(np.square(np.concatenate(errors))))) < 1.3


def shots(surfaces: list[tuple[float, Surface]], comb: Comb = COMB) -> list[Shot]:
    return [Shot(z, draw(comb, s, 40 + k)[0], f"plate{k}.png") for k, (z, s) in enumerate(surfaces)]


def refusal(pictures: list[Shot], lines: int = COMB.lines) -> str:
    with pytest.raises(CalibrationError) as caught:
        calibrated(pictures, lines, False)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_calibration_refuses_what_cannot_be() -> None:
    assert "two heights" in refusal(shots([(0.0, plate(0.0)), (0.0, plate(0.0))]))
    assert "swapped" in refusal(shots([(0.0, plate(3.0)), (3.0, plate(0.0)), (6.0, plate(6.0))]))
    assert "wrong" in refusal(shots([(0.0, plate(0.0)), (2.0, plate(2.0)), (4.0, plate(6.0))]))
    assert "spot" in refusal(shots([(0.0, plate(0.0)), (3.0, plate(3.0))], replace(COMB, spot_px=0.0)))
    assert "lines" in refusal(shots([(0.0, plate(0.0)), (3.0, plate(3.0))]), lines=25)
    other = Shot(3.0, np.zeros((100, 100), np.uint8), "small.png")
    assert "small.png" in refusal([*shots([(0.0, plate(0.0))]), other])
    black = Shot(3.0, np.zeros((480, 640), np.uint8), "black.png")
    assert "black.png" in refusal([*shots([(0.0, plate(0.0))]), black])


def test_one_wrong_plate_of_five_is_found_and_its_height_not_used() -> None:
    pictures = shots([(z, plate(z + (0.08 if z == 4.0 else 0.0))) for z in (0.0, 2.0, 4.0, 6.0, 8.0)])
    calibration = calibrated(pictures, COMB.lines, False)
    planes = {plane["z_mm"]: plane for plane in calibration.meta["planes"]}
    assert [z for z, plane in planes.items() if not plane["is_believed"]] == [4.0]
    assert planes[4.0]["left_out_mm"] == pytest.approx(0.08, abs=0.01)
    across = COMB.at_datum() + 4.0 / (COMB.a_mm_per_px - COMB.b_per_px * 4.0)
    line, along = np.nonzero(np.isfinite(across))
    assert float(np.nanmean(heights(calibration, line, along, across[line, along]))) == pytest.approx(4.0, abs=0.006)
    rests = [line["rest_mm"] for line in calibration.meta["lines"]]
    assert len(rests) == COMB.lines and all(0.0 < rest < 0.05 for rest in rests)


def test_calibration_survives_a_scratch_on_one_plate() -> None:
    def scratched(across: F64, along: F64) -> F64:
        return np.where((along > 200) & (along < 240), 2.4, 3.0)

    pictures = shots([(0.0, plate(0.0)), (3.0, scratched), (3.0, plate(3.0)), (6.0, plate(6.0))])
    calibration = calibrated(pictures, COMB.lines, False)
    across = COMB.at_datum() + 3.0 / (COMB.a_mm_per_px - COMB.b_per_px * 3.0)
    line, along = np.nonzero(np.isfinite(across))
    error = heights(calibration, line, along, across[line, along]) - 3.0
    assert float(np.nanmax(np.abs(error))) < 0.05


def test_smoother_does_not_depend_on_the_direction() -> None:
    rng = np.random.default_rng(8)
    z = 0.2 * np.sin(np.arange(700) / 80.0)[None] + rng.normal(0.0, 0.02, (5, 700))
    z[:, 200:230] = np.nan
    sigma, starts = np.full(z.shape, 0.02), np.zeros(z.shape, bool)
    process = np.full(z.shape, 1e-6)
    settings = SmoothingSettings(overlap_px=200)
    one = smooth(z, sigma, starts, 1.0, process, settings)
    two = smooth(z[:, ::-1], sigma, starts, 1.0, process, settings)
    assert np.nanmax(np.abs(one.z_mm - two.z_mm[:, ::-1])) < 1e-4
    error = one.z_mm - 0.2 * np.sin(np.arange(700) / 80.0)
    assert float(np.nanstd(error)) < 0.008
    assert 0.6 < float(np.nanstd(error / one.sigma_mm)) < 1.3
    assert np.array_equal(np.isnan(one.z_mm), np.isnan(z))


def test_smoother_keeps_a_step() -> None:
    rng = np.random.default_rng(9)
    true = np.where(np.arange(600) < 300, 1.0, 1.5)
    z = true + rng.normal(0.0, 0.02, (4, 600))
    starts = np.zeros(z.shape, bool)
    starts[:, [0, 300]] = True
    result = smooth(z, np.full(z.shape, 0.02), starts, 1.0, np.full(z.shape, 1e-7), SmoothingSettings())
    assert np.abs(result.z_mm - true).max() < 0.05


def template_of(calibration: Calibration, across: F64, z: F64) -> Template:
    shape = (int(calibration.image_shape[0]), int(calibration.image_shape[1]))
    f32 = np.float32
    return Template(
        line_across_px=across.astype(f32), line_z_mm=z.astype(f32), line_sigma_mm=np.full(z.shape, 0.01, f32),
        line_spread_mm=np.full(z.shape, 0.01, f32), line_coverage=np.isfinite(z).astype(f32),
        z_map_mm=np.zeros(shape, f32), roi=np.array([0, 0, shape[1], shape[0]], np.int32), calibration_hash="",
        recipe_hash="", frames=5,
    )  # fmt: skip


def gated(comb: Comb = COMB) -> Prepared:
    calibration = comb_calibration(comb, PLATES)
    _, across, z = draw(comb, plate(2.0), 50)
    return prepare(calibration, Recipe(), template_of(calibration, across, z))


def test_template_gates_steps_up_to_almost_half_a_pitch() -> None:
    height = 0.45 * COMB.pitch_px * COMB.a_mm_per_px

    def stepped(across: F64, along: F64) -> F64:
        return np.where((along > 350) & (across > 200.0) & (across < 330.0), 2.0 + height, 2.0)

    pixels, across, z = draw(COMB, stepped, 51)
    result = compare(reconstruct(pixels, gated()), across, z, False)
    assert result.wrong == 0
    assert result.seen > 0.96


def test_a_part_one_pitch_too_high_is_refused() -> None:
    height = 2.0 + COMB.pitch_px * COMB.a_mm_per_px / (1.0 + COMB.b_per_px * COMB.pitch_px)
    pixels, *_ = draw(COMB, plate(height), 52)
    with pytest.raises(FrameError, match="spot") as caught:
        reconstruct(pixels, gated())
    assert caught.value.code == ResultCode.REGISTRATION
    bare, *_ = draw(replace(COMB, spot_px=0.0), plate(height), 53)
    with pytest.raises(FrameError):
        reconstruct(bare, gated())


def test_template_and_comb_do_without_a_spot() -> None:
    pixels, across, z = draw(replace(COMB, spot_px=0.0), plate(2.1), 54)
    found = reconstruct(pixels, gated())
    assert compare(found, across, z, False).wrong == 0
    assert not found.quality.spot_found
    assert any("spot" in sentence for sentence in found.quality.sentences)


FLAT = np.full((480, 640), 60, np.uint8)


@pytest.mark.parametrize(
    ("pixels", "word"),
    [
        (np.zeros((480, 640), np.uint8), "black"),
        (np.full((480, 640), 255, np.uint8), "white"),
        (FLAT, "even"),
        (np.random.default_rng(1).integers(0, 256, (480, 640)).astype(np.uint8), "noise|no laser lines|number"),
        (
            np.clip(np.random.default_rng(2).normal(60, 5, (480, 640)), 0, 255).astype(np.uint8),
            "noise|no laser lines|even",
        ),
        (np.zeros((479, 640), np.uint8), "479"),
        (np.zeros((480, 640), np.uint16), "8-bit"),
        (np.zeros((480, 640, 3), np.uint8), "8-bit"),
    ],
)
def test_hopeless_frames_are_refused_with_a_reason(pixels: np.ndarray, word: str) -> None:
    with pytest.raises(FrameError, match=word) as caught:
        reconstruct(pixels, prepared(comb_calibration(COMB, PLATES)))
    assert 10 <= caught.value.code <= 99
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("z_mm", [-9.0, -5.8, 11.5, 14.0])
@pytest.mark.parametrize("spot_px", [5.0, 0.0])
def test_a_part_out_of_range_is_refused(z_mm: float, spot_px: float) -> None:
    pixels, *_ = draw(replace(COMB, spot_px=spot_px), plate(z_mm), 60)
    with pytest.raises(FrameError):
        reconstruct(pixels, prepared(comb_calibration(COMB, PLATES)))


def test_lines_across_the_sensor_are_no_lines() -> None:
    pixels, *_ = draw(replace(COMB, across=640, along=480, is_vertical=True), plate(2.0), 61)
    with pytest.raises(FrameError):
        reconstruct(pixels, prepared(comb_calibration(COMB, PLATES)))


def test_roi_bounds_the_points() -> None:
    pixels, *_ = draw(COMB, plate(2.0), 62)
    chain = prepared(comb_calibration(COMB, PLATES), Recipe(roi=(100, 150, 300, 200)))
    found = reconstruct(pixels, chain)
    assert found.points[:, 2].min() >= 100 and found.points[:, 2].max() < 400
    assert found.points[:, 1].min() >= 150 and found.points[:, 1].max() < 350
    assert found.coverage > 0.95


def test_saturated_stripes_are_told() -> None:
    comb = replace(COMB, signal_dn=600.0)
    pixels, across, z = draw(comb, plate(2.0), 63)
    found = reconstruct(pixels, prepared(comb_calibration(COMB, PLATES)))
    assert found.quality.saturated_fraction > 0.3
    assert any("saturated" in sentence for sentence in found.quality.sentences)
    assert compare(found, across, z, False).wrong == 0


def test_timings_come_from_the_clock_that_is_passed() -> None:
    ticks = iter(range(100))
    pixels, *_ = draw(COMB, plate(2.0), 64)
    found = reconstruct(pixels, prepared(comb_calibration(COMB, PLATES)), lambda: float(next(ticks)))
    assert found.timings_ms["stripes"] == 1000.0
    assert found.timings_ms["total"] == sum(v for k, v in found.timings_ms.items() if k != "total")


def told(pixels: np.ndarray) -> str:
    """Sentences of a frame, or the reason why it was refused."""
    try:
        return " ".join(reconstruct(pixels, prepared(comb_calibration(COMB, PLATES))).quality.sentences)
    except FrameError as refused:
        return str(refused)


def frame_of(comb: Comb = COMB, seed: int = 65) -> np.ndarray:
    return draw(comb, plate(2.0), seed)[0]


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        (frame_of(), ()),
        (np.where(np.arange(640) < 320, frame_of(), 0).astype(np.uint8), ("Only 5",)),
        (np.roll(frame_of(), 150, 1), ("spot", "column 47", "moved")),
        (frame_of(replace(COMB, pitch_px=30.0)), ("79%", "not the calibrated head")),
        (frame_of(replace(COMB, dead=(2, 7))), ("2 of 11", "line 2, 7", "dead")),
        (frame_of(replace(COMB, spot_px=0.0)), ("centre spot was not found",)),
        (frame_of(replace(COMB, signal_dn=900.0)), ("saturated", "shorten")),
        (frame_of(replace(COMB, ambient_dn=170.0)), ("Ambient light", "shade")),
        (cv2.GaussianBlur(frame_of(), (0, 0), 3.0), ("times as broad", "focus", "shakes")),
        (frame_of(replace(COMB, signal_dn=9.0)), ("DN above the background", "lengthen")),
    ],
    ids=["good", "half", "shifted", "wrong head", "dead lines", "no spot", "saturated", "ambient", "blurred", "dim"],
)
def test_a_frame_says_what_is_wrong_with_it(pixels: np.ndarray, words: tuple[str, ...]) -> None:
    text = told(pixels)
    assert all(word in text for word in words), text
    if not words:
        assert text == ""
