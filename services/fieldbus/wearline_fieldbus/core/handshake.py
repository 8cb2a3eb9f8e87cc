"""The handshake of profile `basic` as a state machine without I/O: events in, actions out, time as an argument.

`TABLE` is the whole behaviour: for an event the first row counts whose states hold the machine's state and whose
guards all hold. Guards only look, effects only act, so rows and guards can be counted, and left out one by one, by
a program (`TABLE` and `READY` are arguments of the machine).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final

from wearline.messages import MeasureRequest, Outcome, ResultCode
from wearline_fieldbus.core.cycle import (
    CHAIN,
    Action,
    Answer,
    CheckObject,
    Cycle,
    Event,
    HandshakeSettings,
    Image,
    Linked,
    LinkLost,
    MeasureWanted,
    ModeWanted,
    NotRecorded,
    Now,
    ObjectChecked,
    ObjectWanted,
    PublishOutcome,
    PublishRequest,
    RecordAccepted,
    RecordOutcome,
    RoomChanged,
    Ruling,
    Say,
    ServiceChanged,
    Skipped,
    Tick,
    VerdictCame,
    WriteLife,
    WriteResponse,
    Written,
    outcome_of,
    ruling_of,
)
from wearline_fieldbus.core.profiles import NO_ERROR_UM, Direction, Profile, Value


class State(StrEnum):
    """Where the handshake stands."""

    DOWN = "down"
    """No connection, no cycle in hand."""
    CLEARING = "clearing"
    """Connected; the cleared block is on its way, Ready comes after its acknowledgement."""
    IDLE = "idle"
    """Connected and cleared; Ready is shown while all of `READY` holds."""
    MEASURING = "measuring"
    """A Measure was accepted and is not decided."""
    TELLING = "telling"
    """Decided and recorded; the result is on its way to the PLC."""
    TOLD = "told"
    """The result stands until Measure has fallen."""
    BLIND = "blind"
    """As MEASURING, with the connection lost."""
    DOUBTFUL = "doubtful"
    """The connection was lost while the result was on its way: it may have arrived, and is never written again."""


@dataclass(frozen=True)
class Row:
    """One row of the table; ``target`` None = stay."""

    states: tuple[StrEnum, ...]
    event: type[Event]
    guards: tuple[str, ...]
    effect: str
    target: StrEnum | None = None


_S = State
_LINKED: Final = (_S.CLEARING, _S.IDLE, _S.MEASURING, _S.TELLING, _S.TOLD)
_FREE: Final = (_S.DOWN, _S.CLEARING, _S.IDLE, _S.TOLD)
_VERDICT: Final = ("verdict_is_of_cycle", "verdict_is_of_object", "verdict_is_of_number", "is_in_time")

TABLE: tuple[Row, ...] = (
    # The link comes: clear, then Ready. A cycle goes on only where the PLC still asks for the very same one.
    Row((_S.DOWN,), Linked, (), "clear", _S.CLEARING),
    Row((_S.BLIND,), Linked, ("measure_is_the_same", "is_decided", "may_still_tell"), "clear_and_tell", _S.TELLING),
    Row((_S.BLIND,), Linked, ("measure_is_the_same", "may_still_tell"), "clear", _S.MEASURING),
    Row((_S.BLIND,), Linked, (), "abandon_and_clear", _S.CLEARING),
    Row((_S.DOUBTFUL,), Linked, ("result_stands",), "confirm_and_clear", _S.CLEARING),
    Row((_S.DOUBTFUL,), Linked, (), "give_up_and_clear", _S.CLEARING),
    # The link goes.
    Row((_S.CLEARING, _S.IDLE, _S.TOLD), LinkLost, (), "note_link_lost", _S.DOWN),
    Row((_S.MEASURING,), LinkLost, ("is_numbered",), "note_link_lost", _S.BLIND),
    Row((_S.MEASURING,), LinkLost, (), "abandon", _S.DOWN),
    Row((_S.TELLING,), LinkLost, (), "note_link_lost", _S.DOUBTFUL),
    # The PLC started anew, or somebody else wrote what only we may write.
    Row((_S.CLEARING, _S.IDLE, _S.TOLD), Image, ("plc_restarted",), "clear", _S.CLEARING),
    Row((_S.MEASURING,), Image, ("plc_restarted",), "abandon_and_clear", _S.CLEARING),
    Row((_S.IDLE, _S.TOLD), Image, ("response_is_disturbed",), "note_disturbed_and_clear", _S.CLEARING),
    Row((_S.MEASURING,), Image, ("response_is_disturbed", "measure_is_the_same"), "note_disturbed_and_clear"),
    Row((_S.MEASURING,), Image, ("response_is_disturbed",), "abandon_and_clear", _S.CLEARING),
    # Clear, then Ready.
    Row((_S.CLEARING,), Written, ("write_is_the_last",), "show_idle", _S.IDLE),
    # Measure.
    Row((_S.IDLE,), Image, ("measure_rises", "ready_was_shown", "is_ready", "number_is_new"), "accept", _S.MEASURING),
    Row((_S.CLEARING, _S.IDLE), Image, ("measure_rises",), "refuse_measure"),
    Row((_S.MEASURING,), NotRecorded, ("entry_is_of_cycle",), "decide_disk", _S.TELLING),
    # What ends a cycle before its verdict.
    Row((_S.MEASURING,), Image, ("camera_is_stopped",), "decide_stopped", _S.TELLING),
    Row((_S.MEASURING,), Image, ("object_differs",), "decide_recipe_changed", _S.TELLING),
    Row((_S.MEASURING,), ServiceChanged, ("judge_is_lost",), "decide_service_lost", _S.TELLING),
    Row((_S.MEASURING,), Tick, ("answer_is_due",), "decide_late", _S.TELLING),
    Row((_S.BLIND,), Tick, ("answer_is_due",), "end_untold", _S.DOWN),
    # The verdict.
    Row((_S.MEASURING,), VerdictCame, _VERDICT, "decide_by_verdict", _S.TELLING),
    Row((_S.BLIND,), VerdictCame, _VERDICT, "keep_verdict"),
    # The result reaches the PLC, or does not.
    Row((_S.TELLING,), Written, ("write_is_the_result",), "confirm_told", _S.TOLD),
    Row((_S.TELLING,), Skipped, ("write_is_the_result",), "give_up", _S.TOLD),
    Row((_S.TELLING,), NotRecorded, ("entry_is_of_cycle",), "tell_disk"),
    Row((_S.DOUBTFUL,), Tick, ("silence_is_due",), "give_up", _S.DOWN),
    Row((_S.TOLD,), Image, ("result_is_taken",), "show_idle", _S.IDLE),
    Row((_S.TOLD,), Tick, ("result_is_taken",), "show_idle", _S.IDLE),
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
    Row((_S.IDLE,), Tick, (), "show_idle"),
)

READY: Mapping[str, str] = {
    "is_auto": "the mode is manual",
    "no_manual_cycle": "a measurement by hand is under way",
    "plc_is_alive": "the PLC's life counter stands still (PLC in STOP?)",
    "link_is_ok": "the PLC's bit Link OK is 0",
    "camera_is_on": "the camera is stopped by the PLC",
    "chain_is_alive": "a service of the measuring chain is not there",
    "has_room": "there is no room on disk to record a cycle",
    "object_is_settled": "the object is being changed",
    "measure_is_low": "Measure stands at 1",
    "pause_is_over": "the minimum pause between two triggers is not over",
}
"""What Ready needs, and what to say where it is missing."""


@dataclass(frozen=True)
class Recovered:
    """A cycle that the journal shows as not ended when the service starts."""

    request: MeasureRequest
    is_simulated: bool
    outcome: Outcome | None
    """Decided and recorded, not confirmed; None = not even decided."""


class Handshake:
    """One handshake; `handle` is called by one thread, with a monotonic clock that never goes back."""

    def __init__(
        self,
        profile: Profile,
        settings: HandshakeSettings,
        *,
        plc_is_simulated: bool,
        cycle_prefix: str,
        table: tuple[Row, ...] = TABLE,
        ready: Iterable[str] = tuple(READY),
    ) -> None:
        self._profile, self._settings = profile, settings
        self._plc_is_simulated = plc_is_simulated
        self._cycle_prefix = cycle_prefix
        self._ready = tuple(ready)
        self._rows: dict[tuple[StrEnum, type[Event]], list[Row]] = {}
        for row in table:
            for state in row.states:
                self._rows.setdefault((state, row.event), []).append(row)
        self._out: list[Action] = []
        self._now = Now(0.0, "")
        self._event: Event = Tick()
        # A machine may have more than one region; each has states of a kind of its own.
        self._regions: dict[type[StrEnum], StrEnum] = {State: State.DOWN}
        self.mode = "auto"
        self.cycle: Cycle | None = None
        self.manual: Cycle | None = None
        self._count = 0
        self._alive: set[str] = set()
        self._has_room = True
        # What the PLC asks, as last read.
        self._request: dict[str, Value] = profile.decode(bytes(profile.size), Direction.REQUEST)
        self._image = bytes(profile.size)
        self._was_measure = True
        self._rises = False
        self._is_camera_on = False
        self._life_at_s: float | None = None
        self._plc_restarted = False
        # What the PLC was last shown.
        self._shown: dict[str, Value] = {}
        self._token = 0
        self._waiting: dict[int, tuple[int, bytes]] = {}
        self._acknowledged: bytearray | None = None
        self._acknowledged_writes = 0
        self._result_token = 0
        self._life = 0
        self._life_due_s = 0.0
        self._result_at_s = 0.0
        self._was_measure_after_result = False
        self._last_number: int | None = None
        self._last_edge_s: float | None = None
        self._object: int | None = None
        self._is_object_settled = True
        self._is_object_changed = False
        self._manual_object: int | None = None
        self._span = profile.span(Direction.RESPONSE)

    # --- what others may know ---

    @property
    def state(self) -> State:
        """Where the handshake stands."""
        return State(self._regions[State])

    @property
    def is_linked(self) -> bool:
        """A connection stands and the PLC's program runs as far as it says."""
        return self.state in _LINKED and self._guard("plc_is_alive")

    @property
    def object_index(self) -> int | None:
        """The object that the next measurement is of; None before the PLC or a person said so."""
        return self._manual_object if self.mode == "manual" else self._object

    @property
    def is_ready(self) -> bool:
        """Ready as the PLC was last shown it."""
        return self.state is State.IDLE and bool(self._shown.get("ready"))

    def why_not_ready(self) -> str:
        """One sentence, empty while Ready."""
        if self.state in (State.DOWN, State.BLIND, State.DOUBTFUL):
            return "no connection to the PLC"
        return next((READY[name] for name in self._ready if not self._guard(name)), "")

    # --- the machine ---

    def recover(self, found: Iterable[Recovered], now: Now) -> list[Action]:
        """End the cycles that a restart has cut off; called once, before any event.

        One that was decided may have reached the PLC: the process image will tell (DOUBTFUL).
        """
        self._out, self._now = [], now
        cycles = list(found)
        for index, one in enumerate(cycles):
            cycle = Cycle(one.request, now.s)
            if one.outcome is None:
                ruling = Ruling(int(ResultCode.INTERRUPTED), one.is_simulated)
                outcome = outcome_of(cycle, ruling, False, now.s, now.utc)
                self._out += [
                    PublishOutcome(outcome),
                    Say("warning", "a cycle was cut off by a restart and is NOT_MEASURED", cycle.cycle_id),
                ]  # fmt: skip
            elif index == len(cycles) - 1 and one.request.measure_number:
                ruling = Ruling(one.outcome.code, one.outcome.is_simulated)
                self._doubt(replace(cycle, ruling=ruling, recorded=one.outcome))
            else:
                self._out.append(PublishOutcome(one.outcome))
        return self._out

    def _doubt(self, cycle: Cycle) -> None:
        """An earlier run decided this cycle; whether the PLC was told is not known."""
        self.cycle = cycle
        self._regions[State] = State.DOUBTFUL

    def handle(self, event: Event, now: Now) -> list[Action]:
        """Everything that follows from one event."""
        self._out, self._now, self._event = [], now, event
        self._observe(event)
        for region in self._regions:
            for row in self._rows.get((self._regions[region], type(event)), ()):
                if all(self._guard(name) for name in row.guards):
                    # An effect sees the state that it ends in.
                    self._regions[region] = row.target or self._regions[region]
                    getattr(self, row.effect)()
                    break
        self._rises = False
        if isinstance(event, Tick):
            self._step_life()
        return self._out

    def _guard(self, name: str) -> bool:
        return self.guards()[name](self)

    @classmethod
    def guards(cls) -> Mapping[str, Callable[[Any], bool]]:
        """Every guard of this machine by its name."""
        return GUARDS

    def _observe(self, event: Event) -> None:
        """Take in what an event says, whatever the state."""
        if isinstance(event, Linked):
            self._waiting.clear()
            self._acknowledged, self._acknowledged_writes = None, 0
            self._life_at_s, self._plc_restarted = None, False
            # A Measure that already stands is no edge.
            self._was_measure = True
            self._last_number = self.cycle.request.measure_number if self.cycle else None
            self._take_image(event.image, is_first=True)
        elif isinstance(event, Image):
            self._take_image(event, is_first=False)
        elif isinstance(event, Written):
            written = self._waiting.pop(event.token, None)
            if written is not None:
                at, block = written[0] - self._span[0], written[1]
                self._acknowledged = self._acknowledged or bytearray(self._span[1] - self._span[0])
                self._acknowledged[at : at + len(block)] = block
                self._acknowledged_writes += 1
        elif isinstance(event, Skipped):
            self._waiting.pop(event.token, None)
        elif isinstance(event, ServiceChanged):
            (self._alive.add if event.is_alive else self._alive.discard)(event.service)
            if not event.is_alive and event.service in CHAIN:
                self.cycle = self.cycle and self.cycle.with_loss(event.service)
                self.manual = self.manual and self.manual.with_loss(event.service)
        elif isinstance(event, RoomChanged):
            self._has_room = event.has_room
        elif isinstance(event, ObjectChecked) and event.object_index == self._object:
            self._is_object_settled = True
            self._is_object_changed = event.is_known

    def _take_image(self, image: Image, is_first: bool) -> None:
        before = self._request
        self._image = image.content
        self._request = self._profile.decode(image.content, Direction.REQUEST)
        self._rises = bool(self._request["measure"]) and not self._was_measure
        self._was_measure = bool(self._request["measure"])
        if self._was_measure and self.state is State.TOLD:
            self._was_measure_after_result = True
        if not self._request["stop_camera"]:
            self._is_camera_on = False
        elif self._request.get("start_camera", True):
            self._is_camera_on = True
        life = self._request.get("plc_life", 0)
        if not life:
            self._plc_restarted = self._plc_restarted or (not is_first and bool(before.get("plc_life", 0)))
            self._life_at_s = None
        elif is_first or life != before.get("plc_life", 0) or self._life_at_s is None:
            self._life_at_s = image.at_s
        index = int(self._request["object_index"])
        if index != self._object and self.mode == "auto":
            self._object, self._is_object_settled, self._is_object_changed = index, False, False
            self._out.append(CheckObject(index))

    # --- what is shown to the PLC ---

    def _show(self, not_after_s: float | None = None, **changes: Value) -> int:
        """Write a block that differs from the one shown last; its token, or the last one where nothing differs."""
        shown: dict[str, Value] = {
            "mode": self.mode == "auto",
            "object_changed": self._is_object_changed,
            "fault": not (self._guard("chain_is_alive") and self._has_room),
            "mean_error_um": NO_ERROR_UM,
            "max_error_um": NO_ERROR_UM,
            **changes,
        }
        if shown == self._shown:
            return self._token
        self._shown = shown
        known = {f.name for f in self._profile.of(Direction.RESPONSE)}
        values = {k: v for k, v in {**shown, "vision_life": self._life or 1}.items() if k in known}
        return self._write(self._span[0], self._profile.encode(values, Direction.RESPONSE), not_after_s)

    def _write(self, start: int, block: bytes, not_after_s: float | None = None) -> int:
        self._token += 1
        self._waiting[self._token] = (start, block)
        self._out.append(WriteResponse(start, block, self._token, not_after_s))
        return self._token

    def _step_life(self) -> None:
        field = self._profile.field("vision_life")
        if self.state not in _LINKED or self._now.s < self._life_due_s or field is None:
            return
        self._life_due_s = self._now.s + self._settings.vision_life_period_s
        self._life = self._life % 255 + 1
        self._out.append(WriteLife(field.byte, bytes((self._life,))))

    def _say(self, level: str, text: str, cycle: Cycle | None = None) -> None:
        self._out.append(Say(level, text, cycle.cycle_id if cycle else ""))

    # --- effects ---

    def clear(self) -> None:
        self._plc_restarted = False
        # Written also where it equals what was shown: the PLC may have forgotten it.
        self._shown = {}
        self._show()

    def show_idle(self) -> None:
        if self.state is State.IDLE:
            self.cycle = None
            self._show(ready=all(self._guard(name) for name in self._ready))

    def note_link_lost(self) -> None:
        reason = self._event.reason if isinstance(self._event, LinkLost) else ""
        self._say("warning", f"connection to the PLC lost ({reason})", self.cycle)

    def note_disturbed_and_clear(self) -> None:
        self._say(
            "warning",
            "somebody else wrote the response bytes in the PLC (its DB was initialised, its program writes them, or a "
            "second fieldbus serves it); they are cleared",
            self.cycle,
        )
        self.clear()

    def accept(self) -> None:
        self._is_object_changed = False
        self.cycle = self._new_cycle(
            object_index=int(self._request["object_index"]),
            stroke=int(self._request.get("stroke", 0)),
            measure_number=int(self._request.get("measure_number", 0)) if self._settings.numbered else 0,
        )
        self._last_number = self.cycle.request.measure_number
        self._last_edge_s = self.cycle.edge_s
        self._record_and_request(self.cycle)
        self._show()

    def _record_and_request(self, cycle: Cycle) -> None:
        """On disk first, then measured."""
        self._out += [RecordAccepted(cycle), PublishRequest(cycle.request)]

    def _new_cycle(self, object_index: int, stroke: int, measure_number: int, is_manual: bool = False) -> Cycle:
        self._count += 1
        edge_s = self._event.at_s if isinstance(self._event, Image) else self._now.s
        request = MeasureRequest(
            cycle_id=f"{self._cycle_prefix}-{self._count:06d}",
            is_simulated=False,
            object_index=object_index,
            part_id="manual" if is_manual else str(self._request.get("part_id", "")),
            stroke=stroke,
            measure_number=measure_number,
            time_left_ms=1000.0 * (self._settings.answer_by_s - (self._now.s - edge_s)),
        )
        return Cycle(request, edge_s, is_manual)

    def refuse_measure(self) -> None:
        number = self._request.get("measure_number", 0)
        if self._guard("is_ready") and self._guard("ready_was_shown"):
            why = (
                "it has no measure number"
                if not number
                else f"its measure number {number} is that of the Measure before"
            )
        else:
            why = self.why_not_ready() or "Ready was not shown yet"
        self._say("warning", f"Measure of the PLC was not accepted: {why}")
        self._rises = False
        self.show_idle()

    def _decide(self, ruling: Ruling, is_recordable: bool = True) -> None:
        self.cycle = cycle = replace(self._in_hand, ruling=ruling)
        if is_recordable:
            self._out.append(RecordOutcome(cycle, outcome_of(cycle, ruling, False, self._now.s, self._now.utc)))
        self._result_token = self._show(
            cycle.edge_s + self._settings.silent_after_s - self._settings.io_timeout_s,
            measure_finished=True,
            passed=ruling.passed,
            failed=not ruling.passed,
            simulated=ruling.is_simulated,
            result_code=ruling.code,
            mean_error_um=ruling.mean_error_um,
            max_error_um=ruling.max_error_um,
            echo=cycle.request.measure_number,
        )

    @property
    def _in_hand(self) -> Cycle:
        assert self.cycle is not None, f"no cycle in state {self.state}"
        return self.cycle

    def decide_by_verdict(self) -> None:
        assert isinstance(self._event, VerdictCame)
        self._decide(ruling_of(self._event.verdict, self._in_hand.request.is_simulated, self._plc_is_simulated))

    def keep_verdict(self) -> None:
        assert isinstance(self._event, VerdictCame)
        ruling = ruling_of(self._event.verdict, self._in_hand.request.is_simulated, self._plc_is_simulated)
        self.cycle = replace(self._in_hand, ruling=ruling)

    def clear_and_tell(self) -> None:
        ruling = self._in_hand.ruling
        assert ruling is not None
        self.clear()
        self._decide(ruling)

    def ignore_verdict(self) -> None:
        assert isinstance(self._event, VerdictCame)
        # Those who join late hear old verdicts again: only one of this run is worth a line.
        if self._event.verdict.cycle_id.startswith(self._cycle_prefix):
            self._out.append(
                Say("warning", "a verdict was not used: it is late, or of another part", self._event.verdict.cycle_id)
            )

    def decide_stopped(self) -> None:
        self._decide(Ruling(int(ResultCode.STOPPED)))

    def decide_recipe_changed(self) -> None:
        self._decide(Ruling(int(ResultCode.RECIPE_CHANGED)))

    def decide_service_lost(self) -> None:
        self._decide(Ruling(int(ResultCode.SERVICE_LOST)))

    def _late(self, cycle: Cycle) -> Ruling:
        return Ruling(int(ResultCode.SERVICE_LOST if cycle.lost else ResultCode.LATE))

    def decide_late(self) -> None:
        self._decide(self._late(self._in_hand))

    def decide_disk(self) -> None:
        self._decide(Ruling(int(ResultCode.DISK)), is_recordable=False)

    def tell_disk(self) -> None:
        # The result was not written: nothing is done after an entry that failed.
        self._shown = {}
        self._decide(Ruling(int(ResultCode.DISK)), is_recordable=False)

    def _end(self, was_told: bool) -> None:
        cycle = self._in_hand
        ruling = cycle.ruling or self._late(cycle)
        at_s = self._event.at_s if isinstance(self._event, Written) else self._now.s
        self._out.append(PublishOutcome(outcome_of(cycle, ruling, was_told, at_s, self._now.utc)))

    def confirm_told(self) -> None:
        assert isinstance(self._event, Written)
        self._result_at_s = self._event.at_s
        self._was_measure_after_result = self._was_measure
        self._end(True)

    def give_up(self) -> None:
        self._say("warning", "the result may not have reached the PLC", self.cycle)
        self._end(False)
        if self.state is State.TOLD:
            self._result_at_s, self._was_measure_after_result = self._now.s, self._was_measure
        else:
            self.cycle = None

    def confirm_and_clear(self) -> None:
        self._end(True)
        self.cycle = None
        self.clear()

    def give_up_and_clear(self) -> None:
        self.give_up()
        self.clear()

    def abandon(self) -> None:
        """The PLC does not ask for this cycle any more."""
        cycle = self._in_hand
        ruling = cycle.ruling or Ruling(int(ResultCode.INTERRUPTED))
        outcome = outcome_of(cycle, ruling, False, self._now.s, self._now.utc)
        self._out += [
            PublishOutcome(outcome),
            Say("warning", "the PLC does not wait for this result any more; it is not told", cycle.cycle_id),
        ]  # fmt: skip
        self.cycle = None

    def abandon_and_clear(self) -> None:
        self.abandon()
        self.clear()

    def end_untold(self) -> None:
        cycle = self._in_hand
        ruling = cycle.ruling or self._late(cycle)
        outcome = outcome_of(cycle, ruling, False, self._now.s, self._now.utc)
        self._out += [
            PublishOutcome(outcome),
            Say("warning", "no connection to the PLC: it was not told this result", cycle.cycle_id),
        ]  # fmt: skip
        self.cycle = None

    # --- by hand ---

    def accept_manual(self) -> None:
        index = self.object_index or 0
        self.manual = self._new_cycle(index, int(self._request.get("stroke", 0)), 0, is_manual=True)
        self._out += [
            RecordAccepted(self.manual), PublishRequest(self.manual.request), Answer(True, "measuring"),
        ]  # fmt: skip
        self.show_idle()

    def refuse_manual(self) -> None:
        names = ("is_manual", "no_manual_cycle", "chain_is_alive", "has_room")
        texts = {**READY, "is_manual": "the mode is automatic; change it to manual first"}
        missing = next((texts[name] for name in names if not self._guard(name)), "a cycle of the PLC is under way")
        self._out.append(Answer(False, f"not measured: {missing}"))

    def _end_manual(self, ruling: Ruling) -> None:
        assert self.manual is not None
        outcome = outcome_of(self.manual, ruling, False, self._now.s, self._now.utc)
        self._out.append(PublishOutcome(outcome))
        self.manual = None
        self.show_idle()

    def end_manual(self) -> None:
        assert isinstance(self._event, VerdictCame)
        # The PLC is not told, so a simulated verdict need not be refused.
        self._end_manual(ruling_of(self._event.verdict, False, True))

    def end_manual_late(self) -> None:
        assert self.manual is not None
        self._end_manual(self._late(self.manual))

    def drop_manual(self) -> None:
        self.manual = None
        self._say("error", "a measurement by hand was not begun: it could not be recorded")
        self.show_idle()

    def set_mode(self) -> None:
        assert isinstance(self._event, ModeWanted)
        if self._event.mode == "manual":
            self._manual_object = self._object
        self.mode = self._event.mode
        self._out += [Answer(True, f"mode {self.mode}"), Say("info", f"mode {self.mode}")]
        self.show_idle()

    def select_object(self) -> None:
        assert isinstance(self._event, ObjectWanted)
        self._manual_object = self._event.object_index
        self._out += [
            Answer(True, f"object {self._manual_object}"), Say("info", f"object {self._manual_object} chosen by hand"),
        ]  # fmt: skip

    def refuse_busy(self) -> None:
        self._out.append(Answer(False, "a measurement is under way; try again in a moment"))

    def refuse_object(self) -> None:
        if self._guard("is_manual"):
            self.refuse_busy()
        else:
            self._out.append(Answer(False, "in automatic mode the PLC chooses the object; change to manual first"))


