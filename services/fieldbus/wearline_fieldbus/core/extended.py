"""The handshake of profile `extended`, as PLC programmers know it from smart cameras.

Trigger enable / ready / ack, exposure done, result valid / ack with a buffer of eight, commands with executing /
done / failed. Three regions run side by side: the trigger (the states of `basic`, without those in which the result
is told), the result and the command. A result is written once, with the block of its own; the status that changes
beside it is another block.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final

from wearline.messages import ResultCode, Verdict
from wearline_fieldbus.core.cycle import (
    CheckObject,
    Cycle,
    Event,
    ExposureEnded,
    Image,
    Linked,
    LinkLost,
    MeasureWanted,
    ModeWanted,
    NotRecorded,
    ObjectChecked,
    ObjectWanted,
    PublishOutcome,
    RecordOutcome,
    Ruling,
    ServiceChanged,
    Skipped,
    Tick,
    TrendKnown,
    VerdictCame,
    WriteLife,
    Written,
    outcome_of,
)
from wearline_fieldbus.core.handshake import GUARDS, READY, Handshake, Row, State
from wearline_fieldbus.core.profiles import NO_STROKES, Direction, Value

BUFFER_RESULTS = 8
NOT_READY, BAD_NUMBER, UNKNOWN_COMMAND = 101, 102, 103
"""Error codes beyond the result codes."""
SELECT_OBJECT, SET_MODE = 1, 2
"""Commands."""


class Result(StrEnum):
    """Of the result that the PLC is shown."""

    NONE = "no result"
    TELLING = "result on its way"
    VALID = "result valid"
    READ = "result acknowledged"
    """Result valid is withdrawn; the PLC's acknowledgement still stands."""
    DOUBTFUL = "result doubtful"
    """The connection was lost while it was on its way: it is never written again."""


class Command(StrEnum):
    """Of the PLC's command."""

    NONE = "no command"
    EXECUTING = "command executing"
    DONE = "command done"
    FAILED = "command failed"


_S, _R, _C = State, Result, Command
_FREE: Final = (_S.DOWN, _S.CLEARING, _S.IDLE)
_VERDICT: Final = ("verdict_is_of_cycle", "verdict_is_of_object", "verdict_is_of_number", "is_in_time")

