"""More light and dark than one exposure holds: brackets, and the flanks of saturated stripes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.metrology.chains import Comparison, comb_calibration, compare, prepared
from tests.metrology.renderer import Comb, draw, plate
from wearline.cli import main
from wearline.errors import FrameError
from wearline.recipe import Recipe, dump_recipe
from wearline_reconstruct.core.chain import reconstruct

PLATES = (0.0, 0.0, 3.0, 3.0, 6.0, 6.0)
COMB = Comb(speckle=0.2)
U8 = NDArray[np.uint8]
SENSOR = COMB.at_datum() + 2.0 / (COMB.a_mm_per_px - COMB.b_per_px * 2.0)
Z = np.full_like(SENSOR, 2.0)


def exposure(time: float, seed: int) -> U8:
    """A part whose left half is bright and whose right half is nearly black."""
    bright, *_ = draw(replace(COMB, signal_dn=1300.0 * time, ambient_dn=60.0 * time), plate(2.0), seed)
    dark, *_ = draw(replace(COMB, signal_dn=70.0 * time, ambient_dn=8.0 * time), plate(2.0), seed + 1)
    bright[:, 320:] = dark[:, 320:]
    return bright


def measured(pictures: U8 | list[U8], recipe: Recipe | None = None) -> Comparison:
    chain = prepared(comb_calibration(COMB, PLATES), recipe)
    return compare(reconstruct(pictures, chain), SENSOR, Z, False)


BRACKET = Recipe(hdr="bracket")


def test_a_bracket_shows_what_no_single_exposure_does() -> None:
    short, long = exposure(0.02, 1), exposure(1.0, 11)
    merged = measured([long, short], BRACKET)
    assert merged.wrong == 0
    assert merged.seen > 0.97
    assert merged.spread_mm < 0.03
    one = measured(short)
    assert one.seen < 0.8 * merged.seen
    assert merged.spread_mm < 1.1 * one.spread_mm
    chain = prepared(comb_calibration(COMB, PLATES), BRACKET)
    assert reconstruct([long, short], chain).quality.saturated_fraction < 0.05
    assert reconstruct(long, chain).quality.saturated_fraction > 0.3


def test_three_exposures_in_any_order() -> None:
    pictures = [exposure(0.3, 21), exposure(0.08, 31), exposure(1.0, 41)]
    first, second = measured(pictures, BRACKET), measured(pictures[::-1], BRACKET)
    assert first.seen > 0.97 and first.wrong == 0
    assert np.array_equal(first.error_mm, second.error_mm)


def test_one_black_exposure_of_a_bracket_does_no_harm() -> None:
    black = np.zeros((480, 640), np.uint8)
    assert measured([black, exposure(1.0, 51)], BRACKET).seen > 0.9
    with pytest.raises(FrameError, match="black"):
        measured([black, black], BRACKET)


def test_flanks_of_bloomed_stripes() -> None:
    bloomed = replace(COMB, width_px=3.4, signal_dn=2500.0)
    pixels, across, z = draw(bloomed, plate(2.0), 61)
    chain = comb_calibration(COMB, PLATES)
    plain = compare(reconstruct(pixels, prepared(chain)), across, z, False)
    flanks = compare(reconstruct(pixels, prepared(chain, Recipe(hdr="saturation"))), across, z, False)
    assert flanks.wrong == 0 and flanks.seen > 0.95
    assert flanks.spread_mm < plain.spread_mm
    assert abs(flanks.bias_mm) < 0.01


def test_saturation_handling_leaves_other_stripes_alone() -> None:
    pixels, *_ = draw(COMB, plate(2.0), 71)
    chain = comb_calibration(COMB, PLATES)
    off = reconstruct(pixels, prepared(chain))
    on = reconstruct(pixels, prepared(chain, Recipe(hdr="saturation")))
    share = np.mean(off.points[:, 1] == on.points[:, 1]) if len(off.points) == len(on.points) else 0.0
    assert share > 0.95


def test_brackets_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    comb_calibration(COMB, PLATES).save(tmp_path / "C.npz")
    names = []
    for k, time in enumerate((1.0, 0.08, 1.0, 0.08)):
        names.append(str(tmp_path / f"part{k // 2}-{k % 2}.png"))
        cv2.imwrite(names[-1], exposure(time, 80 + 10 * k))
    rest = ["--calibration", str(tmp_path / "C.npz"), "--out", str(tmp_path)]
    assert main(["reconstruct", *names, "--bracket", "2", *rest]) == 0
    assert sorted(p.name for p in tmp_path.glob("part*.npz")) == ["part0-0.npz", "part1-0.npz"]
    with np.load(tmp_path / "part0-0.npz") as found:
        assert float(np.median(found["z_mm"])) == pytest.approx(2.0, abs=0.02)
        assert len(found["line"]) > 0.95 * 640 * COMB.lines
    (tmp_path / "R.yaml").write_text(dump_recipe(BRACKET))
    capsys.readouterr()
    recipe = ["--recipe", str(tmp_path / "R.yaml")]
    for options, word in (
        ([*names, "--bracket", "3", *rest], "whole brackets"),
        ([*names, "--bracket", "9", *rest], "2 or 3"),
        ([*names, *recipe, *rest], "--bracket 2 or 3"),
    ):
        assert main(["reconstruct", *options]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1 and word in lines[0]