def _of_cycle(machine: Handshake, what: Callable[[MeasureRequest, MeasureRequest], bool]) -> bool:
    event, cycle = machine._event, machine.cycle
    if not isinstance(event, VerdictCame) or cycle is None:
        return False
    return what(event.verdict.request, cycle.request)


def _verdict_is_of_cycle(machine: Handshake) -> bool:
    event, cycle = machine._event, machine.cycle
    return isinstance(event, VerdictCame) and cycle is not None and event.verdict.cycle_id == cycle.cycle_id


def _measure_is_the_same(machine: Handshake) -> bool:
    """The PLC still waits for the cycle in hand: without a number nobody could tell."""
    cycle, request = machine.cycle, machine._request
    return (
        machine._settings.numbered
        and cycle is not None
        and bool(request["measure"])
        and request["measure_number"] == cycle.request.measure_number
        and request["object_index"] == cycle.request.object_index
    )


def _result_stands(machine: Handshake) -> bool:
    """The process image shows the result of the cycle in hand: it had arrived."""
    cycle = machine.cycle
    if cycle is None or cycle.ruling is None or not machine._settings.numbered:
        return False
    response = machine._profile.decode(machine._image, Direction.RESPONSE)
    return (
        bool(response["measure_finished"])
        and response["echo"] == cycle.request.measure_number
        and bool(response["passed"]) is cycle.ruling.passed
        and response.get("result_code", cycle.ruling.code) == cycle.ruling.code
    )


