"""``template``, ``judge``, ``recipe`` and ``replay`` on rendered frames and on files that are none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import pytest

from tests.unit.judge.rendered import cell_file, image, options, usage
from wearline.artifact import Calibration, Template
from wearline.cli import main
from wearline.messages import Decision, ResultCode, Verdict
from wearline_judge.commands.replay import differences

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

KEYS = {
    "frame", "decision", "reason", "code", "mean_error_mm", "max_error_mm", "wear_mm", "deviating_area_mm2",
    "deviating_area_px", "coverage", "regions", "zones", "registration", "timings_ms",
}  # fmt: skip


def lines(capsys: pytest.CaptureFixture[str], *arguments: str) -> list[dict[str, Any]]:
    capsys.readouterr()
    assert main(["judge", *arguments, "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == "" and "NaN" not in out and "Infinity" not in out
    return [json.loads(line) for line in out.splitlines()]


def test_frames_are_judged_in_the_order_given(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = [str(files / name) for name in ("bad.png", "good.png", "bad.png")]
    found = lines(capsys, *frames, *options(files))
    assert [f["frame"] for f in found] == frames
    assert [f["decision"] for f in found] == ["FAILED", "PASSED", "FAILED"]
    assert [f["code"] for f in found] == [2, 1, 2]
    assert all(set(f) == KEYS for f in found)
    bad, good, _ = found
    assert bad["mean_error_mm"] == pytest.approx(0.25, abs=0.03) and 0.2 < bad["max_error_mm"] < 0.4
    assert bad["deviating_area_mm2"] == pytest.approx(168.0, rel=0.2)
    assert bad["deviating_area_px"] == pytest.approx(16800, rel=0.2)
    assert good["mean_error_mm"] == 0.0 and good["wear_mm"] == 0.0 and good["coverage"] > 0.95
    assert set(good["registration"]) == {
        "dz_mm", "tilt_x_mrad", "tilt_y_mrad", "dx_mm", "dy_mm", "turn_mrad", "undetermined", "datum",
    }  # fmt: skip
    assert set(good["timings_ms"]) == {"decode", "reconstruct", "judge", "total"}
    assert good["timings_ms"]["total"] == pytest.approx(
        good["timings_ms"]["reconstruct"] + good["timings_ms"]["judge"], abs=0.01
    )


def test_a_file_that_is_no_frame_is_not_measured_and_the_run_goes_on(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hopeless = ["cut", "black", "white", "small", "text", "deep", "colour", "absent"]
    found = lines(capsys, *(str(files / f"{name}.png") for name in hopeless), str(files / "good.png"), *options(files))
    assert [f["decision"] for f in found] == ["NOT_MEASURED"] * len(hopeless) + ["PASSED"]
    for told in found[:-1]:
        assert 10 <= told["code"] <= 99 and told["reason"] and set(told) == KEYS
        assert told["mean_error_mm"] is None and told["max_error_mm"] is None and told["wear_mm"] is None
        assert told["deviating_area_px"] is None and told["coverage"] == 0.0


def test_a_line_for_people(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["judge", str(files / "bad.png"), *options(files)]) == 0
    assert "FAILED, mean error 0.2" in capsys.readouterr().out


def test_what_is_wrong_with_the_references_ends_the_run(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frame, calibration, template = str(files / "good.png"), str(files / "C.npz"), str(files / "T.npz")
    broken = tmp_path / "broken.npz"
    broken.write_bytes((files / "C.npz").read_bytes()[:500])
    recipe = tmp_path / "recipe.yaml"

    def judge(*arguments: str) -> str:
        return usage(capsys, "judge", frame, *arguments)

    assert "--calibration: is missing" in judge("--template", template)
    assert "--template: is missing" in judge("--calibration", calibration)
    assert "no frame was named" in usage(capsys, "judge", "--calibration", calibration, "--template", template)
    assert "broken.npz" in judge("--calibration", str(broken), "--template", template)
    assert "broken.npz" in judge("--calibration", calibration, "--template", str(broken))
    assert "absent.npz" in judge("--calibration", str(tmp_path / "absent.npz"), "--template", template)
    assert "wearline template" in judge("--calibration", calibration, "--template", str(tmp_path / "absent.npz"))
    assert "T.npz" in judge("--calibration", template, "--template", template)
    both = ("--calibration", calibration, "--template", template)
    for text, said in (
        ("precision_mm: -1\n", "precision_mm"), ("surprise: 1\n", "surprise"), ("roi: [9000, 0, 10, 10]\n", "roi"),
        ("orientation: vertical\n", "orientation"), ("[1, 2]\n", "mapping"), ("a: [\n", "YAML"),
    ):  # fmt: skip
        recipe.write_text(text)
        assert said in judge(*both, "--recipe", str(recipe))
    assert "absent.yaml" in judge(*both, "--recipe", str(tmp_path / "absent.yaml"))
    assert "--surprise" in judge(*both, "--surprise")


def test_a_template_of_another_calibration_is_refused(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = Calibration.load(files / "C.npz")
    Calibration(**{**other.__dict__, "meta": {**other.meta, "note": "another"}}).save(tmp_path / "C2.npz")
    said = usage(capsys, "judge", str(files / "good.png"), "--calibration", str(tmp_path / "C2.npz"), "--template",
                 str(files / "T.npz"))  # fmt: skip
    assert "T.npz: was not made with" in said


def test_a_template_is_refused_for_a_frame_that_does_not_fit(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = [str(files / f"g{n}.png") for n in range(3)]
    out = ("--out", str(tmp_path / "T.npz"))

    def template(*frames: str) -> str:
        return usage(capsys, "template", *frames, *options(files, template=False), *out)

    assert "bad.png: is suspicious: it deviates" in template(*good, str(files / "bad.png"))
    assert "cut.png: is truncated" in template(good[0], str(files / "cut.png"))
    assert "black.png: " in template(good[0], str(files / "black.png"))
    assert "no frame was named" in template()
    assert "lies in no folder" in usage(capsys, "template", *good, *options(files, template=False), "--out",
                                        str(tmp_path / "a" / "T.npz"))  # fmt: skip
    assert not (tmp_path / "T.npz").exists()


def test_a_template_says_what_it_is_made_of(files: Path) -> None:
    held = Template.load(files / "T.npz")
    assert held.frames == 4 and len(held.meta["samples"]) == 4 and held.meta["mm_per_pixel"] == 0.1
    assert float((held.line_coverage >= 0.5).mean()) > 0.9


def test_the_object_list_is_managed_from_a_terminal(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = ("--config", str(cell_file(tmp_path)))
    one = ("--object", "1")
    assert main(["recipe", "list", *config]) == 0
    assert main(["recipe", "add", *config, *one, "--name", "tray", *options(files)]) == 0
    assert (
        main(["recipe", "add", *config, *one, "--calibration", str(files / "C.npz"), "--draft", "--note", "new"]) == 0
    )
    assert "is a draft" in capsys.readouterr().out
    assert main(["recipe", "release", *config, *one, "--version", "2"]) == 0
    assert main(["recipe", "list", *config]) == 0
    assert "(to be taught)" in capsys.readouterr().out
    assert main(["recipe", "rollback", *config, *one]) == 0
    assert main(["recipe", "show", *config, *one]) == 0
    shown = capsys.readouterr().out
    assert "* version 1" in shown and "mm_per_pixel: 0.1" in shown and ": new" in shown
    assert "no more than once" in usage(capsys, "recipe", "rollback", *config, *one)
    assert "version 9" in usage(capsys, "recipe", "release", *config, *one, "--version", "9")
    assert "object 2" in usage(capsys, "recipe", "show", *config, "--object", "2")
    assert "--object" in usage(capsys, "recipe", "add", *config, "--name", "x", *options(files))
    assert "70000" in usage(capsys, "recipe", "show", *config, "--object", "70000")
    assert "--name" in usage(capsys, "recipe", "add", *config, "--object", "2", *options(files))


def test_a_recorded_verdict_is_computed_again_bit_for_bit(
    recorded: tuple[Path, Verdict], capsys: pytest.CaptureFixture[str]
) -> None:
    config, _ = recorded
    capsys.readouterr()
    assert main(["replay", "c-8", "--config", str(config)]) == 0
    out = capsys.readouterr().out
    assert "recorded FAILED, computed FAILED" in out and "equal bit for bit" in out


def test_replay_tells_a_verdict_that_does_not_follow_from_its_frame(
    recorded: tuple[Path, Verdict], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config, verdict = recorded

    def record(changed: Verdict) -> tuple[int, str]:
        monkeypatch.setattr("wearline_judge.drivers.records.RecordStore.verdict", lambda *_: changed)
        code = main(["replay", "c-8", "--config", str(config)])
        return code, capsys.readouterr().out

    assert verdict.mean_error_mm is not None
    slightly = verdict.replace(mean_error_mm=verdict.mean_error_mm + 1e-5)
    assert record(slightly) == (1, record(slightly)[1]) and "NOT bit for bit" in record(slightly)[1]
    code, out = record(slightly.replace(code_version="another"))
    assert code == 0 and "equal after rounding to 1 um" in out and "recorded with another" in out
    code, out = record(verdict.replace(mean_error_mm=verdict.mean_error_mm + 0.01, code_version="another"))
    assert code == 1 and "mean_error_mm: recorded" in out
    code, out = record(verdict.replace(decision=Decision.PASSED, code=1))
    assert code == 1 and "recorded PASSED, computed FAILED" in out


def test_replay_refuses_what_cannot_be_computed(
    recorded: tuple[Path, Verdict], capsys: pytest.CaptureFixture[str]
) -> None:
    config, verdict = recorded
    assert "has no record" in usage(capsys, "replay", "c-77", "--config", str(config))
    assert "camera fault" in usage(capsys, "replay", "c-10", "--config", str(config))
    (stored,) = (config.parent / "run" / "judge" / "frames").glob(f"failed/*/{verdict.frame_hash}.png")
    cv2.imwrite(str(stored), image(0.25, 61))
    assert "was altered" in usage(capsys, "replay", "c-8", "--config", str(config))
    stored.unlink()
    assert "not stored" in usage(capsys, "replay", "c-8", "--config", str(config))


def test_differences_name_the_place() -> None:
    old = {"a": [1.0, {"b": 2.0}], "c": "x", "code": int(ResultCode.PASSED)}
    assert differences(old, {**old, "a": [1.0004, {"b": 2.0}]}, 3) == []
    assert differences(old, {**old, "a": [1.0004, {"b": 2.0}]}, None) == ["a[0]: recorded 1.0, computed 1.0004"]
    assert differences(old, {**old, "a": [1.0, {"b": 2.1}], "c": "y"}, 3) == [
        "a[1].b: recorded 2.0, computed 2.1", "c: recorded x, computed y",
    ]  # fmt: skip
    assert differences(old, {"a": [1.0], "c": "x"}, 3) != []
