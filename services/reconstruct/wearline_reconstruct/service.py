"""Frames in, line points out."""

from __future__ import annotations

import hashlib
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, ClassVar

import cv2
import numpy as np

from wearline.artifact import Calibration, Template, content_hash
from wearline.config import CellSettings
from wearline.errors import BusError, CalibrationError, FrameError, RecipeError, TemplateError, WearlineError
from wearline.messages import (
    Artifact,
    AskArtifact,
    AskRecipe,
    Event,
    Frame,
    FrameQuality,
    LinePoints,
    Message,
    ObjectRecipe,
    ResultCode,
)
from wearline.metrics import counter
from wearline.recipe import parse_recipe
from wearline.service import Asker, Health, Service
from wearline.topics import ARTIFACT, FRAME, LINE_POINTS, RECIPE, Topic
from wearline_reconstruct.config import ReconstructSettings
from wearline_reconstruct.core.chain import Prepared, prepare, reconstruct
from wearline_reconstruct.core.ranking import ranked
from wearline_reconstruct.drivers.artifact_cache import ArtifactCache

FRAMES = counter("wearline_reconstructed_total", "Frames reconstructed, and how that went", ("cell", "result"))

_KEPT_OBJECTS = 8
_KEPT_FRAMES = 2
"""Frames of megabytes that wait for another replica; older ones are past their deadline anyway."""
_NOTHING = np.zeros((0, 5), np.float32)


