"""``wearline capability`` from values, from records and from frames."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.metrology.renderer import draw, plate
from tests.unit.judge.rendered import COMB, usage
from tests.unit.judge.test_archives import store_of
from tests.unit.judge.test_records import outcome, utc, verdict
from wearline.cli import main
from wearline.messages import Decision, Verdict
from wearline_judge.drivers.records import Cycle

Capture = pytest.CaptureFixture[str]


def told(capsys: Capture, *arguments: str) -> str:
    capsys.readouterr()
    assert main(["capability", *arguments]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return out


def test_repeats_in_a_file_and_a_report(tmp_path: Path, capsys: Capture) -> None:
    rng = np.random.default_rng(1)
    values = tmp_path / "v.csv"
    values.write_text("\n".join(f"{3.0 + 0.001 * r:.5f}" for r in rng.standard_normal(30)))
    limits = ("--reference", "3.0", "--tolerance", "0.2")
    out = told(capsys, "type1", "--values", str(values), *limits)
    assert "CAPABLE" in out and "Cgk" in out and "NOT" not in out
    for name, start in (("r.pdf", b"%PDF-"), ("r.html", b"<!")):
        told(capsys, "type1", "--values", str(values), *limits, "--out", str(tmp_path / name))
        assert (tmp_path / name).read_bytes().startswith(start)
    found = json.loads(
        told(capsys, "type1", "--values", str(values), "--reference", "3.1", "--tolerance", "0.2", "--json")
    )
    assert found["outcome"] == "not capable"
    assert "is missing" in usage(capsys, "capability", "type1", "--values", str(values), "--reference", "3")
    assert "has no values" in usage(capsys, "capability", "type1", *limits)
    values.write_text("1.0,x\n")
    assert "v.csv: cannot be read" in usage(capsys, "capability", "type1", "--values", str(values), *limits)
    values.write_text("1.0\n2.0\n")
    assert "2 repeats are too few" in usage(capsys, "capability", "type1", "--values", str(values), *limits)


def test_parts_and_references_in_a_file(tmp_path: Path, capsys: Capture) -> None:
    rng = np.random.default_rng(2)
    values = tmp_path / "v.csv"
    parts = rng.normal(0.0, 0.05, 25)
    values.write_text("\n".join(",".join(f"{p + 0.0005 * rng.normal():.5f}" for _ in range(2)) for p in parts))
    assert "%GRR" in told(capsys, "type3", "--values", str(values), "--tolerance", "0.2")
    values.write_text("\n".join(f"{z},{z + 0.0004},{z + 0.0006},{z + 0.0005}" for z in (0, 2, 4, 6, 8)))
    assert "bias up to" in told(capsys, "linearity", "--values", str(values), "--tolerance", "0.2")


def test_a_master_part_in_the_records(recorded: tuple[Path, Verdict], capsys: Capture) -> None:
    config, _ = recorded
    rng = np.random.default_rng(3)
    store = store_of(config)
    for stroke in range(100, 130):
        found = verdict(stroke, Decision.PASSED, 0.05 + 0.001 * float(rng.normal()))
        found = found.replace(request=found.request.replace(part_id="MASTER"))
        store.append([Cycle(found, outcome(stroke), utc(stroke))])
    store.close()
    source = ("--config", str(config), "--part", "MASTER", "--figure", "wear_mm")
    out = told(capsys, "stability", *source, "--reference", "0.05", "--tolerance", "0.2")
    assert "CAPABLE" in out and " 30 " in out
    assert "part GONE: was never measured" in usage(
        capsys,
        "capability",
        "stability",
        "--config",
        str(config),
        "--part",
        "GONE",
        "--reference",
        "0",
        "--tolerance",
        "1",
    )


def test_a_plate_at_six_positions(files: Path, tmp_path: Path, capsys: Capture) -> None:
    frames = []
    for n in range(6):
        frames.append(str(tmp_path / f"plate{n}.png"))
        cv2.imwrite(frames[-1], draw(COMB, plate(0.5 * n), 300 + n)[0])
    references = ("--calibration", str(files / "C.npz"), "--recipe", str(files / "R.yaml"))
    out = told(capsys, "flatness", *frames, *references, "--limit", "0.3")
    assert "F, worst position" in out and "  ok" in out
    assert "NOT_CAPABLE" in told(capsys, "flatness", *frames, *references, "--limit", "0.001").replace(" ", "_")
    box = ("--low", "0,0,300,480", "--high", "340,0,300,480")
    out = told(capsys, "step", *frames, *references, "--reference", "0", "--limit", "0.05", *box)
    assert "CAPABLE" in out and "NOT" not in out
    assert "--low: '1,2' is not X,Y,W,H" in usage(
        capsys, "capability", "step", *frames, *references, "--reference", "0", "--limit", "0.05", "--low", "1,2"
    )
    black = str(files / "black.png")
    assert "black.png: cannot be measured" in usage(
        capsys, "capability", "flatness", black, *references, "--limit", "1"
    )
    assert "needs frames" in usage(capsys, "capability", "flatness", "--limit", "1")
