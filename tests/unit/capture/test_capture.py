"""Frames for requests: from the simulated head, from a folder, and from a camera that fails."""

from __future__ import annotations

import json
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from wearline.config import CellSettings, validated
from wearline.errors import ConfigError, DeviceError
from wearline.messages import Done, Event, Exposed, Frame, MeasureRequest, Preview, ResultCode, SetCamera
from wearline.topics import MEASURE, SET_CAMERA
from wearline_capture.config import CaptureSettings
from wearline_capture.core.exposure import ExposureSettings, checked_exposure_us
from wearline_capture.core.preview import encoded_preview
from wearline_capture.drivers.camera import Shot
from wearline_capture.drivers.replay import ReplayCamera
from wearline_capture.drivers.sim import Plan, SimCamera, SimSettings, read_regrinds, rendered
from wearline_capture.service import Capture, build

HEAD: dict[str, float | int | bool | None] = {"rows": 240, "cols": 320, "lines": 5}


def request(stroke: int = 1, time_left_ms: float = 2500.0) -> MeasureRequest:
    return MeasureRequest(
        cycle_id=f"cycle-{stroke}",
        is_simulated=False,
        object_index=1,
        stroke=stroke,
        measure_number=stroke,
        time_left_ms=time_left_ms,
    )


def cell(folder: Path) -> CellSettings:
    return CellSettings(cell="one", data_dir=folder)


class Broken:
    """A camera that raises what it is given."""

    name = "broken"
    is_simulated = False

    def __init__(self, error: Exception | None) -> None:
        self.error = error
        self.is_closed = False

    def shoot(self, request: MeasureRequest, exposure_us: float, gain_db: float) -> Shot:
        if self.error is not None:
            raise self.error
        return Shot(np.full((40, 60), 7, dtype=np.uint8), exposure_us, 5)

    def figures(self) -> dict[str, float | int | str | bool | None]:
        return {}

    def close(self) -> None:
        self.is_closed = True


def test_each_stroke_gets_the_frame_of_its_part_and_its_truth_is_noted(tmp_path: Path) -> None:
    settings = CaptureSettings(seed=3, head=HEAD, exposure_us=2000.0)
    service = build(cell(tmp_path), settings)
    try:
        frames = [m for n in (40, 41) for m in service.handlers()[MEASURE](request(n)) if isinstance(m, Frame)]
    finally:
        service.close()
    assert [f.refusal_code for f in frames] == [0, 0]
    assert all(f.is_simulated and f.exposure_us == 2000.0 for f in frames)
    assert [f.frame_counter for f in frames] == [1, 2]
    camera = SimCamera(settings, tmp_path / "other", 2000.0, 0.0)
    camera.close()
    expected = rendered(camera.head, Plan(41, (), 2000.0, 0.0), 3, settings.vibration_px)
    np.testing.assert_array_equal(frames[1].pixels, expected.pixels)
    noted = [json.loads(line) for line in (tmp_path / "capture" / "truth.jsonl").read_text().splitlines()]
    assert [n["cycle_id"] for n in noted] == ["cycle-40", "cycle-41"]
    assert noted[1]["wear_mm"] == expected.wear_mm and noted[1]["true_mean_mm"] == expected.true_mean_mm
    assert set(noted[0]) == {"cycle_id", "stroke", "wear_mm", "true_mean_mm", "true_max_mm"}


def test_the_next_stroke_is_rendered_ahead_and_another_one_on_demand(tmp_path: Path) -> None:
    settings = SimSettings(head=HEAD)
    camera = SimCamera(settings, tmp_path, 1000.0, 0.0)
    try:
        assert camera.wait_ahead(20.0) == 1
        camera.shoot(request(1), 1000.0, 0.0)
        assert camera.wait_ahead(20.0) == 2
        assert camera.figures()["frames_rendered_late"] == 0
        (tmp_path / "die.json").write_text('{"regrinds": [2]}')
        shot = camera.shoot(request(2), 1000.0, 0.0)
        assert camera.figures()["frames_rendered_late"] == 1
        expected = rendered(camera.head, Plan(2, (2,), 1000.0, 0.0), settings.seed, settings.vibration_px)
        np.testing.assert_array_equal(shot.pixels, expected.pixels)
        assert expected.wear_mm == 0.0
    finally:
        camera.close()
    again = SimCamera(settings, tmp_path, 1000.0, 0.0)
    try:
        assert again.wait_ahead(20.0) == 3, "a restarted camera goes on where the last one stopped"
    finally:
        again.close()


def test_the_exposure_takes_its_time_and_closing_ends_it(tmp_path: Path) -> None:
    camera = SimCamera(SimSettings(head=HEAD), tmp_path, 50_000.0, 0.0)
    camera.wait_ahead(20.0)
    began = time.monotonic()
    camera.shoot(request(1), 50_000.0, 0.0)
    assert time.monotonic() - began >= 0.05
    camera.close()
    with pytest.raises(DeviceError, match="closed"):
        camera.shoot(request(2), 50_000.0, 0.0)


@pytest.mark.parametrize("text", ["[", '{"regrinds": "x"}', "{}"])
def test_a_broken_die_file_is_a_camera_fault(tmp_path: Path, text: str) -> None:
    (tmp_path / "die.json").write_text(text)
    with pytest.raises(DeviceError, match=r"die\.json"):
        read_regrinds(tmp_path / "die.json")
    assert read_regrinds(tmp_path / "none.json") == ()