EXTENDED_TABLE: tuple[Row, ...] = (
    # The link comes and goes.
    Row((_S.DOWN,), Linked, (), "clear", _S.CLEARING),
    Row((_S.BLIND,), Linked, ("number_is_the_same", "may_still_tell"), "clear_and_resume", _S.MEASURING),
    Row((_S.BLIND,), Linked, (), "abandon_and_clear", _S.CLEARING),
    Row((_S.CLEARING, _S.IDLE), LinkLost, (), "note_link_lost", _S.DOWN),
    Row((_S.MEASURING,), LinkLost, (), "note_link_lost", _S.BLIND),
    # The PLC started anew, or somebody else wrote what only we may write.
    Row((_S.CLEARING, _S.IDLE), Image, ("plc_restarted",), "clear", _S.CLEARING),
    Row((_S.MEASURING,), Image, ("plc_restarted",), "abandon_and_clear", _S.CLEARING),
    Row((_S.IDLE,), Image, ("response_is_disturbed",), "note_disturbed_and_clear", _S.CLEARING),
    Row((_S.MEASURING,), Image, ("response_is_disturbed", "number_is_the_same"), "note_disturbed_and_resume"),
    Row((_S.MEASURING,), Image, ("response_is_disturbed",), "abandon_and_clear", _S.CLEARING),
    Row((_S.CLEARING,), Written, ("write_is_the_last",), "show_idle", _S.IDLE),
    # The trigger.
    Row((_S.IDLE,), Image, ("measure_rises", "ready_was_shown", "is_ready", "number_is_new"), "accept", _S.MEASURING),
    Row((_S.CLEARING, _S.IDLE, _S.MEASURING), Image, ("measure_rises",), "refuse_measure"),
    Row((_S.MEASURING,), ExposureEnded, ("exposure_is_of_cycle",), "note_exposure"),
    # What ends a measurement.
    Row((_S.MEASURING,), NotRecorded, ("entry_is_of_cycle",), "decide_disk", _S.IDLE),
    Row((_S.MEASURING,), Image, ("camera_is_stopped",), "decide_stopped", _S.IDLE),
    Row((_S.MEASURING,), ServiceChanged, ("judge_is_lost",), "decide_service_lost", _S.IDLE),
    Row((_S.MEASURING,), Tick, ("is_decided",), "decide_as_kept", _S.IDLE),
    Row((_S.MEASURING,), Tick, ("answer_is_due",), "decide_late", _S.IDLE),
    Row((_S.MEASURING,), VerdictCame, _VERDICT, "decide_by_verdict", _S.IDLE),
    Row((_S.BLIND,), VerdictCame, _VERDICT, "keep_verdict"),
    Row((_S.BLIND,), Tick, ("answer_is_due",), "end_untold", _S.DOWN),
    # The result.
    Row((_R.NONE,), Tick, ("oldest_result_is_stale",), "drop_stale"),
    Row((_R.NONE,), VerdictCame, ("result_waits", "block_is_clear"), "tell_result", _R.TELLING),
    Row((_R.NONE,), Image, ("result_waits", "block_is_clear"), "tell_result", _R.TELLING),
    Row((_R.NONE,), Tick, ("result_waits", "block_is_clear"), "tell_result", _R.TELLING),
    Row((_R.TELLING,), Written, ("write_is_the_result",), "confirm_told", _R.VALID),
    Row((_R.TELLING,), Skipped, ("write_is_the_result",), "give_up", _R.NONE),
    Row((_R.TELLING,), NotRecorded, ("entry_is_of_result",), "tell_disk"),
    Row((_R.NONE, _R.VALID, _R.READ, _R.DOUBTFUL), NotRecorded, ("entry_waits",), "wait_as_disk"),
    Row((_R.TELLING,), LinkLost, (), "keep_doubt", _R.DOUBTFUL),
    Row((_R.DOUBTFUL,), Linked, ("result_stands",), "confirm_told", _R.NONE),
    Row((_R.DOUBTFUL,), Linked, (), "give_up", _R.NONE),
    Row((_R.DOUBTFUL,), Tick, ("result_silence_is_due",), "give_up", _R.NONE),
    Row((_R.VALID,), Image, ("result_is_acknowledged",), "withdraw_result", _R.READ),
    Row((_R.READ,), Image, ("acknowledgement_is_gone",), "withdraw_result", _R.NONE),
    Row((_R.VALID, _R.READ), LinkLost, (), "forget_result", _R.NONE),
    # Commands.
    Row((_C.NONE,), Image, ("command_rises", "command_is_select", "no_cycle"), "begin_select", _C.EXECUTING),
    Row((_C.NONE,), Image, ("command_rises", "command_is_mode", "no_cycle"), "do_mode", _C.DONE),
    Row((_C.NONE,), Image, ("command_rises",), "refuse_command", _C.FAILED),
    Row((_C.EXECUTING,), ObjectChecked, ("object_is_known",), "end_select", _C.DONE),
    Row((_C.EXECUTING,), ObjectChecked, ("object_is_unknown",), "refuse_select", _C.FAILED),
    Row((_C.DONE, _C.FAILED), Image, ("command_is_withdrawn",), "show_status", _C.NONE),
    Row((_C.EXECUTING, _C.DONE, _C.FAILED), LinkLost, (), "forget_command", _C.NONE),
    # By hand.
    Row(_FREE, MeasureWanted, ("is_manual", "no_manual_cycle", "chain_is_alive", "has_room"), "accept_manual"),
    Row(tuple(State), MeasureWanted, (), "refuse_manual"),
    Row(_FREE, VerdictCame, ("verdict_is_manual",), "end_manual"),
    Row(_FREE, NotRecorded, ("entry_is_manual",), "drop_manual"),
    Row(_FREE, Tick, ("manual_is_due",), "end_manual_late"),
    Row(_FREE, ModeWanted, ("no_manual_cycle",), "set_mode"),
    Row(tuple(State), ModeWanted, (), "refuse_busy"),
    Row(_FREE, ObjectWanted, ("is_manual", "no_manual_cycle"), "select_object"),
    Row(tuple(State), ObjectWanted, (), "refuse_object"),
    # What is left.
    Row(tuple(State), VerdictCame, (), "ignore_verdict"),
    Row((_S.IDLE, _S.MEASURING), Image, ("errors_are_cleared",), "clear_errors"),
    Row((_S.IDLE, _S.MEASURING), Image, ("trigger_fell",), "withdraw_ack"),
    Row((_S.IDLE, _S.MEASURING), Tick, (), "show_status"),
)

