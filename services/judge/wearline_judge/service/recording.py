"""Exactly one record of each cycle, whatever was killed or full."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from datetime import datetime

from wearline.errors import BusError, RecordError
from wearline.messages import (
    CODE_MEANING,
    AskJournal,
    Decision,
    Journal,
    JournalEntry,
    Outcome,
    ResultCode,
    Verdict,
)
from wearline.service import Asker
from wearline.topics import JOURNAL
from wearline_judge.drivers.records import Cycle, RecordStore
from wearline_judge.drivers.room import Room

_JOURNAL_TIMEOUT_S = 0.3
_JOURNAL_PAUSE_S = 2.0
_RECONCILED = "reconciled"
"""Mark: newest accepted_utc of the journal that is reconciled."""


class Recording:
    """Writes verdicts and outcomes; keeps what the disk refused; reconciles with fieldbus' journal."""

    def __init__(
        self, records: RecordStore, room: Room, version: str, clock: Callable[[], float], utc: Callable[[], datetime]
    ) -> None:
        self._records, self._room, self._version = records, room, version
        self._clock, self._utc = clock, utc
        self._unrecorded: deque[Verdict | Outcome] = deque()
        self._journal_due_s: float | None = 0.0
        self.fault = ""
        """Why something is not on record yet; empty = all is."""

    @property
    def unrecorded(self) -> int:
        """Entries that are not on disk yet."""
        return len(self._unrecorded)

    @property
    def is_reconciled(self) -> bool:
        return self._journal_due_s is None

    def verdict(self, verdict: Verdict) -> Verdict:
        """The verdict once it is on disk; one that cannot be written must not be told as Passed."""
        try:
            self._append(Cycle(verdict, None, self._utc(), self._clock()))
        except RecordError as error:
            verdict = _unmeasured(verdict, ResultCode.DISK, str(error))
            self._unrecorded.append(verdict)
            self.fault = str(error)
        return verdict

    def outcome(self, outcome: Outcome) -> Verdict | None:
        """Record what the PLC was told; returns the verdict that had to be made up for a cycle without one."""
        try:
            if any(isinstance(m, Verdict) and m.cycle_id == outcome.cycle_id for m in self._unrecorded):
                raise RecordError("its verdict is not on record yet", f"cycle {outcome.cycle_id}")
            return self._record(outcome)
        except RecordError as error:
            self._unrecorded.append(outcome)
            self.fault = str(error)
            return None

    def _record(self, outcome: Outcome) -> Verdict | None:
        if self._records.has_verdict(outcome.cycle_id):
            self._append(Cycle(None, outcome, self._utc()))
            return None
        verdict = _never_judged(outcome, self._version)
        self._append(Cycle(verdict, outcome, self._utc(), self._clock()))
        return verdict

    def _append(self, cycle: Cycle) -> int:
        """Commit; on a full disk once more with the room that the reserve held.

        Raises:
            RecordError: it could not be made durable.
        """
        try:
            return self._records.append((cycle,))
        except RecordError:
            if not self._room.free_reserve():
                raise
            return self._records.append((cycle,))

    def catch_up(self) -> int:
        """Write what the disk refused, in its order; returns how many entries that were, 0 = not all yet."""
        waiting, self._unrecorded = self._unrecorded, deque()
        count = len(waiting)
        while waiting:
            message = waiting.popleft()
            try:
                if isinstance(message, Verdict):
                    self._append(Cycle(message, None, self._utc(), self._clock()))
                else:
                    self._record(message)
            except RecordError as error:
                self.fault = str(error)
                self._unrecorded = deque([message, *waiting])
                return 0
        self.fault = ""
        return count

    # --- the journal ---

    def journal_is(self, there: bool) -> None:
        """fieldbus came (what it accepted before it went, and whatever was missed, is in its journal) or went."""
        self._journal_due_s = self._clock() if there else None

    def is_due(self, now_s: float) -> bool:
        """Whether the journal should be asked now."""
        return self._journal_due_s is not None and now_s >= self._journal_due_s

    def reconcile(self, asker: Asker, now_s: float) -> list[Verdict]:
        """Give every journalled cycle that has its outcome the record that it lacks; returns what was made up."""
        made: list[Verdict] = []
        try:
            since = self._records.mark(_RECONCILED)
            answer = asker.ask(JOURNAL, AskJournal(since_utc=since), timeout_s=_JOURNAL_TIMEOUT_S)
            entries = answer.entries if isinstance(answer, Journal) else ()
            # A cycle without an outcome is still under way; fieldbus gives it one in any case.
            for entry in entries:
                if entry.outcome is not None and not self._records.has_outcome(entry.request.cycle_id):
                    verdict = self.outcome(entry.outcome)
                    if verdict is not None:
                        made.append(verdict)
            newest = _newest_ended(entries)
            if self._unrecorded:
                self._journal_due_s = now_s + _JOURNAL_PAUSE_S
            elif newest <= since:
                self._journal_due_s = None
            else:
                # An answer is bounded: go on from its last entry, with the next tick.
                self._records.set_mark(_RECONCILED, newest)
                self._journal_due_s = now_s
        except (BusError, RecordError):
            self._journal_due_s = now_s + _JOURNAL_PAUSE_S
        return made


def _never_judged(outcome: Outcome, version: str) -> Verdict:
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
        request=outcome.request,
        decision=Decision.NOT_MEASURED,
        code=int(code),
        reason=reason,
        code_version=version,
    )


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