@pytest.mark.parametrize(
    ("error", "code"),
    [(DeviceError("no answer", "cam"), ResultCode.CAMERA), (RuntimeError("boom"), ResultCode.CAMERA)],
)
def test_a_camera_fault_is_told_at_once_and_forgotten_when_it_is_gone(error: Exception, code: ResultCode) -> None:
    camera = Broken(error)
    service = Capture("one", CaptureSettings(), camera)
    frame, _, event = list(service.on_measure(request(9)))
    assert isinstance(frame, Frame) and isinstance(event, Event)
    assert (frame.refusal_code, frame.pixels.shape, frame.cycle_id) == (code, (0, 0), "cycle-9")
    assert str(error) in frame.refusal and event.cycle_id == "cycle-9"
    assert service.health().status == "degraded"
    assert list(service.tick(0.0)) == []
    camera.error = None
    good, exposed = service.on_measure(request(10))
    assert isinstance(exposed, Exposed) and exposed.cycle_id == "cycle-10"
    assert isinstance(good, Frame) and good.refusal_code == 0 and not good.is_simulated and good.frame_counter == 5
    assert service.health().status == "ready"
    service.close()
    assert camera.is_closed


def test_no_frame_is_begun_that_cannot_be_ready_in_time() -> None:
    service = Capture("one", CaptureSettings(exposure_us=10_000.0), Broken(None))
    for left in (9.0, 10.0, -5.0, float("nan")):
        frame = next(service.on_measure(request(1, time_left_ms=left)))
        assert isinstance(frame, Frame) and frame.refusal_code == ResultCode.NO_FRAME


def test_preview_is_a_small_jpeg_of_the_last_frame() -> None:
    service = Capture("one", CaptureSettings(preview_step=2), Broken(None))
    assert list(service.tick(0.0)) == []
    list(service.on_measure(request(1)))
    (first,) = service.tick(1.0)
    (again,) = service.tick(2.0)
    assert isinstance(first, Preview) and again is first
    assert first.step_px == 2.0
    picture = cv2.imdecode(np.array(first.jpeg), cv2.IMREAD_UNCHANGED)
    assert picture is not None and picture.shape == (20, 30) and abs(float(picture.mean()) - 7.0) < 2.0
    with pytest.raises(ValueError, match="pixels"):
        encoded_preview(np.zeros((0, 0), dtype=np.uint8), 2, 80)


def test_exposure_and_gain_can_be_set_within_the_cameras_range() -> None:
    service = Capture("one", CaptureSettings(), Broken(None))
    set_camera = service.answers()[SET_CAMERA]
    answer = set_camera(SetCamera(exposure_us=5000.0))
    assert isinstance(answer, Done) and answer.ok
    assert next(iter(service.on_measure(request(1)))).exposure_us == 5000.0  # type: ignore[attr-defined]
    for wrong in (SetCamera(exposure_us=1.0), SetCamera(gain_db=30.0), SetCamera(gain_db=-1.0)):
        refused = set_camera(wrong)
        assert isinstance(refused, Done) and not refused.ok and "outside" in refused.text
    assert service.health().values["exposure_us"] == 5000.0
    with pytest.raises(ValueError, match="outside"):
        checked_exposure_us(ExposureSettings(), 1e9)


def test_replay_goes_through_the_folder_in_order(tmp_path: Path) -> None:
    for number in (10, 9, 1):
        cv2.imwrite(str(tmp_path / f"frame_{number}.png"), np.full((30, 40), number, dtype=np.uint8))
    (tmp_path / "frame_11.png").write_bytes(b"no picture")
    (tmp_path / "notes.txt").write_text("not an image")
    settings = CaptureSettings(kind="replay", folder=tmp_path, exposure_us=100.0, loop=False)
    service = build(cell(tmp_path), settings)
    frames = [next(iter(service.handlers()[MEASURE](request(n)))) for n in range(1, 6)]
    assert all(isinstance(f, Frame) and f.is_simulated for f in frames)
    assert [f.pixels[0, 0] for f in frames[:3]] == [1, 9, 10]  # type: ignore[attr-defined]
    codes = [f.refusal_code for f in frames]  # type: ignore[attr-defined]
    assert codes == [0, 0, 0, ResultCode.BAD_FRAME, ResultCode.NO_FRAME]
    looping = ReplayCamera(tmp_path, loop=True)
    looping.close()
    with pytest.raises(DeviceError):
        looping.shoot(request(1), 1000.0, 0.0)


def test_settings_that_cannot_be_obeyed_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="folder"):
        build(cell(tmp_path), CaptureSettings(kind="replay"))
    with pytest.raises(ConfigError, match="no folder"):
        build(cell(tmp_path), CaptureSettings(kind="replay", folder=tmp_path / "none"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="no image"):
        build(cell(tmp_path), CaptureSettings(kind="replay", folder=tmp_path / "empty"))
    with pytest.raises(ConfigError, match="exposure"):
        build(cell(tmp_path), CaptureSettings(exposure_us=1e9))
    with pytest.raises(ConfigError, match="colour"):
        validated(CaptureSettings, {"head": {"colour": 1}}, "cell.yaml")