EXTENDED_READY: Mapping[str, str] = {
    "is_auto": READY["is_auto"],
    "no_manual_cycle": READY["no_manual_cycle"],
    "plc_is_alive": READY["plc_is_alive"],
    "camera_is_on": "Trigger enable is 0",
    "chain_is_alive": READY["chain_is_alive"],
    "has_room": READY["has_room"],
    "object_is_selected": "no object is selected (command 1)",
    "object_is_settled": READY["object_is_settled"],
    "measure_is_low": "Trigger stands at 1",
    "buffer_has_room": "eight results wait to be fetched",
}
"""What Trigger ready needs, and what to say where it is missing."""


@dataclass(frozen=True)
class Trend:
    """Of the object in force."""

    object_index: int = -1
    remaining_strokes: int = NO_STROKES
    wear_percent: int = 0xFFFF


class ExtendedHandshake(Handshake):
    """As `Handshake`, with a result and a command region beside the trigger."""

    def __init__(self, *arguments: Any, table: tuple[Row, ...] = EXTENDED_TABLE, **settings: Any) -> None:
        super().__init__(*arguments, **{"ready": tuple(EXTENDED_READY), **settings, "table": table})
        self._regions |= {Result: Result.NONE, Command: Command.NONE}
        self._results: deque[Cycle] = deque()
        self._told: Cycle | None = None
        self._rose: set[str] = set()
        self._fell: set[str] = set()
        self._error_code = 0
        self._is_overrun = False
        self._is_acknowledged = False
        self._is_exposed = False
        self._status: dict[str, Value] = {}
        self._status_number = 0
        self._result_number = 0
        self._wanted_object = 0
        self._trend = Trend()
        fields = {f.name: f for f in self._profile.fields}
        self._status_span = (fields["status_number"].byte, fields["status_number_end"].byte + 2)

    @property
    def result(self) -> Result:
        """Where the result stands."""
        return Result(self._regions[Result])

    @property
    def command(self) -> Command:
        """Where the command stands."""
        return Command(self._regions[Command])

    @property
    def is_ready(self) -> bool:
        return self.state is State.IDLE and bool(self._status.get("ready"))

    def why_not_ready(self) -> str:
        if self.state in (State.DOWN, State.BLIND):
            return "no connection to the PLC"
        return next((EXTENDED_READY[name] for name in self._ready if not self._guard(name)), "")

    @classmethod
    def guards(cls) -> Mapping[str, Callable[[Any], bool]]:
        return EXTENDED_GUARDS

    def _doubt(self, cycle: Cycle) -> None:
        self._told = cycle
        self._regions[Result] = Result.DOUBTFUL

    def _observe(self, event: Event) -> None:
        self._rose, self._fell = set(), set()
        super()._observe(event)
        if isinstance(event, TrendKnown):
            strokes, percent = event.remaining_strokes, event.wear_percent
            self._trend = Trend(
                event.object_index,
                NO_STROKES if strokes is None else max(0, min(strokes, NO_STROKES - 1)),
                0xFFFF if percent is None else max(0, min(percent, 0xFFFE)),
            )

    def _take_image(self, image: Image, is_first: bool) -> None:
        asked = self._profile.decode(image.content, Direction.REQUEST)
        before = self._request
        self._image = image.content
        if asked["sequence"] != asked["sequence_end"]:
            # Read in the middle of the PLC's writing: the next read has it whole.
            self._rises = False
            return
        self._request = asked
        for name in ("trigger", "result_ack", "command_execute", "clear_error"):
            if bool(asked[name]) is not bool(before[name]) and not is_first:
                (self._rose if asked[name] else self._fell).add(name)
        self._rises = "trigger" in self._rose
        self._was_measure = bool(asked["trigger"])
        self._is_camera_on = bool(asked["trigger_enable"])
        life = asked["plc_life"]
        if not life:
            self._plc_restarted = self._plc_restarted or (not is_first and bool(before["plc_life"]))
            self._life_at_s = None
        elif is_first or life != before["plc_life"] or self._life_at_s is None:
            self._life_at_s = image.at_s

    # --- what is shown ---

    def _status_now(self) -> dict[str, Value]:
        return {
            "online": self.mode == "auto" and self._guard("chain_is_alive") and self._has_room,
            "ready": self.state is State.IDLE and all(self._guard(name) for name in self._ready),
            "trigger_ack": self._is_acknowledged,
            "busy": self.state is State.MEASURING,
            "exposure_done": self._is_exposed,
            "result_valid": self.result in (Result.TELLING, Result.VALID),
            "buffer_overrun": self._is_overrun,
            "error": self._error_code != 0,
            "mode": self.mode == "auto",
            "command_executing": self.command is Command.EXECUTING,
            "command_done": self.command is Command.DONE,
            "command_failed": self.command is Command.FAILED,
            "fault": not (self._guard("chain_is_alive") and self._has_room),
            "error_code": self._error_code,
            "object_index": self.object_index or 0,
            "results_waiting": len(self._results),
        }

    def show_status(self) -> None:
        """Write the status block where it differs from the one shown last."""
        status = self._status_now()
        if status != self._status:
            self._status = status
            start, end = self._status_span
            self._write(start, self._encoded()[start - self._span[0] : end - self._span[0]])

    def _encoded(self, **result: Value) -> bytes:
        self._status_number = self._status_number % 65535 + 1
        numbers = {"status_number": self._status_number, "status_number_end": self._status_number}
        return self._profile.encode({**self._status, **numbers, **result}, Direction.RESPONSE)

    def show_idle(self) -> None:
        if self.state is State.IDLE:
            self.cycle = None
        if self.state in (State.IDLE, State.MEASURING):
            self.show_status()

    def _step_life(self) -> None:
        if self.state not in (State.CLEARING, State.IDLE, State.MEASURING) or self._now.s < self._life_due_s:
            return
        self._life_due_s = self._now.s + self._settings.vision_life_period_s
        self._life = self._life % 65535 + 1
        life = self._profile.field("vision_life")
        if life is not None:
            echo = int(self._request["plc_life"])
            self._out.append(WriteLife(life.byte, self._life.to_bytes(2, "big") + echo.to_bytes(2, "big")))

    # --- effects: the link and the trigger ---

    def clear(self) -> None:
        self._plc_restarted = False
        self._is_acknowledged = self._is_exposed = False
        self._error_code = 0
        if self.result is Result.TELLING:
            self.give_up()
        if self.result in (Result.TELLING, Result.VALID, Result.READ):
            self._regions[Result] = Result.NONE
            self._told = None
        self._regions[Command] = Command.NONE
        self._status = {"mode": self.mode == "auto"}
        start = self._status_span[0]
        self._write(start, self._encoded()[start - self._span[0] :])

    def clear_and_resume(self) -> None:
        """The cycle in hand goes on: its trigger stays acknowledged."""
        self.clear()
        self._is_acknowledged = bool(self._request["trigger"])

    def note_disturbed_and_resume(self) -> None:
        self.note_disturbed_and_clear()
        self._is_acknowledged = bool(self._request["trigger"])

    def accept(self) -> None:
        self.cycle = self._new_cycle(
            self.object_index or 0, int(self._request["stroke"]), int(self._request["measure_number"])
        )
        self._last_number, self._last_edge_s = self.cycle.request.measure_number, self.cycle.edge_s
        self._is_acknowledged, self._is_exposed, self._error_code = True, False, 0
        self._record_and_request(self.cycle)
        self.show_status()

    def refuse_measure(self) -> None:
        is_number = self._guard("is_ready") and self._guard("ready_was_shown")
        self._error_code = BAD_NUMBER if is_number else NOT_READY
        why = "its measure number is 0 or that of the trigger before" if is_number else self.why_not_ready()
        self._say("warning", f"a trigger of the PLC was not accepted: {why or 'Trigger ready was not shown yet'}")
        self._rises = False
        self.show_idle()

    def withdraw_ack(self) -> None:
        self._is_acknowledged = False
        self.show_status()

    def clear_errors(self) -> None:
        self._error_code, self._is_overrun = 0, False
        self.show_status()

    def note_exposure(self) -> None:
        self._is_exposed = True
        self.show_status()

    def _decide(self, ruling: Ruling, is_recordable: bool = True) -> None:
        cycle = replace(self._in_hand, ruling=ruling, decided_s=self._now.s)
        self.cycle = None
        if is_recordable:
            self._out.append(RecordOutcome(cycle, outcome_of(cycle, ruling, False, self._now.s, self._now.utc)))
        self._results.append(cycle)
        self._is_exposed = True

    def decide_as_kept(self) -> None:
        ruling = self._in_hand.ruling
        assert ruling is not None
        self._decide(ruling)

    # --- effects: the result ---

    def tell_result(self) -> None:
        """Write the oldest result."""
        self._told = cycle = self._results.popleft()
        ruling = cycle.ruling
        assert ruling is not None
        self._result_number = self._result_number % 65535 + 1
        # In the same piece as the status that says that it is valid.
        self._status = self._status_now()
        start = self._status_span[0]
        block = self._encoded(**self._result_values(cycle, ruling))[start - self._span[0] :]
        not_after_s = cycle.edge_s + self._settings.silent_after_s - self._settings.io_timeout_s
        self._result_token = self._write(start, block, not_after_s)

    def _result_values(self, cycle: Cycle, ruling: Ruling) -> dict[str, Value]:
        verdict, request = ruling.verdict, cycle.request
        is_refused = ruling.code >= 10
        known = None if is_refused else verdict
        trend = self._trend if self._trend.object_index == request.object_index else Trend()
        return {
            "result_number": self._result_number,
            "result_number_end": self._result_number,
            "ok": ruling.passed,
            "nok": not ruling.passed,
            "unsure": ruling.code == ResultCode.UNSURE,
            "simulated": ruling.is_simulated,
            "result_code": ruling.code,
            "echo": request.measure_number,
            "echo_stroke": request.stroke,
            "echo_part_id": request.part_id,
            "worst_zone": 0 if known is None else worst_zone(known),
            "max_error_mm": _mm(None if known is None else known.max_error_mm),
            "p95_error_mm": _mm(None if known is None else max((r.p95_mm for r in known.regions), default=0.0)),
            "mean_error_mm": _mm(None if known is None else known.mean_error_mm),
            "wear_mm": _mm(None if known is None else known.wear_mm),
            "wear_percent": trend.wear_percent,
            "remaining_strokes": trend.remaining_strokes,
            "cycle_ms": max(0, min(round(1000.0 * (cycle.decided_s - cycle.edge_s)), 0xFFFF)),
        }

    def _end_result(self, was_told: bool) -> None:
        cycle, self._told = self._told, None
        assert cycle is not None and cycle.ruling is not None
        at_s = self._event.at_s if isinstance(self._event, Written) else self._now.s
        self._out.append(PublishOutcome(outcome_of(cycle, cycle.ruling, was_told, at_s, self._now.utc)))

    def confirm_told(self) -> None:
        self._end_result(True)

    def give_up(self) -> None:
        self._is_overrun = True
        self._say("warning", "a result may not have reached the PLC", self._told)
        self._end_result(False)

    def tell_disk(self) -> None:
        assert self._told is not None
        self._results.appendleft(replace(self._told, ruling=Ruling(int(ResultCode.DISK))))
        self.tell_result()

    def drop_stale(self) -> None:
        """After `silent_after_s` nothing is written for a cycle."""
        self._told = self._results.popleft()
        self.give_up()
        self.show_idle()

    def wait_as_disk(self) -> None:
        """What could not be recorded is not told as it was decided."""
        for index, cycle in enumerate(self._results):
            if self._is_entry_of(cycle):
                self._results[index] = replace(cycle, ruling=Ruling(int(ResultCode.DISK)))

    def _is_entry_of(self, cycle: Cycle) -> bool:
        return isinstance(self._event, NotRecorded) and self._event.cycle_id == cycle.cycle_id

    def keep_doubt(self) -> None:
        """Whether it arrived is seen when the connection is back."""

    def withdraw_result(self) -> None:
        self.show_status()

    def forget_result(self) -> None:
        self._told = None

    # --- effects: commands ---

    def begin_select(self) -> None:
        self._wanted_object = int(self._request["argument"])
        self._is_object_settled = False
        self._out.append(CheckObject(self._wanted_object))
        self.show_status()

    def end_select(self) -> None:
        self._object, self._is_object_settled = self._wanted_object, True
        self._say("info", f"object {self._object} selected by the PLC")
        self.show_status()

    def refuse_select(self) -> None:
        self._is_object_settled = True
        self._error_code = int(ResultCode.UNKNOWN_OBJECT)
        self.show_status()

    def forget_command(self) -> None:
        self._is_object_settled = True

    def do_mode(self) -> None:
        self.mode = "auto" if self._request["argument"] else "manual"
        if self.mode == "manual":
            self._manual_object = self._object
        self.show_status()

    def refuse_command(self) -> None:
        is_known = int(self._request["command"]) in (SELECT_OBJECT, SET_MODE)
        self._error_code = NOT_READY if is_known else UNKNOWN_COMMAND
        self.show_status()


