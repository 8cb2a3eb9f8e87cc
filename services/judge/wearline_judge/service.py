"""Line points in, verdicts out; every verdict is on record before it is said."""

from __future__ import annotations

import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, ClassVar

import cv2
import numpy as np

from wearline.artifact import Calibration, Template
from wearline.config import CellSettings
from wearline.errors import BusError, RecordError, TemplateError, WearlineError
from wearline.messages import (
    CODE_MEANING,
    Artifact,
    AskArtifact,
    AskJournal,
    AskRecipe,
    AskRecords,
    Decision,
    DieEvent,
    Done,
    Event,
    Frame,
    Journal,
    JournalEntry,
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
    WearTrend,
)
from wearline.metrics import gauge
from wearline.recipe import Recipe, parse_recipe
from wearline.service import Asker, Health, Service
from wearline.topics import (
    ARTIFACT,
    DIE_EVENT,
    FRAME,
    JOURNAL,
    LINE_POINTS,
    OUTCOME,
    RECIPE,
    RECIPE_LIST,
    RECORDS,
    TEACH,
    Query,
    Topic,
)
from wearline_judge.config import JudgeSettings
from wearline_judge.core.golden import make_golden
from wearline_judge.core.judgement import Judgement, Setup, judge_points, make_setup, refused
from wearline_judge.core.teaching import Sample, teach
from wearline_judge.core.trend import Trend, wear_limit, wear_trend
from wearline_judge.core.view import make_view
from wearline_judge.drivers.blobs import BlobStore
from wearline_judge.drivers.chain import key_of
from wearline_judge.drivers.fingerprint import code_version
from wearline_judge.drivers.frames import Class, FrameStore
from wearline_judge.drivers.lock import FolderLock
from wearline_judge.drivers.objects import ObjectFile
from wearline_judge.drivers.records import Cycle, RecordStore, sqlite_url
from wearline_judge.drivers.references import AskedReferences, References, StoredReferences
from wearline_judge.drivers.room import Room

MEAN_ERROR = gauge("wearline_mean_error_millimeters", "Mean error of the newest measured part", ("cell", "object"))
WEAR = gauge("wearline_wear_millimeters", "Wear of the newest measured part", ("cell", "object", "zone"))
SLOPE = gauge("wearline_wear_slope_millimeters_per_kilostroke", "Slope of the wear trend", ("cell", "object", "zone"))
REMAINING = gauge("wearline_remaining_strokes", "Strokes until the wear limit", ("cell", "object", "zone", "quantile"))
SINCE_SERVICE = gauge("wearline_strokes_since_service", "Strokes since the last die event", ("cell", "object"))

WHOLE = "part"
"""Label of the whole part where a metric names a zone."""
_KEPT_SETUPS = 8
_KEPT_CYCLES = 1024
_FRAMES_WAITING = 4
"""Frames whose verdict has not come yet; 2 MB each."""
_POINTS_KEPT = 24
"""Measured cycles that a template can be taught from; 0.8 MB each."""
_JOURNAL_TIMEOUT_S = 0.3
_JOURNAL_PAUSE_S = 2.0
_RECONCILED = "reconciled"
"""Mark: newest accepted_utc of the journal that is reconciled."""
_TREND_POINTS = 1000
_FEW_RECORDS = 2000
"""Up to here a trend shows every record, beyond it the means of bins."""


