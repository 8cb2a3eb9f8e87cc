"""Rendered frames, the references made from them, and a cell that recorded one of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from tests.metrology.renderer import Comb, draw
from wearline.cli import main
from wearline.config import CellSettings
from wearline.messages import Decision, MeasureRequest, Outcome, Verdict
from wearline.offline import Chain
from wearline.recipe import Recipe
from wearline_judge.config import JudgeSettings
from wearline_judge.drivers.fingerprint import code_version
from wearline_judge.drivers.references import StoredReferences
from wearline_judge.service import Judge, open_stores

COMB = Comb()


def image(flaw_mm: float, seed: int) -> NDArray[np.uint8]:
    """A hill that may bear a flat flake."""

    def height(across: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64]:
        z = 1.0 + 1.5 * np.exp(-0.5 * (((along - 320.0) / 110.0) ** 2 + ((across - 240.0) / 90.0) ** 2))
        flake = (np.abs(along - 200.0) < 70.0) & (np.abs(across - 250.0) < 60.0)
        return z + np.where(flake, flaw_mm, 0.0)

    return draw(COMB, height, seed)[0]


def options(folder: Path, template: bool = True) -> list[str]:
    held = ["--calibration", str(folder / "C.npz"), "--recipe", str(folder / "R.yaml")]
    return [*held, "--template", str(folder / "T.npz")] if template else held


def usage(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    capsys.readouterr()
    assert main([*arguments]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and err.startswith("wearline: ") and ";" in err
    return err


def cell_file(folder: Path) -> Path:
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump({"cell": "test", "data_dir": "run", "plc_is_simulated": True}))
    return path


def asked(stroke: int = 8) -> MeasureRequest:
    return MeasureRequest(
        cycle_id=f"c-{stroke}", is_simulated=True, object_index=1, part_id=f"P{stroke}", stroke=stroke,
        measure_number=stroke, time_left_ms=2000.0,
    )  # fmt: skip


def told(stroke: int, code: int) -> Outcome:
    request = asked(stroke)
    return Outcome(
        cycle_id=request.cycle_id, is_simulated=True, request=request, code=code, passed=code == 1, failed=code != 1,
        was_told=True, cycle_seconds=0.31, told_utc="2026-01-01T00:00:00.250+00:00",
    )  # fmt: skip


def recorded_cell(files: Path, folder: Path) -> tuple[Path, Verdict]:
    """cell.yaml of a cell that recorded a failed (c-8) and a passed part (c-9) and a camera fault (c-10)."""
    config = cell_file(folder)
    assert main(["recipe", "add", "--config", str(config), "--object", "1", "--name", "tray", *options(files)]) == 0
    settings = JudgeSettings()
    stores = open_stores(CellSettings(cell="test", data_dir=folder / "run"), settings)
    judge = Judge("test", settings, StoredReferences(stores.objects, stores.blobs), stores, version=code_version())
    chain = Chain(Recipe(mm_per_pixel=0.1), (files / "C.npz").read_bytes(), (files / "T.npz").read_bytes())
    list(judge.start(chain))
    found = []
    for stroke, flaw_mm in ((8, 0.25), (9, 0.0)):
        frame = chain.frame(image(flaw_mm, 52 + stroke), asked(stroke))
        points = chain.points_of(frame)
        list(judge.on_frame(frame))
        verdict, *_ = judge.on_line_points(points)
        assert isinstance(verdict, Verdict)
        list(judge.on_outcome(told(stroke, verdict.code)))
        found.append(verdict)
    refused = points.replace(cycle_id="c-10", request=asked(10), refusal_code=16, refusal="camera fault")
    list(judge.on_line_points(refused))
    judge.close()
    assert [v.decision for v in found] == [Decision.FAILED, Decision.PASSED]
    return config, found[0]
