"""The judge as a service: what it says, records and answers, and every refusal."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from prometheus_client import generate_latest

from tests.unit.judge.parts import (
    CALIBRATION_BYTES,
    CALIBRATION_HASH,
    Part,
    golden_template,
    line_points,
    request,
)
from wearline.config import CellSettings
from wearline.errors import BusError, RecordError
from wearline.messages import (
    Acknowledge,
    AskArtifact,
    AskRecipe,
    AskRecords,
    AskWearMap,
    Decision,
    DieEvent,
    Event,
    Frame,
    Journal,
    JournalEntry,
    LinePoints,
    MeasureRequest,
    Message,
    Outcome,
    Ping,
    Records,
    ResultCode,
    Teach,
    Verdict,
    View,
)
from wearline.metrics import REGISTRY
from wearline.recipe import Limits, Recipe, Zone
from wearline.topics import JOURNAL, Query
from wearline_judge.config import JudgeSettings
from wearline_judge.core.alarms import AlarmLevel, AlarmSettings
from wearline_judge.drivers.frames import pixel_hash
from wearline_judge.drivers.records import Cycle, RecordStore
from wearline_judge.drivers.references import StoredReferences
from wearline_judge.service import Judge, Stores, open_stores
from wearline_judge.service.trends import ALARM

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

TEMPLATE_BYTES = golden_template().to_bytes()
START = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)


@dataclass
class Fieldbus:
    """Answers for the journal, or is not there."""

    entries: list[JournalEntry] = field(default_factory=list)
    is_there: bool = True
    asked: list[str] = field(default_factory=list)
    most: int = 1000

    def ask(self, query: Query, question: Message, argument: str = "", timeout_s: float = 1.0) -> Message:
        assert query == JOURNAL
        self.asked.append(getattr(question, "since_utc", ""))
        if not self.is_there:
            raise BusError("nobody answers", "wearline/test/fieldbus/do/journal", "is fieldbus running?")
        since = self.asked[-1]
        return Journal(entries=tuple([e for e in self.entries if e.accepted_utc >= since][: self.most]))


class Clock:
    """Monotonic and UTC that tests move."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s

    def utc(self) -> datetime:
        return START + timedelta(seconds=self.now_s)


@dataclass
class Cell:
    """A judge with one object on disk."""

    folder: Path
    recipe: Recipe = field(default_factory=Recipe)
    fieldbus: Fieldbus = field(default_factory=Fieldbus)
    clock: Clock = field(default_factory=Clock)
    settings: JudgeSettings = field(default_factory=JudgeSettings)
    plc_is_simulated: bool = True

    def __post_init__(self) -> None:
        self.stores = self.opened()
        blobs = self.stores.blobs
        template = golden_template(self.recipe).to_bytes() if self.recipe != Recipe() else TEMPLATE_BYTES
        self.stores.objects.add(
            1, "tray", blobs.put_recipe(self.recipe), blobs.put_artifact(CALIBRATION_BYTES),
            blobs.put_artifact(template), "2026-01-01T00:00:00+00:00",
        )  # fmt: skip
        self.judge = self.made()

    def opened(self) -> Stores:
        return open_stores(CellSettings(cell="test", data_dir=self.folder), self.settings)

    def made(self) -> Judge:
        judge = Judge(
            "test", self.settings, StoredReferences(self.stores.objects, self.stores.blobs), self.stores,
            accepts_simulated=self.plc_is_simulated, version="v1", clock=self.clock, utc=self.clock.utc,
        )  # fmt: skip
        assert list(judge.start(self.fieldbus)) == []
        return judge

    def restart(self) -> None:
        self.judge.close()
        self.stores = self.opened()
        self.judge = self.made()

    def judged(self, part: Part, stroke: int = 1, **options: object) -> Verdict:
        points = line_points(part, stroke, recipe=self.recipe)
        return self.said(points.replace(**options) if options else points)

    def said(self, points: LinePoints) -> Verdict:
        first, *_ = self.judge.on_line_points(points)
        assert isinstance(first, Verdict)
        return first

    def records(self, last: int = 100) -> Records:
        return self.judge.on_records(AskRecords(last=last))


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Callable[..., Cell]]:
    def made(**options: Any) -> Cell:
        cell = Cell(tmp_path, **options)
        cells.append(cell)
        return cell

    cells: list[Cell] = []
    yield made
    for cell in cells:
        cell.judge.close()


