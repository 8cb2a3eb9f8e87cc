"""The audit of a cell's books sees each promise that is broken: what audits others must be audited itself."""

from __future__ import annotations

from typing import Any

import pytest

from tests.contract.examples import ROW, measure_request
from tests.system.cell import Books
from wearline.messages import JournalEntry, Outcome

CYCLES = (1, 2)


def outcome(number: int, code: int = 1, was_told: bool = True) -> Outcome:
    return Outcome(
        cycle_id=f"cycle-{number}",
        is_simulated=True,
        request=measure_request(number),
        code=code,
        passed=code == 1,
        failed=code != 1,
        was_told=was_told,
        cycle_seconds=0.3,
        told_utc="2026-01-01T00:00:00+00:00",
    )


def books() -> Books:
    """Two cycles, both Passed and rightly so."""
    return Books(
        journal=[
            JournalEntry(
                request=measure_request(n), is_simulated=True, accepted_utc=f"2026-01-01T00:00:0{n}+00:00",
                outcome=outcome(n),
            )
            for n in CYCLES
        ],
        records=[
            ROW.replace(record_id=n, cycle_id=f"cycle-{n}", stroke=n, measure_number=n, told_code=1) for n in CYCLES
        ],
        believed=[{"stroke": n, "measure_number": n, "code": 1, "passed": True} for n in CYCLES],
        truth={f"cycle-{n}": {"stroke": n, "true_mean_mm": 0.02} for n in CYCLES},
    )  # fmt: skip


def test_books_that_are_right_are_right() -> None:
    assert books().audit() == []


def lose_a_record(kept: Books) -> None:
    del kept.records[0]


def record_twice(kept: Books) -> None:
    kept.records.append(kept.records[0])


def record_what_never_was(kept: Books) -> None:
    kept.records.append(ROW.replace(cycle_id="cycle-9"))


def tell_what_is_not_on_record(kept: Books) -> None:
    kept.records[0] = kept.records[0].replace(told_code=None)


def forget_the_outcome(kept: Books) -> None:
    kept.journal[0] = kept.journal[0].replace(outcome=None)


def pass_a_worn_part(kept: Books) -> None:
    kept.truth["cycle-1"]["true_mean_mm"] = 0.14


def pass_without_a_frame(kept: Books) -> None:
    del kept.truth["cycle-1"]


def pass_by_the_frame_before(kept: Books) -> None:
    kept.truth["cycle-2"]["stroke"] = 1


def pass_what_was_told_otherwise(kept: Books) -> None:
    kept.journal[0] = kept.journal[0].replace(outcome=outcome(1, code=2))
    kept.records[0] = kept.records[0].replace(told_code=2)


def pass_what_was_never_accepted(kept: Books) -> None:
    kept.believed.append({"stroke": 3, "measure_number": 3, "code": 1, "passed": True})


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        (lose_a_record, "cycle-1 was accepted and has 0 records"),
        (record_twice, "cycle-1 was accepted and has 2 records"),
        (record_what_never_was, "cycle-9 is recorded and was never accepted"),
        (tell_what_is_not_on_record, "cycle-1: the PLC was told 1, the record says None"),
        (forget_the_outcome, "cycle-1 has no outcome"),
        (pass_a_worn_part, "stroke 1, measure number 1: Passed with a true mean error of 0.140 mm"),
        (pass_without_a_frame, "stroke 1, measure number 1: Passed without a frame"),
        (pass_by_the_frame_before, "stroke 2, measure number 2: Passed by the frame of stroke 1"),
        (pass_what_was_told_otherwise, "stroke 1, measure number 1: Passed, and no outcome says so"),
        (pass_what_was_never_accepted, "stroke 3, measure number 3: Passed without an accepted Measure"),
    ],
)
def test_each_broken_promise_is_seen(fault: Any, sentence: str) -> None:
    kept = books()
    fault(kept)
    assert sentence in kept.audit()
