"""The cell as the screen knows it: frozen snapshots, made from messages and the monotonic clock.

A snapshot may be read by any thread; only the thread that handles messages makes the next one.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from wearline.messages import Event, Outcome, Preview, Records, ServiceState, Verdict, View, WearMap, WearTrend
from wearline.topics import SERVICES

STROKES_KEPT = 200
EVENTS_KEPT = 100
CHANGES_KEPT = 200
LIFE_SIGNALS = ("plc_life", "vision_life")
"""They change all the time and would hide the others."""


@dataclass(frozen=True)
class Stroke:
    """One row of the table of last strokes."""

    cycle_id: str
    stroke: int
    part_id: str
    utc: str
    """ISO 8601; empty until fieldbus or judge told the time."""
    decision: str
    code: int
    reason: str
    mean_mm: float | None
    max_mm: float | None
    cycle_ms: float | None
    """From the Measure edge to the result written; None while unknown. [ms]"""
    told_code: int | None
    """What the PLC was told; None until then."""
    is_simulated: bool
    object_index: int = 0


@dataclass(frozen=True)
class Seen:
    """The last state of one service, and when it arrived."""

    state: ServiceState | None = None
    at_s: float | None = None
    """Monotonic clock of this machine. [s]"""
    is_alive: bool | None = None
    """Its liveliness token; None = never heard of."""


@dataclass(frozen=True)
class SignalChange:
    """One change of the process image, as seen in fieldbus' states."""

    at_s: float
    """Monotonic clock. [s]"""
    name: str
    before: str
    after: str


@dataclass(frozen=True)
class CellState:
    """All that the page shows."""

    cell: str
    verdict: Verdict | None = None
    verdict_at_s: float | None = None
    """None also for a verdict that was given before this service joined the bus."""
    view: View | None = None
    view_at_s: float | None = None
    view_before: View | None = None
    """A browser may still be fetching it."""
    wear_map: WearMap | None = None
    """Where errors are frequent and wear grows, since the last service of the die."""
    signals: tuple[dict[str, Any], ...] = ()
    """Rows of the process image as fieldbus tells them."""
    signal_changes: tuple[SignalChange, ...] = ()
    """Newest first."""
    preview: Preview | None = None
    preview_at_s: float | None = None
    """When this picture came first: a camera that takes no new one says the last one again."""
    preview_heard_s: float | None = None
    preview_serial: int = 0
    outcome: Outcome | None = None
    strokes: tuple[Stroke, ...] = ()
    """Newest first."""
    events: tuple[Event, ...] = ()
    """Newest first."""
    services: dict[str, Seen] = field(default_factory=lambda: {name: Seen() for name in SERVICES})
    trends: tuple[WearTrend, ...] = ()
    total: int = 0
    passed: int = 0
    failed: int = 0
    not_measured: int = 0
    records_at_s: float | None = None


def with_verdict(state: CellState, verdict: Verdict, now_s: float | None) -> CellState:
    """The snapshot after judge's verdict; `now_s` is None for one of unknown age.

    Verdict and outcome travel on their own ways: either may come first. One of an older stroke than the
    newest fills its row and is not shown as the last.
    """
    index = next((i for i, row in enumerate(state.strokes) if row.cycle_id == verdict.cycle_id), None)
    row = Stroke(
        cycle_id=verdict.cycle_id,
        stroke=verdict.request.stroke,
        part_id=verdict.request.part_id,
        utc="",
        decision=verdict.decision.value,
        code=verdict.code,
        reason=verdict.reason,
        mean_mm=verdict.mean_error_mm,
        max_mm=verdict.max_error_mm,
        cycle_ms=None,
        told_code=None,
        is_simulated=verdict.is_simulated,
        object_index=verdict.request.object_index,
    )
    if index is None:
        return replace(state, verdict=verdict, verdict_at_s=now_s, strokes=(row, *state.strokes)[:STROKES_KEPT])
    known = state.strokes[index]
    row = replace(row, utc=known.utc, cycle_ms=known.cycle_ms, told_code=known.told_code)
    strokes = (*state.strokes[:index], row, *state.strokes[index + 1 :])
    if state.verdict is not None and (index > 0 or state.verdict.cycle_id == verdict.cycle_id):
        return replace(state, strokes=strokes)
    return replace(state, verdict=verdict, verdict_at_s=now_s, strokes=strokes)


def with_outcome(state: CellState, outcome: Outcome) -> CellState:
    """The snapshot after fieldbus told the PLC; also for a cycle that never had a verdict."""
    told = outcome.code if outcome.was_told else None
    cycle_ms = 1000.0 * outcome.cycle_seconds
    rows = list(state.strokes)
    for index, row in enumerate(rows):
        if row.cycle_id == outcome.cycle_id:
            rows[index] = replace(row, utc=outcome.told_utc, cycle_ms=cycle_ms, told_code=told)
            return replace(state, outcome=outcome, strokes=tuple(rows))
    decision = {1: "PASSED", 2: "FAILED", 3: "UNSURE"}.get(outcome.code, "NOT_MEASURED")
    row = Stroke(
        cycle_id=outcome.cycle_id,
        stroke=outcome.request.stroke,
        part_id=outcome.request.part_id,
        utc=outcome.told_utc,
        decision=decision,
        code=outcome.code,
        reason="",
        mean_mm=None,
        max_mm=None,
        cycle_ms=cycle_ms,
        told_code=told,
        is_simulated=outcome.is_simulated,
        object_index=outcome.request.object_index,
    )
    return replace(state, outcome=outcome, strokes=(row, *rows)[:STROKES_KEPT])


