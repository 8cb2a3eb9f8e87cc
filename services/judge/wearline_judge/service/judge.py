"""Line points in, verdicts out; every verdict is on record before it is said."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from typing import Any, ClassVar

import numpy as np

from wearline.artifact import Calibration, Template
from wearline.errors import BusError, RecordError, TemplateError, WearlineError
from wearline.messages import (
    Acknowledge,
    Artifact,
    AskArtifact,
    AskRecipe,
    AskRecords,
    AskWearMap,
    Decision,
    DieEvent,
    Done,
    Event,
    Frame,
    LinePoints,
    Message,
    ObjectList,
    ObjectRecipe,
    Outcome,
    Ping,
    Records,
    ResultCode,
    Teach,
    Verdict,
    View,
    WearMap,
)
from wearline.recipe import Recipe, parse_recipe
from wearline.service import Asker, Health, Service
from wearline.topics import (
    ACKNOWLEDGE,
    ARTIFACT,
    DIE_EVENT,
    FRAME,
    LINE_POINTS,
    OUTCOME,
    RECIPE,
    RECIPE_LIST,
    RECORDS,
    TEACH,
    WEAR_MAP,
    Query,
    Topic,
)
from wearline_judge.config import JudgeSettings
from wearline_judge.core.alarms import AlarmError
from wearline_judge.core.golden import make_golden
from wearline_judge.core.judgement import Judgement, Setup, judge_points, make_setup, refused
from wearline_judge.core.teaching import Sample, teach
from wearline_judge.core.view import make_view
from wearline_judge.drivers.frames import Class
from wearline_judge.drivers.lock import FolderLock
from wearline_judge.drivers.references import References, StoredReferences
from wearline_judge.service.recording import Recording
from wearline_judge.service.stores import Stores
from wearline_judge.service.trends import Trends

_KEPT_SETUPS = 8
_KEPT_CYCLES = 1024
_FRAMES_WAITING = 4
"""Frames whose verdict has not come yet; 2 MB each."""
_FRAME_WAITS_S = 5.0
"""No cycle lasts so long: what was to become of this frame is lost. [s]"""
_POINTS_KEPT = 24
"""Measured cycles that a template can be taught from; 0.8 MB each."""


class Judge(Service):
    """Judges each part once, keeps the records and the object list."""

    name: ClassVar[str] = "judge"
    tick_s = 0.5

    def __init__(
        self,
        cell: str,
        settings: JudgeSettings,
        references: References,
        stores: Stores | None = None,
        *,
        accepts_simulated: bool = True,
        version: str = "",
        lock: FolderLock | None = None,
        clock: Callable[[], float] = time.monotonic,
        utc: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._cell, self._settings, self._references, self._stores = cell, settings, references, stores
        self._accepts_simulated, self._version, self._lock = accepts_simulated, version, lock
        self._clock, self._utc = clock, utc
        self._asker: Asker | None = None
        self._setups: OrderedDict[tuple[str, str], Setup] = OrderedDict()
        self._judged: OrderedDict[str, None] = OrderedDict()
        self._frames: OrderedDict[str, tuple[float, Frame]] = OrderedDict()
        self._points: OrderedDict[str, LinePoints] = OrderedDict()
        self._teaching: dict[int, list[str]] = {}
        self._last_ms = 0.0
        self._recording: Recording | None = None
        self._trends: Trends | None = None
        if stores is not None:
            self._recording = Recording(stores.records, stores.room, version, clock, utc)
            self._trends = Trends(cell, stores.records, references, settings.alarms, utc)

    # --- life ---

    def start(self, asker: Asker) -> Iterable[Message]:
        self._asker = asker
        if self._stores is None:
            return
        for entry in StoredReferences(self._stores.objects, self._stores.blobs).released()[:_KEPT_SETUPS]:
            # The first part of an object must not wait for its template to be made ready.
            try:
                self._setup(self._references.object_recipe(entry.object_index))
            except (WearlineError, _RefusedError) as error:
                yield self._event("warning", f"object {entry.object_index}: {error}")
        if self._trends is not None:
            for index in self._stores.records.objects():
                self._trends.recorded(index)

    def handlers(self) -> Mapping[Topic, Callable[[Any], Iterable[Message]]]:
        return {FRAME: self.on_frame, LINE_POINTS: self.on_line_points, OUTCOME: self.on_outcome}

    def answers(self) -> Mapping[Query, Callable[[Any], Message]]:
        return {
            RECIPE: self.on_recipe,
            RECIPE_LIST: self.on_recipe_list,
            ARTIFACT: self.on_artifact,
            RECORDS: self.on_records,
            TEACH: self.on_teach,
            DIE_EVENT: self.on_die_event,
            ACKNOWLEDGE: self.on_acknowledge,
            WEAR_MAP: self.on_wear_map,
        }

    def on_alive(self, service: str, is_alive: bool) -> Iterable[Message]:
        if service == "fieldbus" and self._recording is not None:
            self._recording.journal_is(is_alive)
        return ()

    def tick(self, now_s: float) -> Iterator[Message]:
        """What may wait until no part is under way: late records, the journal, pruning, trends."""
        if self._stores is None or self._recording is None or self._trends is None:
            return
        if self._recording.unrecorded and (count := self._recording.catch_up()):
            yield self._event("info", f"{count} entries that could not be recorded before are on record now")
        for cycle_id, (since_s, _) in tuple(self._frames.items()):
            if now_s - since_s > _FRAME_WAITS_S:
                self._drop_frame(cycle_id)
        if self._frames:
            return
        if self._asker is not None and self._recording.is_due(now_s):
            for verdict in self._recording.reconcile(self._asker, now_s):
                yield self._event("warning", f"never judged: {verdict.reason}", verdict.cycle_id)
        if self._settings.records_kept is not None:
            self._stores.records.prune(self._settings.records_kept, self._utc())
        for sentence in self._trends.tick():
            yield self._event("warning", sentence)

    def health(self) -> Health:
        values: dict[str, float | int | str | bool | None] = {
            "judged": len(self._judged),
            "last_ms": round(self._last_ms, 2),
        }
        if self._stores is None or self._recording is None:
            return Health("ready", "", values)
        has_room = self._stores.room.has_room()
        # fieldbus withdraws Ready: nothing may be accepted that cannot be recorded.
        values["accepts"] = has_room and not self._recording.unrecorded
        values["unrecorded"] = self._recording.unrecorded
        values["is_reconciled"] = self._recording.is_reconciled
        values["frames_left_out"] = self._stores.frames.left_out
        if self._recording.unrecorded:
            return Health("degraded", self._recording.fault, values)
        if not has_room:
            return Health("degraded", "no room on disk to record a cycle; free space", values)
        return Health("ready", "", values)

    def close(self) -> None:
        if self._trends is not None:
            self._trends.close()
        if self._stores is not None:
            self._stores.frames.close()
            self._stores.records.close()
        if self._lock is not None:
            self._lock.close()

    # --- the cycle ---

    def on_frame(self, frame: Frame) -> Iterable[Message]:
        """Hold the frame until its verdict says how long it is worth keeping."""
        if self._stores is not None and frame.pixels.size:
            self._frames[frame.cycle_id] = (self._clock(), frame)
            while len(self._frames) > _FRAMES_WAITING:
                self._drop_frame(next(iter(self._frames)))
        return ()

    def on_line_points(self, points: LinePoints) -> Iterator[Message]:
        """One Verdict per cycle, on record before it is said; then the maps for the eye."""
        if self._was_judged(points.cycle_id):
            return
        start_s = time.perf_counter()
        known, setup, judgement = self._judge(points)
        verdict = self._verdict(points, known, judgement, 1e3 * (time.perf_counter() - start_s))
        if self._recording is not None:
            verdict = self._recording.verdict(verdict)
        self._note(verdict.cycle_id)
        yield verdict
        if judgement.comparison is not None and setup is not None:
            yield self._view(verdict, setup, judgement)
        self._keep_frame(verdict)
        if self._trends is not None:
            self._trends.measured(verdict, judgement.comparison, setup)
        yield from self._after(points, verdict)

    def on_outcome(self, outcome: Outcome) -> Iterator[Message]:
        """What the PLC was told, on record; a cycle that was never judged gets its one record now."""
        if self._recording is None or self._trends is None:
            return
        made = self._recording.outcome(outcome)
        if made is not None:
            self._note(outcome.cycle_id)
            yield self._event("warning", f"never judged: {made.reason}", outcome.cycle_id)
        self._drop_frame(outcome.cycle_id)
        self._trends.recorded(outcome.request.object_index)

    def _judge(self, points: LinePoints) -> tuple[ObjectRecipe | None, Setup | None, Judgement]:
        known: ObjectRecipe | None = None
        try:
            if points.refusal_code:
                return None, None, refused(points.refusal_code, points.refusal)
            if points.is_simulated and not self._accepts_simulated:
                raise _RefusedError(
                    ResultCode.SIMULATED_REFUSED, "simulated, but cell.yaml does not say plc_is_simulated: true"
                )
            known = self._known(points)
            setup = self._setup(known)
            return known, setup, judge_points(points, setup, self._settings)
        except _RefusedError as no:
            return known, None, refused(int(no.code), no.text)
        except Exception as error:
            # The PLC must hear of our own fault at once too, not when the deadline has passed.
            text = f"judging failed: {type(error).__name__}: {error}"
            return known, None, refused(int(ResultCode.BAD_FRAME), text)

    def _known(self, points: LinePoints) -> ObjectRecipe:
        index = points.request.object_index
        try:
            known = self._references.object_recipe(index)
        except BusError as error:
            raise _RefusedError(_code_of(error, ResultCode.UNKNOWN_OBJECT), str(error)) from error
        except WearlineError as error:
            raise _RefusedError(ResultCode.UNKNOWN_OBJECT, str(error)) from error
        if points.recipe_hash != known.recipe_hash:
            raise _RefusedError(ResultCode.RECIPE_CHANGED, f"object {index} was measured with another recipe")
        if points.calibration_hash != known.calibration_hash:
            raise _RefusedError(ResultCode.RECIPE_CHANGED, f"object {index} was measured with another calibration")
        return known

    def _setup(self, known: ObjectRecipe) -> Setup:
        key = (known.template_hash, known.recipe_hash)
        found = self._setups.get(key)
        if found is None:
            found = self._make_setup(known)
            self._setups[key] = found
            while len(self._setups) > _KEPT_SETUPS:
                self._setups.popitem(last=False)
        self._setups.move_to_end(key)
        if found.golden.calibration_hash != known.calibration_hash:
            raise _RefusedError(
                ResultCode.NO_TEMPLATE,
                f"template of object {known.object_index} was made with another calibration; teach it again",
            )
        return found

    def _make_setup(self, known: ObjectRecipe) -> Setup:
        where = f"template of object {known.object_index}"
        if not known.template_hash:
            raise _RefusedError(ResultCode.NO_TEMPLATE, f"object {known.object_index} has no template; teach it")
        recipe = self._recipe(known)
        try:
            template = Template.from_bytes(self._references.artifact(known.template_hash), where)
            golden = make_golden(template, recipe.mm_per_pixel)
            if golden.is_vertical != (recipe.orientation == "vertical"):
                raise TemplateError("has lines of the other orientation", where, "teach it again")
            return make_setup(golden, recipe)
        except BusError as error:
            raise _RefusedError(_code_of(error, ResultCode.NO_TEMPLATE), str(error)) from error
        except WearlineError as error:
            raise _RefusedError(ResultCode.NO_TEMPLATE, str(error)) from error

    def _recipe(self, known: ObjectRecipe) -> Recipe:
        try:
            return parse_recipe(known.recipe_yaml, f"recipe of object {known.object_index}")
        except WearlineError as error:
            raise _RefusedError(ResultCode.UNKNOWN_OBJECT, str(error)) from error

    def _verdict(
        self, points: LinePoints, known: ObjectRecipe | None, judgement: Judgement, judge_ms: float
    ) -> Verdict:
        reconstruct_ms = points.timings_ms.get("total", 0.0)
        self._last_ms = judge_ms
        return Verdict(
            cycle_id=points.cycle_id,
            is_simulated=points.is_simulated,
            request=points.request,
            quality=points.quality,
            timings_ms={
                "reconstruct": round(reconstruct_ms, 3),
                "judge": round(judge_ms, 3),
                "total": round(reconstruct_ms + judge_ms, 3),
            },
            frame_hash=points.frame_hash,
            calibration_hash=points.calibration_hash,
            template_hash=known.template_hash if known else "",
            recipe_hash=points.recipe_hash,
            code_version=self._version,
            **judgement.fields,
        )

    def _view(self, verdict: Verdict, setup: Setup, judgement: Judgement) -> View:
        assert judgement.comparison is not None
        maps, step = make_view(setup.golden, judgement.comparison, self._settings.view_longest)
        return View(
            cycle_id=verdict.cycle_id,
            is_simulated=verdict.is_simulated,
            maps_mm=maps,
            step_px=step,
            origin_px=(float(setup.golden.roi[0]), float(setup.golden.roi[1])),
            mm_per_pixel=setup.golden.mm_per_pixel,
            stroke=verdict.request.stroke,
            decision=verdict.decision,
        )

    def _after(self, points: LinePoints, verdict: Verdict) -> Iterator[Message]:
        index = points.request.object_index
        if self._stores is None:
            return
        if verdict.decision is Decision.NOT_MEASURED and points.refusal_code == 0:
            yield self._event("warning", verdict.reason, verdict.cycle_id)
        if not points.refusal_code and len(points.points):
            self._points[points.cycle_id] = points
            while len(self._points) > _POINTS_KEPT:
                self._points.popitem(last=False)
            if index in self._teaching:
                yield from self._teach_on(index, points.cycle_id)

    def _was_judged(self, cycle_id: str) -> bool:
        if cycle_id in self._judged:
            return True
        # A service that was started anew has forgotten; its records have not.
        try:
            return self._stores is not None and self._stores.records.has_verdict(cycle_id)
        except RecordError:
            return False

    def _note(self, cycle_id: str) -> None:
        self._judged[cycle_id] = None
        while len(self._judged) > _KEPT_CYCLES:
            self._judged.popitem(last=False)

    def _keep_frame(self, verdict: Verdict) -> None:
        kinds = {Decision.PASSED: Class.PASSED, Decision.NOT_MEASURED: Class.NOT_MEASURED}
        self._drop_frame(verdict.cycle_id, kinds.get(verdict.decision, Class.FAILED))

    def _drop_frame(self, cycle_id: str, kind: Class = Class.NOT_MEASURED) -> None:
        """Hand a frame that waited to the store."""
        _, frame = self._frames.pop(cycle_id, (0.0, None))
        if frame is not None and self._stores is not None:
            self._stores.frames.put(frame.pixels, kind)

    # --- answers ---

    def on_recipe(self, asked: AskRecipe) -> ObjectRecipe:
        return self._references.object_recipe(asked.object_index)

    def on_recipe_list(self, _: Ping) -> ObjectList:
        stores = self._need_stores()
        return ObjectList(objects=StoredReferences(stores.objects, stores.blobs).released())

    def on_artifact(self, asked: AskArtifact) -> Artifact:
        content = self._references.artifact(asked.content_hash)
        return Artifact(content_hash=asked.content_hash, content=np.frombuffer(content, np.uint8))

    def on_records(self, asked: AskRecords) -> Records:
        records = self._need_stores().records
        counts = records.counts(asked.object_index)
        wanted = records.objects() if asked.object_index is None else (asked.object_index,)
        trends = self._need_trends() if asked.with_trends else None
        return Records(
            rows=records.rows(asked),
            total=sum(counts.values()),
            trends=() if trends is None else tuple(trend for index in wanted for trend in trends.of(index)),
            passed=counts.get(Decision.PASSED, 0),
            failed=counts.get(Decision.FAILED, 0) + counts.get(Decision.UNSURE, 0),
            not_measured=counts.get(Decision.NOT_MEASURED, 0),
        )

    def on_wear_map(self, asked: AskWearMap) -> WearMap:
        return self._need_trends().map_of(asked.object_index)

    def on_die_event(self, done: DieEvent) -> Done:
        stores, trends = self._need_stores(), self._need_trends()
        stroke = stores.records.newest_stroke(done.object_index)
        if stroke is None and done.object_index not in stores.objects.objects():
            return Done(ok=False, text=f"object {done.object_index} is not in the object list")
        stores.records.append_die_event(done, stroke or 0, self._utc())
        trends.served(done, stroke or 0)
        return Done(ok=True, text=f"{done.kind} of object {done.object_index} recorded at stroke {stroke or 0}")

    def on_acknowledge(self, asked: Acknowledge) -> Done:
        try:
            self._need_trends().acknowledged(asked.object_index, asked.zone, asked.user, asked.reason)
        except AlarmError as error:
            return Done(ok=False, text=str(error))
        return Done(ok=True, text="the alarm is acknowledged; it goes when its cause has gone")

    def on_teach(self, asked: Teach) -> Done:
        """From the named cycles, or from the next ones where none is named."""
        index = asked.object_index
        self._need_stores()
        self._references.object_recipe(index)
        if not asked.cycle_ids:
            self._teaching[index] = []
            return Done(ok=True, text=f"the next {self._settings.teach_frames} parts teach object {index}")
        return self._taught(index, asked.cycle_ids, asked.user)

    def _teach_on(self, index: int, cycle_id: str) -> Iterator[Message]:
        self._teaching[index].append(cycle_id)
        if len(self._teaching[index]) >= self._settings.teach_frames:
            cycle_ids = tuple(self._teaching.pop(index))
            try:
                done = self._taught(index, cycle_ids, "")
            except WearlineError as error:
                done = Done(ok=False, text=str(error))
            yield self._event("info" if done.ok else "error", done.text)

    def _taught(self, index: int, cycle_ids: tuple[str, ...], person: str) -> Done:
        stores = self._need_stores()
        known = self._references.object_recipe(index)
        samples = []
        for cycle_id in cycle_ids:
            points = self._points.get(cycle_id)
            if points is None:
                return Done(ok=False, text=f"cycle {cycle_id} is not among the last {_POINTS_KEPT} measured ones")
            if points.request.object_index != index:
                return Done(ok=False, text=f"cycle {cycle_id} is of object {points.request.object_index}, not {index}")
            if (points.recipe_hash, points.calibration_hash) != (known.recipe_hash, known.calibration_hash):
                return Done(ok=False, text=f"cycle {cycle_id} was measured with another recipe or calibration")
            samples.append(Sample(f"cycle {cycle_id}", points))
        recipe = parse_recipe(known.recipe_yaml, f"recipe of object {index}")
        calibration = Calibration.from_bytes(
            self._references.artifact(known.calibration_hash), f"calibration of object {index}"
        )
        try:
            template = teach(samples, calibration, known.calibration_hash, recipe, known.recipe_hash, self._settings)
        except TemplateError as error:
            return Done(ok=False, text=str(error))
        template_hash = stores.blobs.put_artifact(template.to_bytes())
        version = stores.objects.add(
            index, known.object_name, known.recipe_hash, known.calibration_hash, template_hash,
            self._utc().isoformat(timespec="seconds"), person, f"taught from {len(samples)} cycles",
        )  # fmt: skip
        return Done(ok=True, text=f"object {index}: version {version.version}, taught from {len(samples)} parts")

    def _need_stores(self) -> Stores:
        if self._stores is None:
            raise RecordError("keeps no records", "an offline judge", "ask a running cell")
        return self._stores

    def _need_trends(self) -> Trends:
        if self._trends is None:
            raise RecordError("keeps no records", "an offline judge", "ask a running cell")
        return self._trends

    def _event(self, level: str, text: str, cycle_id: str = "") -> Event:
        now = self._utc().isoformat(timespec="milliseconds")
        return Event(service=self.name, level=level, text=text, utc=now, cycle_id=cycle_id)


class _RefusedError(Exception):
    """A part that cannot be judged."""

    def __init__(self, code: ResultCode, text: str) -> None:
        super().__init__(text)
        self.code, self.text = code, text


def _code_of(error: WearlineError, otherwise: ResultCode) -> ResultCode:
    """Nobody answered (the error names the key), or the answerer refused."""
    return ResultCode.SERVICE_LOST if error.where.startswith("wearline/") else otherwise