def _response_is_disturbed(machine: Handshake) -> bool:
    """The response bytes are not those that the PLC acknowledged; the life counter does not count."""
    image = machine._event
    acknowledged = machine._acknowledged
    if not isinstance(image, Image) or acknowledged is None or image.writes != machine._acknowledged_writes:
        return False
    start, end = machine._span
    found, life = image.content[start:end], machine._profile.life_bytes
    return any(found[i] != acknowledged[i] for i in range(end - start) if start + i not in life)


def _number_is_new(machine: Handshake) -> bool:
    if not machine._settings.numbered:
        return True
    number = machine._request["measure_number"]
    return bool(number) and number != machine._last_number


def _since(start_s: float | None, machine: Handshake) -> float:
    return float("inf") if start_s is None else machine._now.s - start_s


def _cycle_age(machine: Handshake) -> float:
    return _since(machine.cycle.edge_s, machine) if machine.cycle is not None else 0.0


def _may_still_tell(machine: Handshake) -> bool:
    return _cycle_age(machine) < machine._settings.silent_after_s - machine._settings.io_timeout_s


def _result_is_taken(machine: Handshake) -> bool:
    """Measure has fallen after the result was there, or it had fallen before and the result stood long enough."""
    if machine._was_measure:
        return False
    held = machine._now.s - machine._result_at_s >= machine._settings.result_hold_s
    return machine._was_measure_after_result or held


