"""The bench on small scenes: the figures are measured, and the picture is drawn."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from wearline.cli import main
from wearline.scene import Head, Light, Plane, render
from wearline_reconstruct.commands import bench
from wearline_reconstruct.commands.bench_peers import compare_peers
from wearline_reconstruct.core.stripes import Scale

SMALL = Head(rows=400, cols=480, lines=9, pitch_mm=4.0)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "_HEAD", SMALL)
    monkeypatch.setattr(bench, "DEFAULT_HEAD", SMALL)
    monkeypatch.setattr(bench, "_SHOTS", 1)
    monkeypatch.setattr(bench, "TABLE_5_5", {(400, 300): {1: 86.0, 3: 136.0, 5: 192.0, 15: 719.0}})


@pytest.mark.usefixtures("small")
def test_bench_measures_and_draws(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Judging has tests of its own; ten parts more would only take time here.
    monkeypatch.setattr(bench, "_has_judge", lambda: False)
    assert main(["bench", "--frames", "1", "--json", "--picture", str(tmp_path / "bench.png")]) == 0
    found = json.loads(capsys.readouterr().out)
    planes = {(row["scene"], row["method"]): row for row in found["planes"]}
    ours, theirs = planes["plane 3 mm", "wearline"], planes["plane 3 mm", "thesis"]
    assert abs(ours["bias_um"]) < 20.0
    assert ours["point_um"] < 0.5 * theirs["point_um"]
    assert ours["thesis_bias_um"] == pytest.approx(-40.0)
    assert ours["wrong"] == theirs["wrong"] == 0
    filtered = found["variance"]["thesis' filter, by itself"]
    assert all(later < earlier for earlier, later in itertools.pairwise(filtered))
    assert found["speed"][0]["ms"]["wearline"] > 0.0
    picture = cv2.imread(str(tmp_path / "bench.png"))
    assert picture is not None and float(np.std(picture)) > 20.0


@pytest.mark.usefixtures("small")
def test_bench_prints_its_tables(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--frames", "1"]) == 0
    text = capsys.readouterr().out
    for word in ("Table 5.3", "Table 5.4", "Table 5.5", "Figure 5.12", "Figure 5.13", "polished steel", "Steger"):
        assert word in text
    assert "none" not in text.split("Figure 5.13")[0].split("Table 5.4")[1]


@pytest.mark.parametrize("options", [["--frames", "0"], ["--picture", "bench.jpg"], ["--picture", "nowhere/b.png"]])
def test_unusable_options(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *options]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_peers_are_compared_with_the_truth() -> None:
    pixels, truth = render(SMALL, Plane(2.0), Light(texture=0.0), 41)
    peers = {peer.name: peer for peer in compare_peers(pixels, truth, Scale(2.0, 40.0))}
    ours = peers["wearline"]
    assert ours.recall > 0.99
    assert ours.junk == 0
    for name in ("thesis", "centre of gravity", "Steger, OpenCV filters"):
        assert peers[name].recall > 0.9, name
        assert ours.rms_px < peers[name].rms_px, name
