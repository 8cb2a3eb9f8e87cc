"""What the demo has seen, and whether it fits the truth: pure, so that it can be tested without a cell."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from wearline.messages import Decision, Outcome, Verdict

ASIDE_MM = 0.03
"""Parts whose true mean error lies so close to the limit may go either way. [mm]"""
_DECISION = {1: Decision.PASSED, 2: Decision.FAILED, 3: Decision.UNSURE}


@dataclass(frozen=True)
class Row:
    """One stroke, as far as it has been heard of."""

    cycle_id: str
    stroke: int
    decision: Decision = Decision.NOT_MEASURED
    reason: str = ""
    mean_mm: float | None = None
    max_mm: float | None = None
    wear_mm: float | None = None
    cycle_ms: float | None = None
    """From the Measure edge to Measure finished; None until the PLC was told. [ms]"""
    told_code: int | None = None
    """None until the PLC was told, or when it was too late to tell."""

    @property
    def is_whole(self) -> bool:
        """Whether all that there is to hear of it was heard."""
        return self.mean_mm is not None or self.decision is Decision.NOT_MEASURED


@dataclass(frozen=True)
class Believed:
    """One stroke in the PLC's own log."""

    measure_number: int
    code: int
    passed: bool


@dataclass(frozen=True)
class Truth:
    """What the simulated head knows of one stroke. [mm]"""

    wear_mm: float
    mean_mm: float


class Tally:
    """Rows by cycle, in the order in which they were first heard of."""

    def __init__(self) -> None:
        self._rows: dict[str, Row] = {}
        self._numbers: dict[str, int] = {}

    def on_verdict(self, verdict: Verdict) -> None:
        """Judge's decision on one part."""
        row = self._rows.get(verdict.cycle_id, Row(verdict.cycle_id, verdict.request.stroke))
        self._rows[verdict.cycle_id] = replace(
            row, decision=verdict.decision, reason=verdict.reason, mean_mm=verdict.mean_error_mm,
            max_mm=verdict.max_error_mm, wear_mm=verdict.wear_mm,
        )  # fmt: skip

    def on_outcome(self, outcome: Outcome) -> None:
        """What the PLC was told; it rules over a verdict that came too late."""
        row = self._rows.get(outcome.cycle_id, Row(outcome.cycle_id, outcome.request.stroke))
        self._rows[outcome.cycle_id] = replace(
            row, decision=_DECISION.get(outcome.code, Decision.NOT_MEASURED), cycle_ms=1e3 * outcome.cycle_seconds,
            told_code=outcome.code if outcome.was_told else None,
        )  # fmt: skip
        self._numbers[outcome.cycle_id] = outcome.request.measure_number

    @property
    def rows(self) -> tuple[Row, ...]:
        """Oldest first."""
        return tuple(self._rows.values())

    @property
    def ended(self) -> tuple[Row, ...]:
        """Those whose outcome is known, oldest first."""
        return tuple(row for row in self._rows.values() if row.cycle_id in self._numbers)

    def numbers(self) -> Mapping[str, int]:
        """Cycle -> the PLC's measure number."""
        return self._numbers


@dataclass(frozen=True)
class Summary:
    """A run held against the truth, the records and the PLC's log."""

    strokes: int
    counts: Mapping[Decision, int]
    judged: int
    """Parts measured whose truth is clear: not within `ASIDE_MM` of the limit."""
    agreed: int
    false_passed: tuple[int, ...]
    """Strokes."""
    disagreed: tuple[int, ...]
    flipped_at: int | None
    """First stroke from which on no part passed any more."""
    true_flip_at: int | None
    records: int
    """Of this run's cycles in judge's records."""
    plc_agreed: int
    """Strokes of which the PLC believes what fieldbus says that it was told."""
    median_ms: float
    p99_ms: float

    @property
    def is_right(self) -> bool:
        """Whether the cell kept its promises in this run."""
        return (
            self.strokes > 0 and not self.disagreed and self.records == self.strokes and self.plc_agreed == self.strokes
        )


def _flip(rows: Iterable[tuple[int, bool]]) -> int | None:
    """The stroke after the last good one, given (stroke, is good); None when the last one is good or nothing is bad."""
    flip: int | None = None
    for stroke, good in rows:
        flip = None if good else (stroke if flip is None else flip)
    return flip


def summarise(
    tally: Tally, truth: Mapping[str, Truth], limit_mm: float, recorded: Iterable[str], believed: Iterable[Believed]
) -> Summary:
    """Hold one run against what is known of it.

    Args:
        tally: all verdicts and outcomes of the run.
        truth: by cycle id; cycles without a frame have none.
        limit_mm: on the mean error.
        recorded: cycle ids in judge's records, with repetitions if there are any.
        believed: the PLC's own log of this run.
    """
    rows = tally.ended
    counts = {decision: sum(row.decision is decision for row in rows) for decision in Decision}
    clear = [
        (row, truth[row.cycle_id].mean_mm <= limit_mm)
        for row in rows
        if row.cycle_id in truth
        and abs(truth[row.cycle_id].mean_mm - limit_mm) > ASIDE_MM
        and row.decision is not Decision.NOT_MEASURED
    ]
    wrong = [(row, good) for row, good in clear if (row.decision is Decision.PASSED) is not good]
    plc = {entry.measure_number: entry for entry in believed}
    numbers = tally.numbers()
    agreed = 0
    for row in rows:
        entry = plc.get(numbers[row.cycle_id])
        if entry is not None and entry.code == row.told_code and entry.passed is (row.told_code == 1):
            agreed += 1
    ms = np.array([row.cycle_ms for row in rows if row.cycle_ms is not None])
    known = set(numbers)
    return Summary(
        strokes=len(rows),
        counts=counts,
        judged=len(clear),
        agreed=len(clear) - len(wrong),
        false_passed=tuple(row.stroke for row, good in wrong if not good),
        disagreed=tuple(row.stroke for row, _ in wrong),
        flipped_at=_flip((r.stroke, r.decision is Decision.PASSED) for r in rows if r.mean_mm is not None),
        true_flip_at=_flip((r.stroke, truth[r.cycle_id].mean_mm <= limit_mm) for r in rows if r.cycle_id in truth),
        records=sum(cycle in known for cycle in recorded),
        plc_agreed=agreed,
        median_ms=float(np.median(ms)) if ms.size else 0.0,
        p99_ms=float(np.percentile(ms, 99)) if ms.size else 0.0,
    )