def _life_is_fresh(machine: Handshake) -> bool:
    return machine._life_at_s is None or _since(machine._life_at_s, machine) <= machine._settings.plc_life_timeout_s


GUARDS: Mapping[str, Callable[[Handshake], bool]] = {
    # Ready
    "is_auto": lambda m: m.mode == "auto",
    "is_manual": lambda m: m.mode == "manual",
    "no_manual_cycle": lambda m: m.manual is None,
    "plc_is_alive": _life_is_fresh,
    "link_is_ok": lambda m: bool(m._request["link_ok"]),
    "camera_is_on": lambda m: m._is_camera_on,
    "camera_is_stopped": lambda m: not m._is_camera_on,
    "chain_is_alive": lambda m: m._alive.issuperset(CHAIN),
    "has_room": lambda m: m._has_room,
    "object_is_settled": lambda m: m._is_object_settled,
    "measure_is_low": lambda m: not m._was_measure or m._rises,
    "pause_is_over": lambda m: m._settings.numbered or _since(m._last_edge_s, m) >= m._settings.minimum_pause_s,
    # Measure
    "measure_rises": lambda m: m._rises,
    "ready_was_shown": lambda m: m._acknowledged is not None and _was_ready(m),
    "is_ready": lambda m: all(m._guard(name) for name in m._ready),
    "number_is_new": _number_is_new,
    "is_numbered": lambda m: m._settings.numbered,
    # The PLC
    "plc_restarted": lambda m: m._plc_restarted,
    "response_is_disturbed": _response_is_disturbed,
    "measure_is_the_same": _measure_is_the_same,
    "object_differs": lambda m: m.cycle is not None and m._request["object_index"] != m.cycle.request.object_index,
    "result_is_taken": _result_is_taken,
    "result_stands": _result_stands,
    # Writes
    "write_is_the_last": lambda m: isinstance(m._event, Written | Skipped) and m._event.token == m._token,
    "write_is_the_result": lambda m: isinstance(m._event, Written | Skipped) and m._event.token == m._result_token,
    # The cycle
    "is_decided": lambda m: m.cycle is not None and m.cycle.ruling is not None,
    "may_still_tell": _may_still_tell,
    "is_in_time": lambda m: _cycle_age(m) < m._settings.answer_by_s,
    "answer_is_due": lambda m: _cycle_age(m) >= m._settings.answer_by_s,
    "silence_is_due": lambda m: _cycle_age(m) >= m._settings.silent_after_s,
    "judge_is_lost": lambda m: (
        isinstance(m._event, ServiceChanged) and m._event.service == "judge" and not m._event.is_alive
    ),
    "entry_is_of_cycle": lambda m: (
        isinstance(m._event, NotRecorded) and m.cycle is not None and m._event.cycle_id == m.cycle.cycle_id
    ),
    "verdict_is_of_cycle": _verdict_is_of_cycle,
    "verdict_is_of_object": lambda m: _of_cycle(m, lambda told, mine: told.object_index == mine.object_index),
    "verdict_is_of_number": lambda m: _of_cycle(m, lambda told, mine: told.measure_number == mine.measure_number),
    # By hand
    "verdict_is_manual": lambda m: (
        isinstance(m._event, VerdictCame) and m.manual is not None and m._event.verdict.cycle_id == m.manual.cycle_id
    ),
    "entry_is_manual": lambda m: (
        isinstance(m._event, NotRecorded) and m.manual is not None and m._event.cycle_id == m.manual.cycle_id
    ),
    "manual_is_due": lambda m: m.manual is not None and _since(m.manual.edge_s, m) >= m._settings.answer_by_s,
}
"""Every guard by its name; none of them changes anything."""


def _was_ready(machine: Handshake) -> bool:
    """Whether the block that the PLC acknowledged last says Ready."""
    ready = machine._profile.field("ready")
    assert ready is not None and ready.bit is not None and machine._acknowledged is not None
    return bool(machine._acknowledged[ready.byte - machine._span[0]] >> ready.bit & 1)
