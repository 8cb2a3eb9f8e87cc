"""The simulated laser head over a wearing die; renders ahead of the trigger.

A cycle is to measure the cell and not the renderer: while the press opens, a worker thread of low
priority renders the frame of the next stroke. Should another frame be wanted, it is rendered at once.
"""

from __future__ import annotations

import json
import os
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from wearline.config import Settings
from wearline.errors import DeviceError
from wearline.messages import MeasureRequest
from wearline.scene import DEFAULT_HEAD, Head, Light, StampedPart, part_of_stroke, render, true_errors
from wearline_capture.drivers.camera import Shot

_TRUTH_BYTES = 20_000_000  # then a new file is begun; one old one is kept
_LOW_PRIORITY = 10


class SimSettings(Settings):
    """The simulated head."""

    seed: int = Field(default=1, ge=0)
    head: dict[str, float | int | bool | None] = Field(default_factory=dict)
    """Fields of the simulated head that differ from the default one."""
    vibration_px: float = Field(default=0.05, ge=0)
    """Standard deviation of a frame's shift across the lines. [px]"""
    ahead_delay_ms: float = Field(default=150.0, ge=0)
    """Pause before the next frame is rendered, so that the rest of the chain has the processors first. [ms]"""

    @field_validator("head")
    @classmethod
    def _known(cls, value: dict[str, float | int | bool | None]) -> dict[str, float | int | bool | None]:
        unknown = sorted(set(value) - {f.name for f in fields(Head)})
        if unknown:
            raise ValueError(f"the simulated head has no {', '.join(unknown)}")
        return value


@dataclass(frozen=True)
class Plan:
    """All that decides the pixels of one frame."""

    stroke: int
    regrinds: tuple[int, ...]
    exposure_us: float
    gain_db: float


@dataclass(frozen=True)
class Rendered:
    """A frame and what is true of it."""

    pixels: NDArray[np.uint8]
    wear_mm: float
    true_mean_mm: float
    true_max_mm: float


def rendered(head: Head, plan: Plan, seed: int, vibration_px: float) -> Rendered:
    """The frame of one stroke; the same plan gives the same pixels."""
    part = part_of_stroke(plan.stroke, plan.regrinds, seed)
    amplified = 10.0 ** (plan.gain_db / 20.0)
    default = Light()
    light = replace(
        default,
        exposure_us=plan.exposure_us,
        laser_dn=default.laser_dn * amplified,
        ambient_dn=default.ambient_dn * amplified,
        vibration_px=vibration_px,
    )
    pixels, _ = render(head, part, light, seed * 1_000_003 + plan.stroke)
    pixels.flags.writeable = False
    mean, largest = true_errors(head, part, StampedPart())
    return Rendered(pixels, part.wear_mm, mean, largest)


def read_regrinds(path: Path) -> tuple[int, ...]:
    """Strokes at which the die was reground; none without the file.

    Raises:
        DeviceError: the file is not {"regrinds": [stroke, ...]}.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return tuple(sorted(int(stroke) for stroke in content["regrinds"]))
    except FileNotFoundError:
        return ()
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise DeviceError(
            f"does not list the regrinds ({' '.join(str(error).split())})",
            str(path),
            'write {"regrinds": [stroke, ...]}',
        ) from error


class _Ahead:
    """A frame that may be wanted soon."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.hurry = threading.Event()
        self.is_dropped = False
        self.future: Future[Rendered | None] = Future()

    def drop(self) -> None:
        """Nobody wants it any more; a worker that still pauses before it renders nothing."""
        self.is_dropped = True
        self.hurry.set()