def worst_zone(verdict: Verdict) -> int:
    """Number (from 1) of the zone with the largest error, those beyond their limits first; 0 without zones."""
    ranked = [
        (not zone.is_within, abs(zone.max_error_mm or 0.0), -number) for number, zone in enumerate(verdict.zones, 1)
    ]
    return -max(ranked)[2] if ranked else 0


def _mm(value: float | None) -> float:
    return -1.0 if value is None else abs(value)


def _number_is_the_same(machine: ExtendedHandshake) -> bool:
    """The PLC has not moved on to another part: its number is still that of the cycle in hand."""
    cycle, request = machine.cycle, machine._request
    return (
        cycle is not None
        and bool(request["trigger_enable"])
        and request["measure_number"] == cycle.request.measure_number
    )


def _result_stands(machine: ExtendedHandshake) -> bool:
    """The process image shows the doubtful result, whole and valid: it had arrived."""
    cycle = machine._told
    if cycle is None or cycle.ruling is None:
        return False
    shown = machine._profile.decode(machine._image, Direction.RESPONSE)
    return (
        bool(shown["result_valid"])
        and shown["result_number"] == shown["result_number_end"]
        and shown["echo"] == cycle.request.measure_number
        and shown["result_code"] == cycle.ruling.code
        and bool(shown["ok"]) is cycle.ruling.passed
    )