@dataclass(frozen=True)
class Stores:
    """What a live judge keeps on disk."""

    objects: ObjectFile
    blobs: BlobStore
    records: RecordStore
    frames: FrameStore
    room: Room


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
        self._frames: OrderedDict[str, Frame] = OrderedDict()
        self._points: OrderedDict[str, LinePoints] = OrderedDict()
        self._teaching: dict[int, list[str]] = {}
        self._unrecorded: deque[Verdict | Outcome] = deque()
        self._journal_due_s: float | None = 0.0
        self._fault = ""
        self._last_ms = 0.0

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
        }

    def on_alive(self, service: str, is_alive: bool) -> Iterable[Message]:
        if service == "fieldbus":
            # What it accepted before it went, and whatever we missed, is in its journal.
            self._journal_due_s = self._clock() if is_alive else None
        return ()

    def tick(self, now_s: float) -> Iterator[Message]:
        """Record what could not be recorded; reconcile with the journal until fieldbus answered."""
        if self._unrecorded:
            yield from self._catch_up()
        if self._stores is not None and not self._frames and self._settings.records_kept is not None:
            # A little at a time: no verdict may wait for it.
            self._stores.records.prune(self._settings.records_kept, self._utc())
        if self._journal_due_s is not None and now_s >= self._journal_due_s and not self._frames:
            yield from self._reconcile(now_s)

    def health(self) -> Health:
        values: dict[str, float | int | str | bool | None] = {
            "judged": len(self._judged),
            "last_ms": round(self._last_ms, 2),
            "unrecorded": len(self._unrecorded),
            "is_reconciled": self._journal_due_s is None,
        }
        if self._stores is None:
            return Health("ready", "", values)
        has_room = self._stores.room.has_room()
        # fieldbus withdraws Ready: nothing may be accepted that cannot be recorded.
        values["accepts"] = has_room and not self._unrecorded
        values["frames_left_out"] = self._stores.frames.left_out
        if self._unrecorded:
            return Health("degraded", self._fault, values)
        if not has_room:
            return Health("degraded", "no room on disk to record a cycle; free space", values)
        return Health("ready", "", values)

    def close(self) -> None:
        if self._stores is not None:
            self._stores.frames.close()
            self._stores.records.close()
        if self._lock is not None:
            self._lock.close()

    # --- the cycle ---

    def on_frame(self, frame: Frame) -> Iterable[Message]:
        """Hold the frame until its verdict says how long it is worth keeping."""
        if self._stores is not None and frame.pixels.size:
            self._frames[frame.cycle_id] = frame
            while len(self._frames) > _FRAMES_WAITING:
                _, old = self._frames.popitem(last=False)
                self._stores.frames.put(old.pixels, Class.NOT_MEASURED)
        return ()

    def on_line_points(self, points: LinePoints) -> Iterator[Message]:
        """One Verdict per cycle, on record before it is said; then the maps for the eye."""
        if self._was_judged(points.cycle_id):
            return
        start_s = time.perf_counter()
        known, setup, judgement = self._judge(points)
        verdict = self._verdict(points, known, judgement, 1e3 * (time.perf_counter() - start_s))
        verdict = self._recorded(verdict)
        self._note(verdict.cycle_id)
        yield verdict
        if judgement.comparison is not None and setup is not None:
            yield self._view(verdict, setup, judgement)
        self._keep_frame(verdict)
        yield from self._after(points, verdict)

    def on_outcome(self, outcome: Outcome) -> Iterator[Message]:
        """What the PLC was told, on record; a cycle that was never judged gets its one record now."""
        if self._stores is None:
            return
        yield from self._record_outcome(outcome)
        self._drop_frame(outcome.cycle_id)
        self._measure_trend(outcome.request.object_index)

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

    def _recorded(self, verdict: Verdict) -> Verdict:
        """The verdict once it is on disk; one that cannot be written must not be told as Passed."""
        if self._stores is None:
            return verdict
        try:
            self._append(Cycle(verdict, None, self._utc(), self._clock()))
        except RecordError as error:
            verdict = _unmeasured(verdict, ResultCode.DISK, str(error))
            self._unrecorded.append(verdict)
            self._fault = str(error)
        return verdict

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
        if verdict.mean_error_mm is not None:
            MEAN_ERROR.labels(self._cell, str(index)).set(verdict.mean_error_mm)
            WEAR.labels(self._cell, str(index), WHOLE).set(verdict.wear_mm or 0.0)
            for zone in verdict.zones:
                if zone.wear_mm is not None:
                    WEAR.labels(self._cell, str(index), zone.name).set(zone.wear_mm)
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
        frame = self._frames.pop(verdict.cycle_id, None)
        if frame is not None and self._stores is not None:
            kinds = {Decision.PASSED: Class.PASSED, Decision.NOT_MEASURED: Class.NOT_MEASURED}
            self._stores.frames.put(frame.pixels, kinds.get(verdict.decision, Class.FAILED))

    def _drop_frame(self, cycle_id: str) -> None:
        frame = self._frames.pop(cycle_id, None)
        if frame is not None and self._stores is not None:
            self._stores.frames.put(frame.pixels, Class.NOT_MEASURED)

    # --- records ---

    def _append(self, cycle: Cycle) -> int:
        """Commit; on a full disk once more with the room that the reserve held.

        Raises:
            RecordError: it could not be made durable.
        """
        assert self._stores is not None
        try:
            return self._stores.records.append((cycle,))
        except RecordError:
            if not self._stores.room.free_reserve():
                raise
            return self._stores.records.append((cycle,))

    def _record_outcome(self, outcome: Outcome) -> Iterator[Message]:
        assert self._stores is not None
        try:
            records = self._stores.records
            if any(isinstance(m, Verdict) and m.cycle_id == outcome.cycle_id for m in self._unrecorded):
                raise RecordError("its verdict is not on record yet", f"cycle {outcome.cycle_id}")
            if records.has_verdict(outcome.cycle_id):
                self._append(Cycle(None, outcome, self._utc()))
                return
            verdict = self._never_judged(outcome.request, outcome)
            if self._append(Cycle(verdict, outcome, self._utc(), self._clock())):
                yield self._event("warning", f"never judged: {verdict.reason}", outcome.cycle_id)
            self._note(outcome.cycle_id)
        except RecordError as error:
            self._unrecorded.append(outcome)
            self._fault = str(error)

    def _never_judged(self, request: Any, outcome: Outcome) -> Verdict:
        """The record of a cycle of which no line points came in time."""
        code = ResultCode.INTERRUPTED
        if outcome.code in CODE_MEANING and outcome.code >= ResultCode.LATE:
            code = ResultCode(outcome.code)
        reason = CODE_MEANING[code]
        if outcome.code < ResultCode.LATE:
            reason = f"no verdict is on record, though the PLC was told code {outcome.code}"
        return Verdict(
            cycle_id=outcome.cycle_id,
            is_simulated=outcome.is_simulated,
            request=request,
            decision=Decision.NOT_MEASURED,
            code=int(code),
            reason=reason,
            code_version=self._version,
        )

    def _catch_up(self) -> Iterator[Message]:
        """Write what the disk refused, in its order."""
        assert self._stores is not None
        waiting, self._unrecorded = self._unrecorded, deque()
        count = len(waiting)
        while waiting:
            message = waiting.popleft()
            try:
                if isinstance(message, Verdict):
                    self._append(Cycle(message, None, self._utc(), self._clock()))
                elif self._stores.records.has_verdict(message.cycle_id):
                    self._append(Cycle(None, message, self._utc()))
                else:
                    self._append(
                        Cycle(self._never_judged(message.request, message), message, self._utc(), self._clock())
                    )
            except RecordError as error:
                self._fault = str(error)
                self._unrecorded = deque([message, *waiting])
                return
        self._fault = ""
        yield self._event("info", f"{count} entries that could not be recorded before are on record now")

    def _reconcile(self, now_s: float) -> Iterator[Message]:
        """Give every journalled cycle that has its outcome the record that it lacks."""
        if self._stores is None or self._asker is None:
            self._journal_due_s = None
            return
        records = self._stores.records
        try:
            since = records.mark(_RECONCILED)
            answer = self._asker.ask(JOURNAL, AskJournal(since_utc=since), timeout_s=_JOURNAL_TIMEOUT_S)
        except (BusError, RecordError):
            self._journal_due_s = now_s + _JOURNAL_PAUSE_S
            return
        entries = answer.entries if isinstance(answer, Journal) else ()
        # A cycle without an outcome is still under way; fieldbus gives it one in any case.
        for entry in entries:
            if entry.outcome is not None and not records.has_outcome(entry.request.cycle_id):
                yield from self._record_outcome(entry.outcome)
        if self._unrecorded:
            self._journal_due_s = now_s + _JOURNAL_PAUSE_S
            return
        newest = _newest_ended(entries)
        if newest <= since:
            self._journal_due_s = None
            return
        # An answer is bounded: go on from its last entry, with the next tick.
        records.set_mark(_RECONCILED, newest)
        self._journal_due_s = now_s

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
        return Records(
            rows=records.rows(asked),
            total=sum(counts.values()),
            trends=tuple(self._trend(index) for index in wanted) if asked.with_trends else (),
            passed=counts.get(Decision.PASSED, 0),
            failed=counts.get(Decision.FAILED, 0) + counts.get(Decision.UNSURE, 0),
            not_measured=counts.get(Decision.NOT_MEASURED, 0),
        )

    def on_die_event(self, done: DieEvent) -> Done:
        records = self._need_stores().records
        stroke = records.newest_stroke(done.object_index)
        if stroke is None and done.object_index not in self._need_stores().objects.objects():
            return Done(ok=False, text=f"object {done.object_index} is not in the object list")
        records.append_die_event(done, stroke or 0, self._utc())
        self._measure_trend(done.object_index)
        return Done(ok=True, text=f"{done.kind} of object {done.object_index} recorded at stroke {stroke or 0}")

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

    # --- trend ---

    def _trend(self, index: int) -> WearTrend:
        records = self._need_stores().records
        newest = records.newest_wear(index, last=_FEW_RECORDS)
        fitted = self._fit(index, newest[-_TREND_POINTS:])
        points = fitted.points
        if len(newest) == _FEW_RECORDS:
            bins = records.wear_bins(index)
            step = -(-len(bins) // 300)
            points = tuple((stroke, wear) for stroke, wear, _ in bins[(len(bins) - 1) % step :: step])
        events = records.die_events(index)
        stroke = records.newest_stroke(index) or 0
        start = events[-1][0] if events else (records.first_stroke(index) or 0)
        return WearTrend(
            object_index=index,
            points=points,
            wear_mm=fitted.wear_mm,
            slope_mm_per_kilostroke=fitted.slope_mm_per_kilostroke,
            slope_sigma=fitted.slope_sigma,
            limit_mm=fitted.limit_mm,
            remaining_p10=fitted.remaining_p10,
            remaining_p50=fitted.remaining_p50,
            remaining_p90=fitted.remaining_p90,
            strokes_since_service=max(stroke - start, 0),
            die_events=tuple(events),
        )

    def _fit(self, index: int, newest: list[tuple[int, float, float]]) -> Trend:
        strokes, wears, means = ([row[k] for row in newest] for k in range(3))
        limit = None
        try:
            known = self._references.object_recipe(index)
            limit = wear_limit(parse_recipe(known.recipe_yaml), means, wears)
        except WearlineError:
            # Records outlive the object list; a trend without a limit is still one.
            pass
        return wear_trend([int(s) for s in strokes], wears, limit)

    def _measure_trend(self, index: int) -> None:
        if self._stores is None:
            return
        trend = self._trend(index)
        place = (self._cell, str(index))
        SINCE_SERVICE.labels(*place).set(trend.strokes_since_service)
        if trend.slope_mm_per_kilostroke is not None:
            SLOPE.labels(*place, WHOLE).set(trend.slope_mm_per_kilostroke)
        for quantile, strokes in (
            ("0.1", trend.remaining_p10), ("0.5", trend.remaining_p50), ("0.9", trend.remaining_p90)
        ):  # fmt: skip
            # What is not identifiable must not keep its last value on a dashboard.
            REMAINING.labels(*place, WHOLE, quantile).set(float("nan") if strokes is None else strokes)

    def _need_stores(self) -> Stores:
        if self._stores is None:
            raise RecordError("keeps no records", "an offline judge", "ask a running cell")
        return self._stores

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


def _newest_ended(entries: Iterable[JournalEntry]) -> str:
    """When the last entry before the first one that is still under way was accepted; empty = there is none."""
    newest = ""
    for entry in entries:
        if entry.outcome is None:
            break
        newest = entry.accepted_utc
    return newest


def _unmeasured(verdict: Verdict, code: ResultCode, reason: str) -> Verdict:
    """The verdict without its figures."""
    return verdict.replace(
        decision=Decision.NOT_MEASURED, code=int(code), reason=reason, mean_error_mm=None, max_error_mm=None,
        wear_mm=None, deviating_area_mm2=None, deviating_area_px=None, regions=(),
    )  # fmt: skip


def open_records(cell: CellSettings, settings: JudgeSettings, *, must_exist: bool = False) -> RecordStore:
    """The records of a cell.

    Raises:
        ConfigError: judge.records_url is no URL.
        RecordError: the records or the key cannot be used.
    """
    folder = cell.data_folder("judge")
    url = settings.records_url or sqlite_url(folder / "records.db")
    return RecordStore(url, key_of(folder / "chain.key"), must_exist=must_exist)


def open_stores(cell: CellSettings, settings: JudgeSettings) -> Stores:
    """The stores of a cell.

    Raises:
        ConfigError: judge.records_url is no URL.
        RecordError: the records cannot be used.
    """
    folder = cell.data_folder("judge")
    room = Room(folder, settings)
    return Stores(
        ObjectFile(folder / "objects.json"),
        BlobStore(folder),
        open_records(cell, settings),
        FrameStore(folder / "frames", settings, room.is_low),
        room,
    )


def build(cell: CellSettings, settings: JudgeSettings) -> Service:
    """The live service.

    Raises:
        ConfigError: judge.records_url is no URL.
        RecordError: the records cannot be used.
    """
    cv2.setNumThreads(1)  # a pool of threads would take the processors from the other services
    lock = FolderLock(cell.data_folder("judge"))
    stores = open_stores(cell, settings)
    return Judge(
        cell.cell, settings, StoredReferences(stores.objects, stores.blobs), stores,
        accepts_simulated=cell.plc_is_simulated, version=code_version(), lock=lock,
    )  # fmt: skip


def offline(asker: Asker) -> Service:
    """The same handlers without files of their own."""
    cv2.setNumThreads(1)
    service = Judge("offline", JudgeSettings(), AskedReferences(asker), version=code_version())
    for _ in service.start(asker):
        pass
    return service
