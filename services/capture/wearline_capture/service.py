"""Measure requests in, frames out; a preview for the eye beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline.config import CellSettings
from wearline.errors import ConfigError, DeviceError, FrameError
from wearline.messages import Done, Event, Exposed, Frame, MeasureRequest, Message, Preview, ResultCode, SetCamera
from wearline.metrics import counter
from wearline.service import Health, Service
from wearline.topics import MEASURE, SET_CAMERA, Query, Topic
from wearline_capture.config import CaptureSettings
from wearline_capture.core.exposure import check_time_left, checked_exposure_us, checked_gain_db
from wearline_capture.core.preview import encoded_preview
from wearline_capture.drivers.camera import Camera
from wearline_capture.drivers.replay import ReplayCamera
from wearline_capture.drivers.sim import SimCamera

FRAMES = counter("wearline_frames_total", "Frames asked for, and how that went", ("cell", "result"))


class Capture(Service):
    """Holds the camera."""

    name: ClassVar[str] = "capture"

    def __init__(self, cell: str, settings: CaptureSettings, camera: Camera) -> None:
        self.tick_s = 1.0 / settings.preview_hz
        self._cell = cell
        self._settings = settings
        self._camera = camera
        self._camera_name = settings.camera or camera.name
        self._exposure_us = settings.exposure_us
        self._gain_db = settings.gain_db
        self._shown: NDArray[np.uint8] | None = None
        self._preview: Preview | None = None
        self._counter = 0
        self._taken = 0
        self._refused = 0
        self._fault = ""

    def handlers(self) -> Mapping[Topic, Callable[[Any], Iterable[Message]]]:
        return {MEASURE: self.on_measure}

    def answers(self) -> Mapping[Query, Callable[[Any], Message]]:
        return {SET_CAMERA: self.on_set_camera}

    def on_measure(self, request: MeasureRequest) -> Iterator[Message]:
        """One Frame per request: the image, or the reason why there is none."""
        try:
            check_time_left(self._exposure_us, request.time_left_ms)
            shot = self._camera.shoot(request, self._exposure_us, self._gain_db)
            self._counter = shot.counter
            frame = self._framed(request, shot.pixels)
        except FrameError as error:
            frame = self._refusal(request, error.code, str(error))
        except DeviceError as error:
            frame = self._refusal(request, int(ResultCode.CAMERA), str(error))
        except Exception as error:
            # A driver's own fault must reach the PLC at once too, not when the deadline has passed.
            frame = self._refusal(request, int(ResultCode.CAMERA), f"{type(error).__name__}: {error}")
        yield frame
        yield Exposed(cycle_id=frame.cycle_id, is_simulated=frame.is_simulated)
        yield from self._account(frame)

    def on_set_camera(self, wanted: SetCamera) -> Done:
        """Exposure and gain from the next frame on, until the service ends."""
        try:
            exposure_us = checked_exposure_us(self._settings, wanted.exposure_us or self._exposure_us)
            gain_db = checked_gain_db(self._gain_db if wanted.gain_db is None else wanted.gain_db)
        except ValueError as error:
            return Done(ok=False, text=str(error))
        self._exposure_us, self._gain_db = exposure_us, gain_db
        return Done(ok=True, text=f"exposure {exposure_us:g} us, gain {gain_db:g} dB")

    def tick(self, now_s: float) -> Iterator[Message]:
        """The last frame as a preview; encoded once, said again for those who come later."""
        if self._shown is not None:
            jpeg = encoded_preview(self._shown, self._settings.preview_step, self._settings.preview_quality)
            self._preview = Preview(
                jpeg=jpeg,
                frame_counter=self._counter,
                is_simulated=self._camera.is_simulated,
                step_px=self._settings.preview_step,
            )
            self._shown = None
        if self._preview is not None:
            yield self._preview

    def health(self) -> Health:
        values: dict[str, float | int | str | bool | None] = {
            "camera": self._camera_name,
            "exposure_us": self._exposure_us,
            "gain_db": self._gain_db,
            "frames": self._taken,
            "frames_refused": self._refused,
            **self._camera.figures(),
        }
        return Health("degraded" if self._fault else "ready", self._fault, values)

    def close(self) -> None:
        self._camera.close()

    def _framed(self, request: MeasureRequest, pixels: NDArray[np.uint8], code: int = 0, refusal: str = "") -> Frame:
        return Frame(
            cycle_id=request.cycle_id,
            is_simulated=request.is_simulated or self._camera.is_simulated,
            request=request,
            camera=self._camera_name,
            pixels=pixels,
            exposure_us=self._exposure_us,
            frame_counter=self._counter,
            refusal_code=code,
            refusal=refusal,
        )

    def _refusal(self, request: MeasureRequest, code: int, reason: str) -> Frame:
        return self._framed(request, np.zeros((0, 0), dtype=np.uint8), code, reason)

    def _account(self, frame: Frame) -> Iterator[Message]:
        FRAMES.labels(cell=self._cell, result="refused" if frame.refusal_code else "taken").inc()
        if not frame.refusal_code:
            self._shown, self._fault = frame.pixels, ""
            self._taken += 1
            return
        self._fault = frame.refusal
        self._refused += 1
        yield Event(service=self.name, level="error", text=frame.refusal, utc=_utc(), cycle_id=frame.cycle_id)


def _utc() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def build(cell: CellSettings, settings: CaptureSettings) -> Service:
    """The live service with the camera that its settings name.

    Raises:
        ConfigError: settings that the camera cannot obey.
    """
    cv2.setNumThreads(1)  # a pool of threads would take the processors from the measuring chain
    try:
        checked_exposure_us(settings, settings.exposure_us)
    except ValueError as error:
        raise ConfigError(str(error), "capture.exposure_us", "choose one inside") from error
    camera: Camera
    if settings.kind == "replay":
        if settings.folder is None:
            raise ConfigError("is missing", "capture.folder", "name the folder of images to replay")
        camera = ReplayCamera(cell.data_dir / settings.folder, loop=settings.loop)
    else:
        camera = SimCamera(settings, cell.data_folder("capture"), settings.exposure_us, settings.gain_db)
    return Capture(cell.cell, settings, camera)