class SimCamera:
    """Shows the part of the request's stroke and notes the truth about it in ``folder``."""

    is_simulated = True

    def __init__(self, settings: SimSettings, folder: Path, exposure_us: float, gain_db: float) -> None:
        self.name = "sim"
        self.head = replace(DEFAULT_HEAD, **settings.head)  # type: ignore[arg-type]
        self._settings = settings
        self._die = folder / "die.json"
        self._truth = folder / "truth.jsonl"
        self._counter = 0
        self._rendered_late = 0
        self._closed = threading.Event()
        self._worker = ThreadPoolExecutor(1, "render", initializer=_lower_priority)
        self._ahead: _Ahead | None = None
        try:
            regrinds = read_regrinds(self._die)
        except DeviceError:
            regrinds = ()  # reported with the first shot
        self._prepare(Plan(self._last_stroke() + 1, regrinds, exposure_us, gain_db), 0.0)

    def shoot(self, request: MeasureRequest, exposure_us: float, gain_db: float) -> Shot:
        if self._closed.is_set():
            raise DeviceError("is closed", self.name)
        ready_s = time.monotonic() + exposure_us * 1e-6
        plan = Plan(request.stroke, read_regrinds(self._die), exposure_us, gain_db)
        frame = self._frame(plan)
        if self._closed.wait(max(ready_s - time.monotonic(), 0.0)):
            raise DeviceError("closed during the exposure", self.name)
        self._counter += 1
        self._note(request, frame)
        self._prepare(replace(plan, stroke=plan.stroke + 1), self._settings.ahead_delay_ms * 1e-3)
        return Shot(frame.pixels, exposure_us, self._counter)

    def figures(self) -> dict[str, float | int | str | bool | None]:
        return {"frames_rendered_late": self._rendered_late}

    def close(self) -> None:
        self._closed.set()
        if self._ahead is not None:
            self._ahead.drop()
        self._worker.shutdown(wait=True, cancel_futures=True)

    def wait_ahead(self, timeout_s: float) -> int:
        """Wait until the next frame is rendered; the stroke that it is for.

        Raises:
            TimeoutError: it is not.
        """
        if self._ahead is None:
            raise TimeoutError("no frame is being rendered")
        self._ahead.hurry.set()
        self._ahead.future.result(timeout_s)
        return self._ahead.plan.stroke

    def _frame(self, plan: Plan) -> Rendered:
        ahead, self._ahead = self._ahead, None
        if ahead is not None and ahead.plan == plan:
            ahead.hurry.set()
            frame = ahead.future.result()
            if frame is not None:
                return frame
        if ahead is not None:
            ahead.drop()
        self._rendered_late += 1
        # On this thread: the worker cannot raise its priority again.
        return rendered(self.head, plan, self._settings.seed, self._settings.vibration_px)

    def _prepare(self, plan: Plan, delay_s: float) -> None:
        ahead = _Ahead(plan)

        def run() -> Rendered | None:
            ahead.hurry.wait(delay_s)
            if ahead.is_dropped:
                return None
            return rendered(self.head, plan, self._settings.seed, self._settings.vibration_px)

        if not self._closed.is_set():
            ahead.future = self._worker.submit(run)
            self._ahead = ahead

    def _note(self, request: MeasureRequest, frame: Rendered) -> None:
        line = {
            "cycle_id": request.cycle_id,
            "stroke": request.stroke,
            "wear_mm": frame.wear_mm,
            "true_mean_mm": frame.true_mean_mm,
            "true_max_mm": frame.true_max_mm,
        }
        try:
            if self._truth.exists() and self._truth.stat().st_size > _TRUTH_BYTES:
                self._truth.replace(self._truth.with_suffix(".1.jsonl"))
            with self._truth.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
        except OSError as error:
            raise DeviceError(f"cannot be written ({error.strerror})", str(self._truth), "make room") from error

    def _last_stroke(self) -> int:
        """Of the last run, so that the first frame after a restart is ready too; 0 if unknown."""
        try:
            with self._truth.open("rb") as file:
                file.seek(0, os.SEEK_END)
                file.seek(max(file.tell() - 4096, 0))
                return int(json.loads(file.read().splitlines()[-1])["stroke"])
        except (OSError, ValueError, TypeError, KeyError, IndexError):
            return 0


def _lower_priority() -> None:
    """Of the calling thread alone; the measuring chain comes first."""
    try:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LOW_PRIORITY)
    except OSError:
        return  # a sandbox may forbid it; frames are then rendered at the usual priority
