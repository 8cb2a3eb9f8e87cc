"""The demo's account of a run: what it counts as right, and that it notices what is wrong."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from wearline.demo.tally import Believed, Summary, Tally, Truth, summarise
from wearline.messages import Decision, MeasureRequest, Outcome, Verdict

LIMIT_MM = 0.10
CODE = {Decision.PASSED: 1, Decision.FAILED: 2, Decision.UNSURE: 3, Decision.NOT_MEASURED: 10}


def request(stroke: int) -> MeasureRequest:
    return MeasureRequest(
        cycle_id=f"c{stroke}", is_simulated=True, object_index=1, stroke=stroke, measure_number=stroke, time_left_ms=3e3
    )


def verdict(stroke: int, decision: Decision, mean_mm: float | None) -> Verdict:
    asked = request(stroke)
    return Verdict(
        cycle_id=asked.cycle_id, is_simulated=True, request=asked, decision=decision, code=CODE[decision], reason="",
        mean_error_mm=mean_mm, max_error_mm=mean_mm, wear_mm=mean_mm,
    )  # fmt: skip


def outcome(stroke: int, code: int, seconds: float = 0.1) -> Outcome:
    asked = request(stroke)
    return Outcome(
        cycle_id=asked.cycle_id, is_simulated=True, request=asked, code=code, passed=code == 1, failed=code != 1,
        was_told=True, cycle_seconds=seconds, told_utc="2026-01-01T00:00:00Z",
    )  # fmt: skip


def run(
    decisions: Sequence[Decision],
    true_mm: Sequence[float],
    recorded: Sequence[str] | None = None,
    believed: Sequence[Believed] | None = None,
) -> Summary:
    tally = Tally()
    for stroke, decision in enumerate(decisions, 1):
        if decision is not Decision.NOT_MEASURED:
            tally.on_verdict(verdict(stroke, decision, true_mm[stroke - 1]))
        tally.on_outcome(outcome(stroke, CODE[decision], 0.1 * stroke))
    truth = {f"c{stroke}": Truth(mean, mean) for stroke, mean in enumerate(true_mm, 1)}
    if recorded is None:
        recorded = [f"c{stroke}" for stroke in range(1, len(decisions) + 1)]
    if believed is None:
        believed = [Believed(n, CODE[d], d is Decision.PASSED) for n, d in enumerate(decisions, 1)]
    return summarise(tally, truth, LIMIT_MM, recorded, believed)


P, F, N = Decision.PASSED, Decision.FAILED, Decision.NOT_MEASURED


def test_a_run_that_follows_the_truth_is_right() -> None:
    found = run([P, P, F, F], [0.0, 0.06, 0.14, 0.2])
    assert found.is_right
    assert (found.judged, found.agreed) == (4, 4)
    assert (found.flipped_at, found.true_flip_at) == (3, 3)
    assert found.counts[P] == 2
    assert found.counts[F] == 2
    assert found.median_ms == pytest.approx(250.0)


def test_parts_near_the_limit_may_go_either_way() -> None:
    found = run([P, F, P, F], [0.0, 0.085, 0.115, 0.2])
    assert found.is_right
    assert found.judged == 2


def test_a_passed_bad_part_is_a_false_passed() -> None:
    found = run([P, P], [0.0, 0.2])
    assert not found.is_right
    assert found.false_passed == (2,)


def test_a_failed_good_part_disagrees_but_is_no_false_passed() -> None:
    found = run([F, P], [0.0, 0.0])
    assert found.disagreed == (1,)
    assert found.false_passed == ()
    assert not found.is_right


def test_a_part_that_was_not_measured_is_no_verdict_against_the_truth() -> None:
    found = run([P, N, F], [0.0, 0.0, 0.2])
    assert found.judged == 2
    assert found.is_right


@pytest.mark.parametrize("recorded", [["c1"], ["c1", "c2", "c2"], []])
def test_each_cycle_needs_exactly_one_record(recorded: list[str]) -> None:
    assert not run([P, P], [0.0, 0.0], recorded=recorded).is_right


def test_records_of_other_runs_do_not_count() -> None:
    assert run([P], [0.0], recorded=["c1", "other"]).is_right


@pytest.mark.parametrize("believed", [[Believed(1, 2, False)], [Believed(1, 1, False)], [Believed(2, 1, True)], []])
def test_what_the_plc_believes_must_be_what_it_was_told(believed: list[Believed]) -> None:
    found = run([P], [0.0], believed=believed)
    assert found.plc_agreed == 0
    assert not found.is_right


def test_a_run_without_strokes_is_not_right() -> None:
    assert not run([], []).is_right


def test_an_outcome_rules_over_a_verdict_that_came_too_late() -> None:
    tally = Tally()
    tally.on_outcome(outcome(1, 10))
    tally.on_verdict(verdict(1, P, 0.0))
    tally.on_outcome(outcome(1, 10))
    assert tally.rows[0].decision is N
    assert tally.rows[0].told_code == 10


def test_a_late_bad_stretch_moves_the_flip() -> None:
    assert run([P, F, P, F, F], [0.0, 0.2, 0.0, 0.2, 0.2]).flipped_at == 4