@pytest.fixture
def cell(make: Callable[..., Cell]) -> Cell:
    return make()


def outcome(stroke: int = 1, code: int = 1, was_told: bool = True, asked: MeasureRequest | None = None) -> Outcome:
    asked = asked or request(stroke)
    return Outcome(
        cycle_id=asked.cycle_id, is_simulated=asked.is_simulated, request=asked, code=code, passed=code == 1,
        failed=code != 1, was_told=was_told, cycle_seconds=0.25, told_utc="2026-01-02T03:05:00.000+00:00",
    )  # fmt: skip


def entry(stroke: int, told: Outcome | None) -> JournalEntry:
    return JournalEntry(
        request=request(stroke), is_simulated=False, accepted_utc=f"2026-01-02T03:04:{stroke:02d}.000+00:00",
        outcome=told,
    )  # fmt: skip


def test_a_verdict_comes_first_with_its_references_then_the_maps(cell: Cell) -> None:
    points = line_points(Part(flaw_mm=0.3), 5)
    verdict, view = cell.judge.on_line_points(points)
    assert isinstance(verdict, Verdict) and isinstance(view, View)
    assert verdict.decision is Decision.FAILED and verdict.request == points.request
    assert verdict.frame_hash == points.frame_hash and verdict.calibration_hash == CALIBRATION_HASH
    assert verdict.recipe_hash == points.recipe_hash and len(verdict.template_hash) == 64
    assert verdict.code_version == "v1" and verdict.quality == points.quality
    assert verdict.timings_ms["reconstruct"] == 12.5 and verdict.timings_ms["judge"] > 0
    assert verdict.timings_ms["total"] == pytest.approx(12.5 + verdict.timings_ms["judge"], abs=0.01)
    assert view.cycle_id == verdict.cycle_id and view.decision is verdict.decision and view.stroke == 5
    assert view.maps_mm.shape[0] == 4 and view.mm_per_pixel == 0.1


def test_the_verdict_is_on_disk_before_it_is_said(cell: Cell, tmp_path: Path) -> None:
    said = iter(cell.judge.on_line_points(line_points(Part(), 3)))
    verdict = next(said)
    other = RecordStore(f"sqlite:///{tmp_path}/judge/records.db", b"k" * 32)
    assert other.verdict("c-00003") == verdict
    other.close()


def test_a_cycle_is_judged_once_also_across_a_restart(cell: Cell) -> None:
    points = line_points(Part(), 3)
    assert cell.said(points).decision is Decision.PASSED
    assert list(cell.judge.on_line_points(points)) == []
    cell.restart()
    assert list(cell.judge.on_line_points(points.replace(points=points.points[:10]))) == []
    assert cell.records().total == 1


def test_refusals_carry_their_code(make: Callable[..., Cell]) -> None:
    cell = make()
    good = line_points(Part(), 1)
    stroke = iter(range(10, 99))

    def refused(points: LinePoints) -> Verdict:
        points = points.replace(cycle_id=f"r-{next(stroke)}")
        found = cell.said(points)
        assert found.decision is Decision.NOT_MEASURED and found.mean_error_mm is None and found.reason
        return found

    assert refused(good.replace(refusal_code=11, refusal="no frame")).code == ResultCode.NO_FRAME
    assert refused(good.replace(request=request(1, 7))).code == ResultCode.UNKNOWN_OBJECT
    assert refused(good.replace(recipe_hash="0" * 64)).code == ResultCode.RECIPE_CHANGED
    assert refused(good.replace(calibration_hash="0" * 64)).code == ResultCode.RECIPE_CHANGED
    blobs, objects = cell.stores.blobs, cell.stores.objects
    recipe, calibration = blobs.put_recipe(cell.recipe), blobs.put_artifact(CALIBRATION_BYTES)
    other = blobs.put_artifact(CALIBRATION_BYTES + b" ")
    for template, used, said in (
        ("", calibration, "has no template"),
        ("0" * 64, calibration, "is not here"),
        (blobs.put_artifact(b"no archive"), calibration, "cannot be used"),
        (blobs.put_artifact(TEMPLATE_BYTES), other, "another calibration"),
    ):
        objects.add(1, "tray", recipe, used, template, "")
        found = refused(good.replace(calibration_hash=used))
        assert found.code == ResultCode.NO_TEMPLATE and said in found.reason
    objects.add(1, "tray", recipe, calibration, blobs.put_artifact(TEMPLATE_BYTES), "")
    assert cell.said(good).decision is Decision.PASSED