def with_view(state: CellState, view: View, now_s: float) -> CellState:
    """The snapshot with the newest maps; those that are said again keep their age."""
    if state.view is not None and state.view.cycle_id == view.cycle_id:
        return state
    return replace(state, view=view, view_at_s=now_s, view_before=state.view)


def with_wear_map(state: CellState, wear_map: WearMap) -> CellState:
    """The snapshot with judge's map of wear."""
    return replace(state, wear_map=wear_map)


def with_preview(state: CellState, preview: Preview, now_s: float) -> CellState:
    """The snapshot with the newest camera picture; one that is said again keeps its age."""
    last = state.preview
    if last is not None and last.frame_counter == preview.frame_counter and np.array_equal(last.jpeg, preview.jpeg):
        return replace(state, preview_heard_s=now_s)
    return replace(
        state, preview=preview, preview_at_s=now_s, preview_heard_s=now_s, preview_serial=state.preview_serial + 1
    )


def with_service(state: CellState, told: ServiceState, now_s: float) -> CellState:
    """The snapshot after a service said how it is."""
    seen = Seen(told, now_s, True)
    state = replace(state, services={**state.services, told.service: seen})
    rows = _signals(told)
    if rows is None:
        return state
    before = {row["name"]: row["value"] for row in state.signals}
    changes = tuple(
        SignalChange(now_s, str(row["name"]), str(before[row["name"]]), str(row["value"]))
        for row in rows
        if row["name"] in before and before[row["name"]] != row["value"] and row["name"] not in LIFE_SIGNALS
    )
    return replace(state, signals=rows, signal_changes=(*changes, *state.signal_changes)[:CHANGES_KEPT])


def _signals(told: ServiceState) -> tuple[dict[str, Any], ...] | None:
    text = told.values.get("image_rows")
    if told.service != "fieldbus" or not isinstance(text, str):
        return None
    try:
        rows = json.loads(text)
    except ValueError:
        return None
    wanted = ("direction", "address", "type", "name", "value", "meaning")
    if not isinstance(rows, list) or not all(isinstance(r, dict) and all(k in r for k in wanted) for r in rows):
        return None
    return tuple(rows)


def with_alive(state: CellState, service: str, is_alive: bool) -> CellState:
    """The snapshot after a service's liveliness token came or went."""
    if service not in state.services:
        return state
    seen = replace(state.services[service], is_alive=is_alive)
    return replace(state, services={**state.services, service: seen})


def with_event(state: CellState, event: Event) -> CellState:
    """The snapshot with one more line in the log; late joiners may hear old events again."""
    if event in state.events:
        return state
    events = sorted((event, *state.events), key=lambda e: e.utc, reverse=True)
    return replace(state, events=tuple(events[:EVENTS_KEPT]))


def with_records(state: CellState, records: Records, now_s: float) -> CellState:
    """The snapshot after judge's records: they rule, and what is newer than them stays on top."""
    known = {row.cycle_id for row in records.rows}
    newer: list[Stroke] = []
    for row in state.strokes:
        if row.cycle_id in known:
            break
        newer.append(row)
    cycle_ms = {row.cycle_id: (row.cycle_ms, row.utc, row.told_code) for row in state.strokes}
    recorded = []
    for record in records.rows:
        heard_ms, heard_utc, heard_told = cycle_ms.get(record.cycle_id, (None, "", None))
        seconds = record.cycle_seconds
        recorded.append(
            Stroke(
                cycle_id=record.cycle_id,
                stroke=record.stroke,
                part_id=record.part_id,
                utc=heard_utc or record.utc,
                decision=record.decision.value,
                code=record.code,
                reason=record.reason,
                mean_mm=record.mean_error_mm,
                max_mm=record.max_error_mm,
                cycle_ms=1000.0 * seconds if seconds is not None else heard_ms,
                told_code=record.told_code if record.told_code is not None else heard_told,
                is_simulated=record.is_simulated,
                object_index=record.object_index,
            )
        )
    return replace(
        state,
        strokes=(*newer, *recorded)[:STROKES_KEPT],
        trends=records.trends,
        total=records.total,
        passed=records.passed,
        failed=records.failed,
        not_measured=records.not_measured,
        records_at_s=now_s,
    )


def is_simulated(state: CellState) -> bool:
    """True when anything that is shown came from a simulated chain."""
    return any(part is not None and part.is_simulated for part in (state.verdict, state.preview, state.view))


def current_object(state: CellState) -> int | None:
    """The object index that the cell works on, as far as anybody said."""
    told = state.services["fieldbus"].state
    index = None if told is None else told.values.get("object_index")
    if isinstance(index, int) and not isinstance(index, bool):
        return index
    return None if state.verdict is None else state.verdict.request.object_index


def trends_of(state: CellState) -> tuple[WearTrend, ...]:
    """The wear trends of the current object: the whole part first, then its zones."""
    wanted = current_object(state)
    found = tuple(trend for trend in state.trends if trend.object_index == wanted)
    if not found and len({trend.object_index for trend in state.trends}) == 1:
        found = state.trends
    return tuple(sorted(found, key=lambda trend: trend.zone))


def trend_of(state: CellState) -> WearTrend | None:
    """The wear trend of the current object as a whole."""
    return next((trend for trend in trends_of(state) if not trend.zone), None)