def _ended_with(machine: ExtendedHandshake, is_known: bool) -> bool:
    event = machine._event
    return (
        isinstance(event, ObjectChecked) and event.object_index == machine._wanted_object and event.is_known is is_known
    )


def _command_is(machine: ExtendedHandshake, command: int) -> bool:
    return machine._request["command"] == command


def _number_is_new(machine: ExtendedHandshake) -> bool:
    number = machine._request["measure_number"]
    return bool(number) and number != machine._last_number


def _told_age(machine: ExtendedHandshake) -> float:
    return 0.0 if machine._told is None else machine._now.s - machine._told.edge_s


EXTENDED_GUARDS: Mapping[str, Callable[[Any], bool]] = {
    **GUARDS,
    "number_is_new": _number_is_new,
    "number_is_the_same": _number_is_the_same,
    "object_is_selected": lambda m: m._object is not None,
    "buffer_has_room": lambda m: len(m._results) < BUFFER_RESULTS,
    "exposure_is_of_cycle": lambda m: (
        isinstance(m._event, ExposureEnded) and m.cycle is not None and m._event.cycle_id == m.cycle.cycle_id
    ),
    "no_cycle": lambda m: m.cycle is None and m.manual is None,
    "trigger_fell": lambda m: "trigger" in m._fell,
    "errors_are_cleared": lambda m: "clear_error" in m._rose,
    "result_waits": lambda m: bool(m._results),
    "block_is_clear": lambda m: m.state in (State.IDLE, State.MEASURING),
    "result_stands": _result_stands,
    "result_silence_is_due": lambda m: _told_age(m) >= m._settings.silent_after_s,
    "oldest_result_is_stale": lambda m: (
        bool(m._results) and m._now.s - m._results[0].edge_s >= m._settings.silent_after_s
    ),
    "entry_is_of_result": lambda m: m._told is not None and m._is_entry_of(m._told),
    "entry_waits": lambda m: any(m._is_entry_of(cycle) for cycle in m._results),
    "result_is_acknowledged": lambda m: bool(m._request["result_ack"]),
    "acknowledgement_is_gone": lambda m: not m._request["result_ack"],
    "command_rises": lambda m: "command_execute" in m._rose,
    "command_is_withdrawn": lambda m: not m._request["command_execute"],
    "command_is_select": lambda m: _command_is(m, SELECT_OBJECT),
    "command_is_mode": lambda m: _command_is(m, SET_MODE),
    "object_is_known": lambda m: _ended_with(m, True),
    "object_is_unknown": lambda m: _ended_with(m, False),
}
"""Every guard of the extended handshake by its name."""
