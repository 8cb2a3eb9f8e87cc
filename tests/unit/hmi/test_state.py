"""The snapshot that the screens show."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from tests.contract.examples import OUTCOME, ROW, TREND, VERDICT, measure_request
from wearline import messages as m
from wearline_hmi.core import state as s
from wearline_hmi.core.state import CellState


def verdict(stroke: int, decision: m.Decision = m.Decision.PASSED, code: int = 1) -> m.Verdict:
    request = measure_request(stroke)
    return VERDICT.replace(cycle_id=request.cycle_id, request=request, decision=decision, code=code, reason="")


def outcome(stroke: int, code: int = 1, was_told: bool = True) -> m.Outcome:
    request = measure_request(stroke)
    return OUTCOME.replace(cycle_id=request.cycle_id, request=request, code=code, was_told=was_told)


def test_verdict_and_outcome_may_come_in_any_order_and_end_alike() -> None:
    steps = {
        "verdict 1": lambda state: s.with_verdict(state, verdict(1, m.Decision.FAILED, 2), 1.0),
        "outcome 1": lambda state: s.with_outcome(state, outcome(1, 2)),
        "verdict 2": lambda state: s.with_verdict(state, verdict(2), 2.0),
        "outcome 2": lambda state: s.with_outcome(state, outcome(2)),
    }
    seen = set()
    for order in itertools.permutations(steps):
        if order.index("verdict 1") > order.index("verdict 2") or order.index("outcome 1") > order.index("outcome 2"):
            continue  # each service speaks in order
        state = CellState("c")
        for name in order:
            state = steps[name](state)
        assert state.verdict is not None
        assert state.verdict.request.stroke == 2
        seen.add(tuple((row.stroke, row.decision, row.told_code, row.mean_mm) for row in state.strokes))
    assert seen == {((2, "PASSED", 1, 0.12), (1, "FAILED", 2, 0.12))}


def test_a_verdict_that_is_heard_again_changes_nothing() -> None:
    state = s.with_verdict(CellState("c"), verdict(1), 1.0)
    again = s.with_verdict(state, verdict(1), 90.0)
    assert again.verdict_at_s == 1.0
    assert again.strokes == state.strokes


def test_the_picture_that_is_said_again_keeps_its_age() -> None:
    preview = m.Preview(jpeg=np.frombuffer(b"one", np.uint8), frame_counter=1, is_simulated=False)
    state = s.with_preview(CellState("c"), preview, 1.0)
    state = s.with_preview(state, preview, 8.0)
    assert (state.preview_at_s, state.preview_heard_s, state.preview_serial) == (1.0, 8.0, 1)
    other = m.Preview(jpeg=np.frombuffer(b"two", np.uint8), frame_counter=1, is_simulated=False)
    state = s.with_preview(state, other, 9.0)
    assert (state.preview_at_s, state.preview_serial) == (9.0, 2)


def test_records_rule_and_newer_strokes_stay_on_top() -> None:
    state = CellState("c")
    for stroke in (1, 2, 3):
        state = s.with_verdict(state, verdict(stroke), float(stroke))
    rows = tuple(
        ROW.replace(cycle_id=f"cycle-{n}", stroke=n, record_id=n + 1, decision=m.Decision.FAILED, told_code=2)
        for n in (2, 1, 0)
    )
    state = s.with_records(state, m.Records(rows=rows, total=9, passed=3, failed=6, trends=(TREND,)), 5.0)
    assert [(row.stroke, row.decision) for row in state.strokes] == [
        (3, "PASSED"), (2, "FAILED"), (1, "FAILED"), (0, "FAILED"),
    ]  # fmt: skip
    assert (state.total, state.passed, state.failed, state.records_at_s) == (9, 3, 6, 5.0)


def test_events_are_sorted_by_their_time_kept_once_and_bounded() -> None:
    def event(second: int) -> m.Event:
        return m.Event(service="judge", level="info", text="x", utc=f"2026-01-01T00:00:{second:02d}.000+00:00")

    state = CellState("c")
    for second in (3, 1, 2, 3):
        state = s.with_event(state, event(second))
    assert [e.utc[17:19] for e in state.events] == ["03", "02", "01"]
    for number in range(2 * s.EVENTS_KEPT):
        state = s.with_event(state, event(0).replace(text=str(number)))
    assert len(state.events) == s.EVENTS_KEPT


def test_a_service_of_another_name_is_left_out() -> None:
    state = CellState("c")
    assert s.with_alive(state, "stranger", True) is state


@pytest.mark.parametrize(("told", "wanted"), [(5, 5), (None, 3), (True, 3), ("5", 3)])
def test_the_object_is_what_fieldbus_says_else_the_last_verdicts(told: int | str | bool | None, wanted: int) -> None:
    state = s.with_verdict(CellState("c"), verdict(1), 1.0)
    said = m.ServiceState(
        service="fieldbus", status="ready", pid=1, uptime_s=1, version="0", values={"object_index": told}
    )
    assert s.current_object(s.with_service(state, said, 1.0)) == wanted


def test_the_trend_is_that_of_the_current_object() -> None:
    whole, zone = TREND.replace(zone=""), TREND.replace(zone="radius")
    records = m.Records(rows=(), total=0, trends=(whole.replace(object_index=1), zone, whole))
    state = s.with_records(CellState("c"), records, 1.0)
    assert s.trend_of(state) is None
    state = s.with_verdict(state, verdict(1), 1.0)
    trend = s.trend_of(state)
    assert trend is not None
    assert (trend.object_index, trend.zone) == (3, "")
    assert [t.zone for t in s.trends_of(state)] == ["", "radius"]


def test_simulated_is_said_when_any_part_of_the_screen_is() -> None:
    real = {"is_simulated": False}
    state = s.with_verdict(CellState("c"), verdict(1).replace(**real), 1.0)
    assert not s.is_simulated(state)
    preview = m.Preview(jpeg=np.frombuffer(b"x", np.uint8), frame_counter=1, is_simulated=True)
    assert s.is_simulated(s.with_preview(state, preview, 1.0))