def test_an_own_fault_is_not_measured_and_never_passed(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("own fault")

    monkeypatch.setattr("wearline_judge.service.judge.judge_points", fail)
    found = cell.judged(Part())
    assert found.decision is Decision.NOT_MEASURED and "own fault" in found.reason and 10 <= found.code <= 99


def test_a_simulated_part_is_refused_where_the_plc_is_real(make: Callable[..., Cell]) -> None:
    real = make(plc_is_simulated=False)
    found = real.judged(Part(), 1, is_simulated=True)
    assert found.code == ResultCode.SIMULATED_REFUSED and found.is_simulated
    assert real.judged(Part(), 2).decision is Decision.PASSED


def test_what_cannot_be_recorded_is_not_passed_and_is_recorded_later(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> bool:
        raise RecordError("the records cannot be used (database or disk is full)", "records.db", "free space")

    with monkeypatch.context() as broken:
        broken.setattr(cell.stores.records, "append", full)
        found = cell.judged(Part(), 1)
        assert found.decision is Decision.NOT_MEASURED and found.code == ResultCode.DISK
        assert list(cell.judge.on_outcome(outcome(1, ResultCode.DISK))) == []
        health = cell.judge.health()
        assert health.status == "degraded" and health.values["accepts"] is False
        assert list(cell.judge.tick(200.0)) == []
    (told,) = [m for m in cell.judge.tick(201.0) if isinstance(m, Event)]
    assert "2 entries" in told.text
    assert cell.judge.health().status == "ready"
    (row,) = cell.records().rows
    assert row.code == ResultCode.DISK and row.told_code == ResultCode.DISK


def test_a_long_journal_is_taken_page_by_page(cell: Cell) -> None:
    fieldbus = cell.fieldbus
    fieldbus.most = 3
    fieldbus.entries = [entry(stroke, outcome(stroke, ResultCode.LATE)) for stroke in range(1, 9)]
    for turn in range(6):
        list(cell.judge.tick(101.0 + turn))
    assert cell.records().total == 8 and cell.judge.health().values["is_reconciled"] is True


def test_low_disk_withdraws_readiness_and_the_reserve_carries_what_is_under_way(
    make: Callable[..., Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = make(settings=JudgeSettings(min_free_mb=1.0, reserve_mb=0.5))
    reserve = cell.folder / "judge" / "reserve"
    assert cell.judge.health().values["accepts"] is True and reserve.stat().st_size == 500_000
    free = {"bytes": 900_000}
    monkeypatch.setattr(cell.stores.room, "_free", lambda _: free["bytes"])
    health = cell.judge.health()
    assert health.status == "degraded" and health.values["accepts"] is False and "free space" in health.detail
    append = cell.stores.records.append

    def full_while_reserved(cycles: Sequence[Cycle]) -> int:
        if reserve.exists():
            raise RecordError("the records cannot be used (database or disk is full)", "records.db", "free space")
        return append(cycles)

    monkeypatch.setattr(cell.stores.records, "append", full_while_reserved)
    assert cell.judged(Part(), 1).decision is Decision.PASSED
    list(cell.judge.on_outcome(outcome(1)))
    assert cell.records().rows[0].told_code == 1 and not reserve.exists()
    assert cell.judge.health().values["accepts"] is False
    # Room for records alone is not enough: the reserve must be whole again.
    free["bytes"] = 1_400_000
    assert cell.judge.health().values["accepts"] is False
    free["bytes"] = 2_000_000
    assert cell.judge.health().values["accepts"] is True and reserve.stat().st_size == 500_000


@pytest.mark.slow
def test_a_disk_that_is_really_full_costs_no_record(tmp_path: Path) -> None:
    """On a file system of 12 MB, mounted for the test (needs root)."""
    folder = tmp_path / "small"
    folder.mkdir()
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=12m", "wearline", str(folder)], capture_output=True)
    if mount.returncode != 0:
        pytest.skip("a file system cannot be mounted here")
    cell: Cell | None = None
    try:
        cell = Cell(folder, settings=JudgeSettings(min_free_mb=0.5, reserve_mb=1.0))
        assert cell.judge.health().values["accepts"] is True
        filler = folder / "filler"
        with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(65536))
        assert cell.judge.health().values["accepts"] is False
        # What was accepted before is recorded all the same, by the reserve.
        assert cell.judged(Part(flaw_mm=0.3), 1).decision is Decision.FAILED
        list(cell.judge.on_outcome(outcome(1, 2)))
        for stroke in range(2, 400):
            if cell.judged(Part(), stroke).code == ResultCode.DISK:
                break
            list(cell.judge.on_outcome(outcome(stroke)))
        else:
            pytest.fail("the disk never filled up")
        health = cell.judge.health()
        assert stroke > 8 and health.status == "degraded" and health.values["unrecorded"] == 1
        list(cell.judge.on_outcome(outcome(stroke, ResultCode.DISK)))
        filler.unlink()
        told = [m.text for m in cell.judge.tick(1e4) if isinstance(m, Event)]
        assert any("2 entries" in text for text in told)
        assert cell.judge.health().values["accepts"] is True
        assert cell.records().total == stroke and cell.records().rows[0].told_code == ResultCode.DISK
        assert len(list(cell.stores.records.verified())) == 2 * stroke
    finally:
        if cell is not None:
            cell.judge.close()
        subprocess.run(["umount", "-l", str(folder)], check=True)


def test_one_url_puts_the_records_elsewhere(make: Callable[..., Cell], database: Callable[[str], str]) -> None:
    cell = make(recipe=ZONED, settings=JudgeSettings(records_url=database("elsewhere")))
    run(cell, range(1, 4), lambda _: 0.6)
    cell.restart()
    found = cell.records()
    assert (found.total, found.failed) == (3, 3) and found.rows[0].told_code == ResultCode.FAILED
    assert found.trends[0].alarm_level == AlarmLevel.STOP
    assert cell.judge.on_wear_map(AskWearMap(object_index=1)).parts == 3
    assert len(list(cell.stores.records.verified())) == 6


def test_records_beyond_the_quota_are_pruned_and_the_chain_still_verifies(make: Callable[..., Cell]) -> None:
    cell = make(settings=JudgeSettings(records_kept=3))
    for stroke in range(1, 6):
        cell.judged(Part(), stroke)
    list(cell.judge.tick(200.0))
    assert [row.stroke for row in cell.records().rows] == [5, 4, 3] and cell.records().total == 5
    assert [entry.number for entry in cell.stores.records.verified()] == [3, 4, 5]


def test_the_outcome_completes_the_record(cell: Cell) -> None:
    cell.judged(Part(), 1)
    (row,) = cell.records().rows
    assert row.told_code is None and row.cycle_seconds is None
    list(cell.judge.on_outcome(outcome(1)))
    list(cell.judge.on_outcome(outcome(1)))
    (row,) = cell.records().rows
    assert row.told_code == 1 and row.cycle_seconds == 0.25
    cell.judged(Part(), 2)
    list(cell.judge.on_outcome(outcome(2, 10, was_told=False)))
    assert cell.records().rows[0].told_code is None
    assert [e.kind for e in cell.stores.records.entries()] == ["verdict", "outcome"] * 2


def test_a_cycle_that_was_never_seen_gets_its_one_record_with_its_outcome(cell: Cell) -> None:
    (event,) = cell.judge.on_outcome(outcome(4, ResultCode.LATE))
    assert isinstance(event, Event) and event.cycle_id == "c-00004"
    (row,) = cell.records().rows
    assert row.decision is Decision.NOT_MEASURED and row.code == ResultCode.LATE and row.told_code == ResultCode.LATE
    # The line points that come after all must not make a second record.
    assert list(cell.judge.on_line_points(line_points(Part(), 4))) == []
    assert cell.records().total == 1


def test_the_start_reconciles_with_the_journal_until_fieldbus_answers(cell: Cell) -> None:
    fieldbus = cell.fieldbus
    cell.judged(Part(), 1)
    fieldbus.entries = [
        entry(1, outcome(1)),
        entry(2, outcome(2, ResultCode.SERVICE_LOST)),
        entry(3, outcome(3, ResultCode.PASSED)),
        entry(4, None),
    ]
    fieldbus.is_there = False
    assert list(cell.judge.tick(100.0)) == []
    assert len(fieldbus.asked) == 1 and cell.judge.health().values["is_reconciled"] is False
    list(cell.judge.tick(100.5))
    assert len(fieldbus.asked) == 1
    fieldbus.is_there = True
    list(cell.judge.tick(103.0))
    assert cell.judge.health().values["is_reconciled"] is False  # an answer is bounded: there may be more
    list(cell.judge.tick(103.5))
    assert cell.judge.health().values["is_reconciled"] is True
    rows = {row.cycle_id: row for row in cell.records().rows}
    assert set(rows) == {"c-00001", "c-00002", "c-00003"}
    assert rows["c-00001"].decision is Decision.PASSED and rows["c-00001"].told_code == 1
    assert rows["c-00002"].code == ResultCode.SERVICE_LOST and rows["c-00002"].decision is Decision.NOT_MEASURED
    # The PLC was told Passed, but no verdict is on record: the record must not claim one.
    assert rows["c-00003"].decision is Decision.NOT_MEASURED and rows["c-00003"].code == ResultCode.INTERRUPTED
    list(cell.judge.tick(110.0))
    assert len(fieldbus.asked) == 3
    # Cycle 4 was under way; what fieldbus says of it when it comes back is recorded, the others not twice.
    fieldbus.entries[3] = entry(4, outcome(4, ResultCode.INTERRUPTED))
    cell.judge.on_alive("fieldbus", False)
    cell.judge.on_alive("fieldbus", True)
    list(cell.judge.tick(cell.clock()))
    assert fieldbus.asked[-1] == "2026-01-02T03:04:03.000+00:00"
    assert cell.records().total == 4 and cell.records().rows[0].code == ResultCode.INTERRUPTED


def test_records_are_newest_first_with_counts_and_verdicts(cell: Cell) -> None:
    for stroke, flaw in enumerate((0.0, 0.3, 0.0), 1):
        cell.judged(Part(flaw_mm=flaw), stroke)
    cell.judged(Part(hidden=(0, 600)), 4)
    found = cell.records(3)
    assert [row.stroke for row in found.rows] == [4, 3, 2]
    assert (found.total, found.passed, found.failed, found.not_measured) == (4, 2, 1, 1)
    (one,) = cell.judge.on_records(AskRecords(cycle_id="c-00002", with_verdict=True)).rows
    assert Verdict.model_validate_json(one.verdict_json).decision is Decision.FAILED
    assert one.utc == cell.clock.utc().isoformat(timespec="milliseconds")
    assert cell.judge.on_records(AskRecords(object_index=9)).total == 0


def test_records_are_found_by_part_stroke_and_decision_page_by_page(cell: Cell) -> None:
    for stroke in (1, 2, 12):
        cell.judged(Part(flaw_mm=0.3 if stroke == 2 else 0.0), stroke)
    answer = cell.judge.on_records

    def strokes(**wanted: Any) -> list[int]:
        return [row.stroke for row in answer(AskRecords(**wanted)).rows]

    assert strokes(search="2") == [12, 2]
    assert strokes(search="p12") == [12]
    assert strokes(search="%") == strokes(search="_") == strokes(search="99999999999999999999") == []
    assert strokes(decisions=(Decision.FAILED,)) == [2]
    assert strokes(decisions=(Decision.FAILED, Decision.PASSED)) == [12, 2, 1]
    first = answer(AskRecords(last=2)).rows
    assert [row.stroke for row in first] == [12, 2]
    assert strokes(last=2, before=first[-1].record_id) == [1]
    assert answer(AskRecords(with_trends=False)).trends == ()


def test_wear_rises_towards_the_limit_and_a_die_event_starts_anew(make: Callable[..., Cell]) -> None:
    cell = make(recipe=Recipe(limits=Limits(max_error_mm=0.5)))
    for stroke in range(1, 25):
        cell.judged(Part(flaw_mm=0.1 + 0.01 * stroke), stroke * 10)
    (trend,) = cell.records().trends
    # Wear is the 95th percentile of half an ellipsoid: 0.975 of its top.
    assert trend.slope_mm_per_kilostroke == pytest.approx(0.975, rel=0.1)
    assert trend.wear_mm == pytest.approx(0.33, abs=0.03) and trend.limit_mm == 0.5
    assert trend.remaining_p10 is not None and trend.remaining_p50 is not None and trend.remaining_p90 is not None
    assert trend.remaining_p10 <= trend.remaining_p50 <= trend.remaining_p90
    assert trend.remaining_p50 == pytest.approx((0.5 - 0.33) / 0.000975, rel=0.25)
    assert trend.strokes_since_service == 230 and len(trend.points) == 24
    text = generate_latest(REGISTRY).decode()
    assert 'wearline_remaining_strokes{cell="test",object="1",quantile="0.5",zone="part"} 1' in text
    done = cell.judge.on_die_event(DieEvent(object_index=1, kind="regrind", user="ada"))
    assert done.ok and "240" in done.text
    (trend,) = cell.records().trends
    assert trend.die_events == ((240, "regrind"),) and trend.points == () and trend.strokes_since_service == 0
    cell.judged(Part(flaw_mm=0.15), 250)
    list(cell.judge.on_outcome(outcome(250)))
    (trend,) = cell.records().trends
    assert [stroke for stroke, _ in trend.points] == [250] and trend.strokes_since_service == 10
    assert not cell.judge.on_die_event(DieEvent(object_index=5, kind="polish")).ok
    text = generate_latest(REGISTRY).decode()
    assert 'wearline_strokes_since_service{cell="test",object="1"} 10.0' in text
    assert 'wearline_remaining_strokes{cell="test",object="1",quantile="0.5",zone="part"}' not in text
    assert 'wearline_wear_millimeters{cell="test",object="1",zone="part"} 0.1' in text


ZONED = Recipe(
    limits=Limits(max_error_mm=0.5),
    zones=(
        Zone(name="flaw", polygon_px=((260, 170), (400, 170), (400, 310), (260, 310)), limits=Limits(max_error_mm=0.3)),
        Zone(name="rim", polygon_px=((450, 60), (600, 60), (600, 400), (450, 400))),
    ),
)


def run(cell: Cell, strokes: range, flaw_mm: Callable[[int], float]) -> list[Event]:
    """Whole cycles, and ticks until every trend is up to date."""
    said: list[Event] = []
    for stroke in strokes:
        verdict = cell.judged(Part(flaw_mm=flaw_mm(stroke)), stroke)
        list(cell.judge.on_outcome(outcome(stroke, verdict.code)))
        for turn in range(3):
            said += [m for m in cell.judge.tick(1000.0 + stroke + 0.1 * turn) if isinstance(m, Event)]
    return said


def test_every_zone_has_a_trend_with_its_own_limit(make: Callable[..., Cell]) -> None:
    cell = make(recipe=ZONED)
    run(cell, range(1, 21), lambda s: 0.08 + 0.008 * s)
    part, flaw, rim = cell.records().trends
    assert (part.zone, flaw.zone, rim.zone) == ("", "flaw", "rim")
    assert (part.limit_mm, flaw.limit_mm, rim.limit_mm) == (0.5, 0.3, None)
    assert flaw.slope_mm_per_kilostroke == pytest.approx(7.8, rel=0.15)
    assert flaw.remaining_p50 is not None and part.remaining_p50 is not None
    assert flaw.remaining_p50 < part.remaining_p50
    assert rim.wear_mm == 0.0 and rim.remaining_p50 is None


def test_alarms_are_raised_held_acknowledged_and_remembered(make: Callable[..., Cell]) -> None:
    cell = make(recipe=ZONED, settings=JudgeSettings(alarms=AlarmSettings(bad_in_row=3, strokes_to_stop=5)))
    run(cell, range(1, 4), lambda _: 0.1)
    assert [t.alarm_level for t in cell.records().trends] == [0, 0, 0]
    said = run(cell, range(4, 8), lambda _: 0.6)
    assert any("object 1: stop: 3 parts in a row were not good" in event.text for event in said)
    part = cell.records().trends[0]
    assert part.alarm_level == AlarmLevel.STOP and part.acknowledged_by == "" and part.alarm_stroke == 6
    assert 'wearline_alarm_level{cell="test",object="1",zone="part"} 4.0' in generate_latest(REGISTRY).decode()
    # Held though its cause has gone, also across a restart, until somebody takes notice.
    run(cell, range(8, 10), lambda _: 0.1)
    cell.restart()
    assert cell.records().trends[0].alarm_level == AlarmLevel.STOP
    asked = Acknowledge(object_index=1, user="ada", reason="insert was loose, mended")
    assert not cell.judge.on_acknowledge(asked.replace(user="")).ok
    assert cell.judge.on_acknowledge(asked).ok
    assert not cell.judge.on_acknowledge(asked).ok
    assert cell.records().trends[0].alarm_level < AlarmLevel.WARNING
    # While its cause is there it stays, with the name of who knows of it.
    run(cell, range(10, 14), lambda _: 0.6)
    assert cell.judge.on_acknowledge(asked).ok
    part = cell.records().trends[0]
    assert part.alarm_level == AlarmLevel.STOP
    assert (part.acknowledged_by, part.acknowledged_reason) == ("ada", "insert was loose, mended")
    kinds = [entry.kind for entry in cell.stores.records.verified()]
    assert kinds.count("acknowledgement") == 2


def test_a_service_starts_trend_alarm_and_map_anew_but_another_coil_does_not(make: Callable[..., Cell]) -> None:
    cell = make(recipe=ZONED)
    run(cell, range(1, 12), lambda s: 0.1 + 0.01 * s)
    assert cell.judge.on_wear_map(AskWearMap(object_index=1)).parts == 11
    assert cell.judge.on_die_event(DieEvent(object_index=1, kind="coil_change")).ok
    part = cell.records().trends[0]
    assert len(part.points) == 11 and part.strokes_since_service == 10 and part.die_events == ((11, "coil_change"),)
    assert cell.judge.on_die_event(DieEvent(object_index=1, kind="regrind")).ok
    part = cell.records().trends[0]
    assert part.points == () and part.strokes_since_service == 0 and part.alarm_level == 0
    with pytest.raises(RecordError, match="no measured part"):
        cell.judge.on_wear_map(AskWearMap(object_index=1))


def test_the_wear_map_shows_where_errors_are_and_where_wear_grows(make: Callable[..., Cell]) -> None:
    cell = make(recipe=ZONED)
    run(cell, range(1, 13), lambda s: 0.1 + 0.01 * s)
    found = cell.judge.on_wear_map(AskWearMap(object_index=1))
    share, slope, sigma = found.maps
    # FLAW lies about x 330, y 240.
    at = ((240 - found.origin_px[1]) // found.square_px, (330 - found.origin_px[0]) // found.square_px)
    far = ((400 - found.origin_px[1]) // found.square_px, (550 - found.origin_px[0]) // found.square_px)
    assert share[at] == 1.0 and share[far] == 0.0
    assert slope[at] == pytest.approx(10.0, rel=0.2) and abs(slope[far]) < 5.0 * sigma[far] + 0.5
    cell.restart()
    again = cell.judge.on_wear_map(AskWearMap(object_index=1))
    assert np.array_equal(again.maps, found.maps, equal_nan=True) and again.parts == 12


def test_it_answers_for_the_object_list_and_artifacts(cell: Cell) -> None:
    known = cell.judge.on_recipe(AskRecipe(object_index=1))
    assert known.object_name == "tray" and known.calibration_hash == CALIBRATION_HASH and known.version == 1
    assert cell.judge.on_artifact(AskArtifact(content_hash=CALIBRATION_HASH)).content.tobytes() == CALIBRATION_BYTES
    (listed,) = cell.judge.on_recipe_list(Ping()).objects
    assert listed.template_hash == known.template_hash
    with pytest.raises(RecordError, match="object 2: is not in the object list"):
        cell.judge.on_recipe(AskRecipe(object_index=2))
    with pytest.raises(RecordError, match="is not here"):
        cell.judge.on_artifact(AskArtifact(content_hash="../objects"))


def test_a_release_from_outside_takes_effect_with_the_next_cycle(cell: Cell) -> None:
    strict = Recipe(limits=Limits(max_error_mm=0.1))
    blobs = cell.stores.blobs
    cell.opened().objects.add(
        1, "tray", blobs.put_recipe(strict), CALIBRATION_HASH, blobs.put_artifact(TEMPLATE_BYTES), ""
    )
    assert cell.judged(Part(), 1).code == ResultCode.RECIPE_CHANGED
    cell.recipe = strict
    assert cell.judged(Part(flaw_mm=0.2), 2).decision is Decision.FAILED
    cell.stores.objects.rollback(1)
    assert cell.judge.on_recipe(AskRecipe(object_index=1)).version == 1


def test_named_cycles_teach_a_template(cell: Cell) -> None:
    for stroke in range(1, 4):
        cell.judged(Part(flaw_mm=0.4), stroke)
    done = cell.judge.on_teach(Teach(object_index=1, cycle_ids=("c-00001", "c-00002", "c-00003"), user="ada"))
    assert done.ok and "version 2" in done.text
    assert cell.judged(Part(flaw_mm=0.4), 4).decision is Decision.PASSED
    assert cell.judged(Part(), 5).decision is Decision.FAILED
    assert cell.stores.objects.objects()[1].versions[1].person == "ada"
    missing = cell.judge.on_teach(Teach(object_index=1, cycle_ids=("c-00077",)))
    assert not missing.ok and "c-00077" in missing.text
    suspicious = cell.judge.on_teach(Teach(object_index=1, cycle_ids=("c-00001", "c-00002", "c-00005", "c-00003")))
    assert not suspicious.ok and "cycle c-00005: is suspicious" in suspicious.text
    with pytest.raises(RecordError, match="object 8"):
        cell.judge.on_teach(Teach(object_index=8, cycle_ids=()))


def test_the_next_parts_teach_an_object_that_has_no_template(make: Callable[..., Cell]) -> None:
    cell = make(settings=JudgeSettings(teach_frames=3))
    blobs = cell.stores.blobs
    cell.stores.objects.add(1, "tray", blobs.put_recipe(cell.recipe), CALIBRATION_HASH, "", "")
    assert cell.judge.on_teach(Teach(object_index=1, cycle_ids=())).ok
    events: list[Event] = []
    for stroke in range(1, 4):
        said = list(cell.judge.on_line_points(line_points(Part(), stroke)))
        assert isinstance(said[0], Verdict) and said[0].code == ResultCode.NO_TEMPLATE
        events += [m for m in said if isinstance(m, Event) and m.level == "info"]
    (event,) = events
    assert "version 3" in event.text
    assert cell.judged(Part(), 4).decision is Decision.PASSED


def test_a_frame_of_which_nothing_more_is_heard_does_not_keep_the_journal_waiting(cell: Cell) -> None:
    asked = request(5)
    frame = Frame(
        cycle_id=asked.cycle_id, is_simulated=False, request=asked, camera="c", pixels=np.zeros((4, 4), np.uint8),
        exposure_us=1e4, frame_counter=5,
    )  # fmt: skip
    cell.judge.on_frame(frame)
    list(cell.judge.tick(cell.clock() + 3.0))
    assert cell.fieldbus.asked == []
    list(cell.judge.tick(cell.clock() + 6.0))
    assert len(cell.fieldbus.asked) == 1


def test_trends_and_alarms_are_told_again_after_a_restart(cell: Cell) -> None:
    cell.judged(Part(), 7)
    list(cell.judge.on_outcome(outcome(7)))
    cell.restart()
    ALARM.clear()
    list(cell.judge.tick(200.0))
    assert 'wearline_alarm_level{cell="test",object="1",zone="part"} 0.0' in generate_latest(REGISTRY).decode()


def test_frames_are_stored_under_their_hash_after_the_verdict(make: Callable[..., Cell]) -> None:
    cell = make()
    rng = np.random.default_rng(1)
    pixels = [rng.integers(0, 60, (40, 60)).astype(np.uint8) for _ in range(3)]

    def frame(stroke: int) -> Frame:
        asked = request(stroke)
        return Frame(
            cycle_id=asked.cycle_id, is_simulated=False, request=asked, camera="c", pixels=pixels[stroke - 1],
            exposure_us=1e4, frame_counter=stroke,
        )  # fmt: skip

    for stroke, flaw in ((1, 0.0), (2, 0.3)):
        assert list(cell.judge.on_frame(frame(stroke))) == []
        cell.judged(Part(flaw_mm=flaw), stroke)
    cell.judge.on_frame(frame(3))
    list(cell.judge.on_outcome(outcome(3, ResultCode.LATE)))
    cell.stores.frames.close()
    folder = cell.folder / "judge" / "frames"
    assert {p.parent.parent.name for p in folder.glob("*/*/*.png")} == {"passed", "failed", "not_measured"}
    again = cell.opened().frames
    for image in pixels:
        assert np.array_equal(again.get(pixel_hash(image)), image)