class Reconstruct(Service):
    """Turns each frame into line points, by the object's recipe and references."""

    name: ClassVar[str] = "reconstruct"
    tick_s = 0.1

    def __init__(
        self,
        cell: str,
        settings: ReconstructSettings,
        cache: ArtifactCache,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._cell = cell
        self._clock = clock
        self._live: frozenset[str] = frozenset()
        self._held: OrderedDict[str, _Held] = OrderedDict()
        self._settings = settings
        self._cache = cache
        self._asker: Asker | None = None
        self._prepared: OrderedDict[tuple[str, str, str], Prepared] = OrderedDict()
        self._done = 0
        self._refused = 0
        self._fault = ""
        self._total_ms = 0.0

    def start(self, asker: Asker) -> Iterable[Message]:
        self._asker = asker
        return ()

    def handlers(self) -> Mapping[Topic, Callable[[Any], Iterable[Message]]]:
        return {FRAME: self.on_frame, LINE_POINTS: self.on_line_points}

    def on_frame(self, frame: Frame) -> Iterator[Message]:
        """One LinePoints per frame, from the replica that ranks first for its cycle.

        The second one keeps the frame and steps in when the first one goes or is late. Nobody after that: a
        frame that ends two replicas would end them all.
        """
        first, second, *_ = [*ranked(frame.cycle_id, self._live | {self.instance}), ""]
        if first == self.instance:
            yield from self._measure(frame)
        elif second == self.instance:
            self._held[frame.cycle_id] = _Held(frame, first, self._clock() + self._settings.step_in_after_s)
            while len(self._held) > _KEPT_FRAMES:
                self._held.popitem(last=False)

    def on_line_points(self, points: LinePoints) -> Iterable[Message]:
        """Another replica has measured; judge drops the second of two equal answers."""
        self._held.pop(points.cycle_id, None)
        return ()

    def on_replicas(self, live: frozenset[str]) -> Iterator[Message]:
        self._live = live
        yield from self._step_in(lambda held: held.leader not in live)

    def tick(self, now_s: float) -> Iterator[Message]:
        clock_s = self._clock()
        yield from self._step_in(lambda held: clock_s >= held.due_s)

    def _step_in(self, is_due: Callable[[_Held], bool]) -> Iterator[Message]:
        for held in [held for held in self._held.values() if is_due(held)]:
            del self._held[held.frame.cycle_id]
            yield from self._measure(held.frame)

    def _measure(self, frame: Frame) -> Iterator[Message]:
        """The heights, or the reason why there are none."""
        if frame.refusal_code:
            answer = self._refusal(frame, frame.refusal_code, frame.refusal, None)
        else:
            answer = self._answer(frame)
        yield answer
        yield from self._account(answer)

    def health(self) -> Health:
        values: dict[str, float | int | str | bool | None] = {
            "frames": self._done,
            "frames_refused": self._refused,
            "last_ms": round(self._total_ms, 2),
        }
        return Health("ready", self._fault, values)

    def _answer(self, frame: Frame) -> LinePoints:
        known: ObjectRecipe | None = None
        try:
            known = self._recipe(frame)
            prepared = self._prepare(known)
            found = reconstruct(frame.pixels, prepared, time.perf_counter)
        except _RefusedError as refused:
            return self._refusal(frame, int(refused.code), refused.text, known)
        except FrameError as error:
            return self._refusal(frame, error.code, str(error), known)
        except Exception as error:
            # The PLC must hear of our own fault at once too, not when the deadline has passed.
            text = f"reconstruction failed: {type(error).__name__}: {error}"
            return self._refusal(frame, int(ResultCode.BAD_FRAME), text, known)
        return LinePoints(
            cycle_id=frame.cycle_id,
            is_simulated=frame.is_simulated,
            request=frame.request,
            points=found.points,
            sigma_frame_mm=found.sigma_frame_mm,
            coverage=found.coverage,
            quality=found.quality,
            timings_ms=found.timings_ms,
            frame_hash=_frame_hash(frame),
            calibration_hash=known.calibration_hash,
            recipe_hash=known.recipe_hash,
        )

    def _recipe(self, frame: Frame) -> ObjectRecipe:
        index = frame.request.object_index
        try:
            answer = self._ask(RECIPE, AskRecipe(object_index=index), str(index))
        except BusError as error:
            raise _RefusedError(_code_of(error, ResultCode.UNKNOWN_OBJECT), str(error)) from error
        if not isinstance(answer, ObjectRecipe):
            raise _RefusedError(ResultCode.UNKNOWN_OBJECT, f"object {index} has no recipe")
        return answer

    def _prepare(self, known: ObjectRecipe) -> Prepared:
        key = (known.recipe_hash, known.calibration_hash, known.template_hash)
        found = self._prepared.get(key)
        if found is not None:
            self._prepared.move_to_end(key)
            return found
        name = f"object {known.object_index}"
        if not known.calibration_hash:
            raise _RefusedError(ResultCode.NO_CALIBRATION, f"{name} has no calibration; run 'wearline calibrate'")
        try:
            recipe = parse_recipe(known.recipe_yaml, f"recipe of {name}")
        except RecipeError as error:
            raise _RefusedError(ResultCode.UNKNOWN_OBJECT, str(error)) from error
        try:
            content = self._artifact(known.calibration_hash, ResultCode.NO_CALIBRATION)
            calibration = Calibration.from_bytes(content, f"calibration of {name}")
            template = None
            if known.template_hash:
                content = self._artifact(known.template_hash, ResultCode.NO_TEMPLATE)
                template = Template.from_bytes(content, f"template of {name}")
                if template.calibration_hash and template.calibration_hash != known.calibration_hash:
                    raise TemplateError("was made with another calibration", f"template of {name}", "teach it again")
            prepared = prepare(calibration, recipe, template, self._settings.chain)
        except CalibrationError as error:
            raise _RefusedError(ResultCode.NO_CALIBRATION, str(error)) from error
        except TemplateError as error:
            raise _RefusedError(ResultCode.NO_TEMPLATE, str(error)) from error
        self._prepared[key] = prepared
        while len(self._prepared) > _KEPT_OBJECTS:
            self._prepared.popitem(last=False)
        return prepared

    def _artifact(self, name: str, missing: ResultCode) -> bytes:
        content = self._cache.get(name)
        if content is not None:
            return content
        try:
            answer = self._ask(ARTIFACT, AskArtifact(content_hash=name), name)
        except BusError as error:
            raise _RefusedError(_code_of(error, missing), str(error)) from error
        content = answer.content.tobytes() if isinstance(answer, Artifact) else b""
        if content_hash(content) != name:
            raise _RefusedError(missing, f"artifact {name[:12]} came with other content; restore it or make it again")
        self._cache.put(name, content)
        return content

    def _ask(self, query: Any, question: Message, argument: str) -> Message:
        if self._asker is None:
            raise BusError("was not started", "reconstruct", "start it with the runner")
        return self._asker.ask(query, question, argument, timeout_s=self._settings.ask_timeout_s)

    def _refusal(self, frame: Frame, code: int, reason: str, known: ObjectRecipe | None) -> LinePoints:
        return LinePoints(
            cycle_id=frame.cycle_id,
            is_simulated=frame.is_simulated,
            request=frame.request,
            points=_NOTHING,
            quality=FrameQuality(sentences=(reason,)),
            refusal_code=code,
            refusal=reason,
            frame_hash=_frame_hash(frame) if frame.pixels.size else "",
            calibration_hash=known.calibration_hash if known else "",
            recipe_hash=known.recipe_hash if known else "",
        )

    def _account(self, answer: LinePoints) -> Iterator[Message]:
        FRAMES.labels(cell=self._cell, result="refused" if answer.refusal_code else "measured").inc()
        self._fault = answer.refusal
        if not answer.refusal_code:
            self._done += 1
            self._total_ms = answer.timings_ms.get("total", 0.0)
            return
        self._refused += 1
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        yield Event(service=self.name, level="warning", text=answer.refusal, utc=now, cycle_id=answer.cycle_id)


@dataclass(frozen=True)
class _Held:
    """A frame that another replica ought to measure."""

    frame: Frame
    leader: str
    due_s: float
    """When to stop waiting for it (monotonic). [s]"""


class _RefusedError(Exception):
    """A frame that cannot be measured for a reason beside the frame."""

    def __init__(self, code: ResultCode, text: str) -> None:
        super().__init__(text)
        self.code, self.text = code, text


def _code_of(error: WearlineError, refused: ResultCode) -> ResultCode:
    """Nobody answered (the error names the key), or the answerer refused."""
    return ResultCode.SERVICE_LOST if error.where.startswith("wearline/") else refused


def _frame_hash(frame: Frame) -> str:
    return hashlib.sha256(np.ascontiguousarray(frame.pixels).data).hexdigest()


def build(cell: CellSettings, settings: ReconstructSettings) -> Service:
    """The live service."""
    cv2.setNumThreads(1)  # a pool of threads would take the processors from the other services
    return Reconstruct(cell.cell, settings, ArtifactCache(cell.data_folder("reconstruct") / "artifacts"))


def offline(asker: Asker) -> Service:
    """The same handlers without files of their own."""
    cv2.setNumThreads(1)
    service = Reconstruct("offline", ReconstructSettings(), ArtifactCache(None))
    service.start(asker)
    return service
