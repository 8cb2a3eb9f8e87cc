"""The service and its subcommands: what goes in, what comes out, and every refusal."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.metrology.chains import comb_calibration
from tests.metrology.renderer import Comb, draw, plate
from wearline.artifact import Calibration, content_hash
from wearline.cli import main
from wearline.errors import BusError, FrameError
from wearline.messages import Artifact, Event, Frame, LinePoints, Message, ObjectRecipe, ResultCode
from wearline.offline import Chain
from wearline.recipe import Recipe, dump_recipe, recipe_hash
from wearline.topics import ARTIFACT, FRAME, RECIPE, Query
from wearline_reconstruct.config import ReconstructSettings
from wearline_reconstruct.drivers.artifact_cache import ArtifactCache
from wearline_reconstruct.service import Reconstruct

COMB = Comb()
PLATES = (0.0, 0.0, 3.0, 3.0, 6.0, 6.0)


class Judge:
    """Answers as judge does, and counts what it was asked."""

    def __init__(self, calibration: bytes, recipe: Recipe | None = None, template_hash: str = "") -> None:
        self.recipe = recipe or Recipe()
        self.artifacts = {content_hash(calibration): calibration}
        self.calibration_hash = content_hash(calibration)
        self.template_hash = template_hash
        self.asked: list[str] = []
        self.fault: BusError | None = None

    def ask(self, query: Query, question: Message, argument: str = "", timeout_s: float = 1.0) -> Message:
        self.asked.append(query.name)
        if self.fault is not None:
            raise self.fault
        if query == RECIPE:
            if argument != "1":
                raise BusError(f"object {argument} is not in the object list")
            return ObjectRecipe(
                object_index=1, object_name="part", recipe_yaml=dump_recipe(self.recipe),
                recipe_hash=recipe_hash(self.recipe), calibration_hash=self.calibration_hash,
                template_hash=self.template_hash, version=1,
            )  # fmt: skip
        if query == ARTIFACT and argument in self.artifacts:
            return Artifact(content_hash=argument, content=np.frombuffer(self.artifacts[argument], np.uint8))
        raise BusError("there is no such artifact")


@pytest.fixture(scope="module")
def calibration() -> bytes:
    return comb_calibration(COMB, PLATES).to_bytes()


@pytest.fixture(scope="module")
def frame() -> Frame:
    return Chain().frame(draw(COMB, plate(2.0), 70)[0])


def service(judge: Judge, folder: Path | None = None) -> Reconstruct:
    made = Reconstruct("test", ReconstructSettings(), ArtifactCache(folder))
    list(made.start(judge))
    return made


def answer(made: Reconstruct, frame: Frame) -> LinePoints:
    said = list(made.on_frame(frame))
    assert isinstance(said[0], LinePoints)
    assert len(said) == (2 if said[0].refusal_code else 1)
    assert all(isinstance(message, Event) for message in said[1:])
    return said[0]


def test_a_frame_becomes_line_points(calibration: bytes, frame: Frame) -> None:
    judge = Judge(calibration)
    found = answer(service(judge), frame)
    assert found.refusal_code == 0
    assert found.request == frame.request and found.cycle_id == frame.cycle_id
    assert found.points.shape[1] == 5
    assert float(np.median(found.points[:, 3])) == pytest.approx(2.0, abs=0.02)
    assert found.coverage > 0.97
    assert found.calibration_hash == judge.calibration_hash
    assert found.recipe_hash == recipe_hash(judge.recipe)
    assert found.timings_ms["total"] > 0.0
    assert len(found.frame_hash) == 64


def test_references_are_asked_for_once_and_the_recipe_every_cycle(
    calibration: bytes, frame: Frame, tmp_path: Path
) -> None:
    judge = Judge(calibration)
    made = service(judge, tmp_path)
    answer(made, frame)
    answer(made, frame)
    assert judge.asked == [RECIPE.name, ARTIFACT.name, RECIPE.name]
    again = Judge(calibration)
    answer(service(again, tmp_path), frame)
    assert again.asked == [RECIPE.name]


def test_a_damaged_copy_on_disk_is_asked_for_again(calibration: bytes, frame: Frame, tmp_path: Path) -> None:
    judge = Judge(calibration)
    answer(service(judge, tmp_path), frame)
    (tmp_path / judge.calibration_hash).write_bytes(calibration[:100])
    again = Judge(calibration)
    assert answer(service(again, tmp_path), frame).refusal_code == 0
    assert ARTIFACT.name in again.asked


def test_a_new_recipe_takes_effect_at_once(calibration: bytes, frame: Frame) -> None:
    judge = Judge(calibration)
    made = service(judge)
    whole = answer(made, frame)
    judge.recipe = Recipe(roi=(100, 100, 200, 200))
    part = answer(made, frame)
    assert len(part.points) < len(whole.points)
    assert part.recipe_hash == recipe_hash(judge.recipe) != whole.recipe_hash


def test_refusals_carry_their_code(calibration: bytes, frame: Frame) -> None:
    def refused(judge: Judge, given: Frame = frame) -> int:
        found = answer(service(judge), given)
        assert found.points.shape == (0, 5)
        assert found.refusal and found.request == given.request
        return found.refusal_code

    other = frame.replace(request=frame.request.replace(object_index=7))
    assert refused(Judge(calibration), other) == ResultCode.UNKNOWN_OBJECT
    assert refused(Judge(b"no archive")) == ResultCode.NO_CALIBRATION
    nothing = Judge(calibration)
    nothing.calibration_hash = ""
    assert refused(nothing) == ResultCode.NO_CALIBRATION
    assert refused(Judge(calibration, template_hash="0" * 64)) == ResultCode.NO_TEMPLATE
    silent = Judge(calibration)
    silent.fault = BusError("nobody answers", "wearline/cell/judge/recipe/1", "is judge running?")
    assert refused(silent) == ResultCode.SERVICE_LOST
    black = frame.replace(pixels=np.zeros((480, 640), np.uint8))
    assert refused(Judge(calibration), black) == ResultCode.BAD_FRAME
    vertical = Judge(calibration, Recipe(orientation="vertical"))
    assert refused(vertical) == ResultCode.NO_CALIBRATION


def test_a_refusal_of_capture_is_passed_on(calibration: bytes) -> None:
    judge = Judge(calibration)
    broken = Chain().frame(FrameError("camera gone", code=int(ResultCode.CAMERA)))
    found = answer(service(judge), broken)
    assert (found.refusal_code, found.refusal) == (ResultCode.CAMERA, "camera gone")
    assert judge.asked == []


def test_a_fault_of_our_own_reaches_the_plc_as_a_refusal(
    calibration: bytes, frame: Frame, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("bug")

    monkeypatch.setattr("wearline_reconstruct.service.reconstruct", broken)
    found = answer(service(Judge(calibration)), frame)
    assert found.refusal_code == ResultCode.BAD_FRAME
    assert "ZeroDivisionError" in found.refusal


def test_offline_is_the_same_handler(calibration: bytes, frame: Frame) -> None:
    chain = Chain(None, calibration)
    found = chain.points_of(frame)
    assert np.array_equal(found.points, answer(service(Judge(calibration)), frame).points)
    assert FRAME in chain.service("reconstruct").handlers()
    chain.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("pictures")
    for k, z in enumerate((0.0, 3.0, 6.0)):
        cv2.imwrite(str(made / f"P{z:g}.png"), draw(COMB, plate(z), 80 + k)[0])
    cv2.imwrite(str(made / "part.png"), draw(COMB, plate(2.0), 90)[0])
    cv2.imwrite(str(made / "black.png"), np.zeros((480, 640), np.uint8))
    colour = np.repeat(draw(COMB, plate(2.0), 91)[0][:, :, None], 3, axis=2)
    cv2.imwrite(str(made / "colour.png"), colour)
    cv2.imwrite(str(made / "deep.png"), draw(COMB, plate(2.0), 92)[0].astype(np.uint16) * 16)
    vertical = replace(COMB, is_vertical=True)
    cv2.imwrite(str(made / "upright.png"), draw(vertical, plate(2.0), 93)[0])
    (made / "text.png").write_text("no picture")
    (made / "cut.png").write_bytes((made / "part.png").read_bytes()[:5000])
    planes = [f"--plane={z:g}={made / f'P{z:g}.png'}" for z in (0.0, 3.0, 6.0)]
    assert main(["calibrate", *planes, "--lines", "11", "--mm-per-pixel", "0.1", "--out", str(made / "C.npz")]) == 0
    return made


def test_calibrate_writes_a_calibration(folder: Path) -> None:
    made = Calibration.load(folder / "C.npz")
    assert made.lines == 11
    assert made.mm_per_pixel == pytest.approx(0.1)
    assert [shot["z_mm"] for shot in made.meta["shots"]] == [0.0, 3.0, 6.0]


def test_reconstruct_writes_what_is_promised(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = [str(folder / name) for name in ("black.png", "text.png", "cut.png", "colour.png", "deep.png", "missing.png")]
    code = main(
        ["reconstruct", *bad, str(folder / "part.png"), "--calibration", str(folder / "C.npz"), "--out", str(tmp_path)]
    )
    assert code == 0
    assert [p.name for p in tmp_path.iterdir()] == ["part.npz"]
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(bad)
    assert all(name in line for name, line in zip(bad, lines, strict=True))
    with np.load(tmp_path / "part.npz") as found:
        n = len(found["line"])
        assert found["line"].dtype == np.int16
        for name in ("row_px", "col_px", "z_mm", "sigma_mm"):
            assert found[name].dtype == np.float32 and found[name].shape == (n,)
        assert np.array_equal(found["col_px"], np.rint(found["col_px"]))
        places = set(zip(found["line"].tolist(), found["col_px"].tolist(), strict=True))
        assert len(places) == n
        assert found["z_map_mm"].shape == found["sigma_map_mm"].shape == (480, 640)
        assert found["roi"].dtype == np.int32 and found["roi"].tolist() == [0, 0, 640, 480]
        assert found["sigma_frame_mm"].shape == ()
        assert float(found["sigma_mm"].min()) >= 0.9 * float(found["sigma_frame_mm"])
        assert json.loads(str(found["timings_ms"]))["total"] > 0.0
        assert float(np.nanmedian(found["z_map_mm"])) == pytest.approx(2.0, abs=0.02)


def test_a_vertical_head_needs_no_recipe(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    upright = replace(COMB, is_vertical=True)
    planes = []
    for k, z in enumerate((0.0, 3.0, 6.0)):
        cv2.imwrite(str(tmp_path / f"V{k}.png"), draw(upright, plate(z), 94 + k)[0])
        planes.append(f"--plane={z:g}={tmp_path / f'V{k}.png'}")
    out = ["--out", str(tmp_path / "V.npz")]
    assert main(["calibrate", *planes, "--lines", "11", "--orientation", "vertical", *out]) == 0
    assert main(["reconstruct", str(folder / "upright.png"), "--calibration", *out[1:], "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().err == ""
    with np.load(tmp_path / "upright.npz") as found:
        assert float(np.median(found["z_mm"])) == pytest.approx(2.0, abs=0.02)
        assert np.array_equal(found["row_px"], np.rint(found["row_px"]))
        assert found["z_map_mm"].shape == (640, 480)


def test_stripes_only_takes_any_picture(folder: Path, tmp_path: Path) -> None:
    names = ["part.png", "colour.png", "deep.png"]
    assert main(["reconstruct", *[str(folder / n) for n in names], "--stripes-only", "--out", str(tmp_path)]) == 0
    upright = [str(folder / "upright.png"), "--stripes-only", "--orientation", "vertical", "--out", str(tmp_path)]
    assert main(["reconstruct", *upright]) == 0
    for stem in ("part", "colour", "deep", "upright"):
        with np.load(tmp_path / f"{stem}.npz") as found:
            assert set(found.files) == {"row_px", "col_px", "sigma_px", "stripe"}
            assert len(np.unique(found["stripe"])) >= 11
            whole = found["row_px"] if stem == "upright" else found["col_px"]
            assert np.array_equal(whole, np.rint(whole))
        assert cv2.imread(str(tmp_path / f"{stem}_stripes.png")) is not None


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["reconstruct", "--out", "o"], "no frame"),
        (["reconstruct", "a/x.png", "b/x.png", "--calibration", "C.npz", "--out", "o"], "both"),
        (["reconstruct", "part.png", "--out", "o"], "--calibration"),
        (["reconstruct", "part.png", "--calibration", "nowhere.npz", "--out", "o"], "nowhere.npz"),
        (["reconstruct", "part.png", "--calibration", "text.png", "--out", "o"], "text.png"),
        (["reconstruct", "part.png", "--calibration", "C.npz", "--recipe", "none.yaml", "--out", "o"], "none.yaml"),
        (["reconstruct", "part.png", "--calibration", "C.npz", "--out", "text.png"], "text.png"),
        (["calibrate", "--plane", "0=P0.png", "--lines", "11", "--out", "D.npz"], "two heights"),
        (["calibrate", "--plane", "zero=P0.png", "--out", "D.npz"], "HEIGHT=FILE"),
        (["calibrate", "--plane", "0=P0.png", "--plane", "3=cut.png", "--lines", "11", "--out", "D.npz"], "truncated"),
        (
            ["calibrate", "--plane", "0=P3.png", "--plane", "3=P0.png", "--plane", "6=P6.png",
                "--lines", "11", "--out", "D.npz"],
            "swapped",
        ),
        (["calibrate", "--plane", "0=P0.png", "--plane", "3=P3.png", "--lines", "25", "--out", "D.npz"], "--lines"),
        (
            ["calibrate", "--plane", "0=P0.png", "--plane", "3=P3.png", "--orientation", "vertical", "--out", "D.npz"],
            "",
        ),
        (
            ["calibrate", "--plane", "0=P0.png", "--plane", "3=P3.png",
                "--lines", "11", "--target", "part.png", "--out", "D.npz"],
            "square",
        ),
    ],
)  # fmt: skip
def test_unusable_options_give_one_line_and_exit_2(
    options: list[str], word: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    assert main(options) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert word in lines[0]
    assert not (folder / "D.npz").exists()


def test_lateral_scale_comes_from_a_target(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "board.png"), drawn_target("chessboard"))
    planes = [f"--plane={z:g}={folder / f'P{z:g}.png'}" for z in (0.0, 3.0, 6.0)]
    target = ["--target", str(tmp_path / "board.png"), "--square-mm", "5", "--report", str(tmp_path / "report.txt")]
    assert main(["calibrate", *planes, "--lines", "11", *target, "--out", str(tmp_path / "C.npz")]) == 0
    assert Calibration.load(tmp_path / "C.npz").mm_per_pixel == pytest.approx(FIELD_MM / 40.0, rel=0.001)
    report = (tmp_path / "report.txt").read_text()
    assert report in capsys.readouterr().out
    for word in ("chessboard, 11 x 7 corners", "off what the other planes predict", "accepted"):
        assert word in report
    frame = [str(folder / "part.png"), "--calibration", str(tmp_path / "C.npz"), "--out", str(tmp_path)]
    assert main(["reconstruct", *frame]) == 0
    with np.load(tmp_path / "part.npz") as found:
        step = np.polyfit(found["col_px"], found["x_mm"], 1)
        # Points 2 mm above the datum lie nearer, so that a pixel covers less.
        assert float(step[0]) == pytest.approx(FIELD_MM / 40.0, rel=0.01)
        assert float(np.median(found["x_mm"])) == pytest.approx(0.0, abs=0.5)


def test_a_target_of_another_camera_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planes = [f"--plane={z:g}={folder / f'P{z:g}.png'}" for z in (0.0, 3.0, 6.0)]
    for name, picture, word in (
        ("small.png", drawn_target("dots")[:400], "400"),
        ("blank.png", np.full((480, 640), 90, np.uint8), "chessboard"),
    ):
        cv2.imwrite(str(tmp_path / name), picture)
        target = ["--target", str(tmp_path / name), "--square-mm", "5"]
        assert main(["calibrate", *planes, "--lines", "11", *target, "--out", str(tmp_path / "D.npz")]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1 and word in lines[0] and name in lines[0]
    assert not (tmp_path / "D.npz").exists()


def test_a_height_may_be_negative(folder: Path, tmp_path: Path) -> None:
    planes = [
        word
        for z, name in ((-3.0, "P0"), (0.0, "P3"), (3.0, "P6"))
        for word in ("--plane", f"{z:g}={folder / name}.png")
    ]
    assert main(["calibrate", *planes, "--lines", "11", "--out", str(tmp_path / "C.npz")]) == 0
    assert Calibration.load(tmp_path / "C.npz").meta["planes_mm"] == [-3.0, 0.0, 3.0]


FIELD_MM = 5.0


def drawn_target(kind: str, size: tuple[int, int] = (480, 640), field_px: float = 40.0) -> np.ndarray:
    """A target square on, 12 x 8 fields of ``field_px``, with a bright rim."""
    y, x = (np.mgrid[0 : size[0] * 4, 0 : size[1] * 4] + 0.5) / 4.0 - 0.5
    u, v = (x - 80.0) / field_px, (y - 80.0) / field_px
    inside = (u > 0) & (u < 12) & (v > 0) & (v < 8)
    if kind == "chessboard":
        bright = (np.floor(u) + np.floor(v)) % 2 == 0
    else:
        bright = np.hypot(u % 1.0 - 0.5, v % 1.0 - 0.5) > 0.25
    fine = np.where(bright | ~inside, 220.0, 40.0).astype(np.float32)
    return np.asarray(
        cv2.GaussianBlur(cv2.resize(fine, size[::-1], interpolation=cv2.INTER_AREA), (5, 5), 1.0), np.uint8
    )
