"""The PLC on one side, the cell on the other: feeds the handshake what happens and does what it says."""

from __future__ import annotations

import json
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from typing import Any, ClassVar

from wearline.config import CellSettings
from wearline.errors import RecordError, WearlineError
from wearline.messages import (
    AskJournal,
    AskRecipe,
    AskRecords,
    DoMeasure,
    Done,
    Event,
    Exposed,
    Journal,
    Message,
    Outcome,
    Records,
    ResultCode,
    SelectObject,
    ServiceState,
    SetMode,
    Verdict,
)
from wearline.metrics import counter, gauge, histogram
from wearline.service import Asker, Health, Service
from wearline.topics import (
    DO_MEASURE,
    EXPOSED,
    JOURNAL,
    MODE,
    RECIPE,
    RECORDS,
    SELECT_OBJECT,
    STATES,
    VERDICT,
    Query,
    Topic,
)
from wearline_fieldbus.config import FieldbusSettings, make_profile
from wearline_fieldbus.core import cycle as c
from wearline_fieldbus.core.extended import ExtendedHandshake
from wearline_fieldbus.core.handshake import Handshake, Recovered
from wearline_fieldbus.core.profiles import Direction, Profile, image_rows
from wearline_fieldbus.drivers.journal import Journal as JournalFile
from wearline_fieldbus.drivers.memory import MemoryPlc
from wearline_fieldbus.drivers.modbus import DigitalIo, ModbusServer
from wearline_fieldbus.drivers.modbus_protocol import Area
from wearline_fieldbus.drivers.plc import (
    ImageRead,
    LinkDown,
    LinkEvent,
    LinkUp,
    PlcLink,
    PlcPort,
    WriteDone,
    WriteSkipped,
)
from wearline_fieldbus.drivers.s7 import S7Plc
from wearline_fieldbus.drivers.s7_server import ServedImage

CYCLES = counter("wearline_cycles_total", "Cycles that ended, by what was decided", ("cell", "object", "decision"))
CYCLE = histogram("wearline_cycle_seconds", "From the Measure edge to the result acknowledged by the PLC", ("cell",))
LINK_UP = gauge("wearline_plc_link_up", "1 while the PLC answers and its program runs", ("cell",))
POLL = histogram(
    "wearline_plc_poll_seconds", "One read of the process image", ("cell",),
    buckets=(0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.5),
)  # fmt: skip

ServeModbus = Callable[[Callable[[], bytes]], ModbusServer | None]
"""Starts the Modbus server, if there is one, on what gives the newest image."""
TICK_S = 0.05
ROOM_S = 1.0
"""Between two looks at the disk. [s]"""
ASK_S = 1.0
"""For an answer of judge. [s]"""
TREND_S = 10.0
"""Between two questions about the wear. [s]"""
_DECISION = {ResultCode.PASSED: "PASSED", ResultCode.FAILED: "FAILED", ResultCode.UNSURE: "UNSURE"}


class Fieldbus(Service):
    """One PLC, one handshake, one journal."""

    name: ClassVar[str] = "fieldbus"
    tick_s = TICK_S

    def __init__(
        self,
        cell: str,
        profile: Profile,
        handshake: Handshake,
        link: PlcLink,
        journal: JournalFile,
        serve_modbus: ServeModbus = lambda image: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._cell, self._profile, self._clock = cell, profile, clock
        self._handshake, self._link, self._journal = handshake, link, journal
        self._serve_modbus = serve_modbus
        self._modbus: ModbusServer | None = None
        self._asker: Asker | None = None
        self._connection = 0
        self._image = bytes(profile.size)
        self._image_at_s: float | None = None
        self._has_room = True
        self._judge_accepts = True
        self._room_at_s = 0.0
        self._unrecorded: list[Outcome] = []
        self._later: list[Message] = []
        self._learnt: deque[c.Event] = deque()
        """What judge answered, on threads of their own."""
        self._trend_at_s = 0.0
        self._answer = c.Answer(False, "")
        self._response_start = profile.span(Direction.RESPONSE)[0]

        CYCLE.labels(cell)

    def start(self, asker: Asker) -> Iterator[Message]:
        """End what an earlier run left open, then begin to poll."""
        self._asker = asker
        if self._journal.damaged_lines:
            yield self._event(
                "error", f"{self._journal.damaged_lines} lines of the journal are damaged and were left out"
            )
        found = [
            Recovered(e.request, e.request.is_simulated, e.outcome) for e in self._journal.unfinished()
        ]  # fmt: skip
        yield from self._do(self._handshake.recover(found, self._now()))
        self._has_room = self._journal.check_room()
        yield from self._feed(c.RoomChanged(self._has_room))
        LINK_UP.labels(self._cell).set(0.0)
        self._modbus = self._serve_modbus(lambda: self._image)
        self._link.wake = self.wake
        self._link.start()

    def handlers(self) -> Mapping[Topic, Callable[[Any], Iterable[Message]]]:
        return {VERDICT: self.on_verdict, EXPOSED: self.on_exposed, STATES["judge"]: self.on_judge_state}

    def answers(self) -> Mapping[Query, Callable[[Any], Message]]:
        return {
            DO_MEASURE: self.on_do_measure,
            SELECT_OBJECT: self.on_select_object,
            MODE: self.on_mode,
            JOURNAL: self.on_journal,
        }

    def on_verdict(self, verdict: Verdict) -> Iterator[Message]:
        """Judge has decided."""
        # What the PLC did before the verdict came counts first.
        yield from self._drain()
        yield from self._feed(c.VerdictCame(verdict))

    def on_exposed(self, exposed: Exposed) -> Iterator[Message]:
        """The picture is taken: the part may move."""
        yield from self._feed(c.ExposureEnded(exposed.cycle_id))

    def on_judge_state(self, state: ServiceState) -> Iterator[Message]:
        """Judge says whether it could record another cycle; its records may lie on another disk."""
        self._judge_accepts = state.values.get("accepts") is not False
        yield from self._look_at_disk()

    def on_alive(self, service: str, is_alive: bool) -> Iterator[Message]:
        yield from self._feed(c.ServiceChanged(service, is_alive))

    def tick(self, now_s: float) -> Iterator[Message]:
        """What the PLC did since, and what time brings about."""
        later, self._later = self._later, []
        yield from later
        yield from self._drain()
        if now_s - self._room_at_s >= ROOM_S:
            self._room_at_s = now_s
            yield from self._look_at_disk()
        yield from self._feed(c.Tick())
        index = self._handshake.object_index
        if (
            self._profile.field("wear_percent") is not None
            and index is not None
            and now_s - self._trend_at_s >= TREND_S
        ):
            self._trend_at_s = now_s
            threading.Thread(target=self._ask_trend, args=(index,), name="trend", daemon=True).start()
        LINK_UP.labels(self._cell).set(float(self._handshake.is_linked))

    def on_do_measure(self, wanted: DoMeasure) -> Done:
        """Measure by hand, in manual mode; the outcome is published like any other."""
        return self._command(c.MeasureWanted())

    def on_select_object(self, wanted: SelectObject) -> Done:
        """Choose the object by hand, in manual mode."""
        return self._command(c.ObjectWanted(wanted.object_index))

    def on_mode(self, wanted: SetMode) -> Done:
        """Automatic (the PLC measures) or manual."""
        return self._command(c.ModeWanted(wanted.mode))

    def on_journal(self, asked: AskJournal) -> Journal:
        """Accepted cycles with their outcomes; at most so many that whoever asks can go on from the last one."""
        return Journal(entries=tuple(entry.as_message() for entry in self._journal.since(asked.since_utc)))

    def health(self) -> Health:
        machine = self._handshake
        age_s = None if self._image_at_s is None else self._clock() - self._image_at_s
        start, end = self._profile.span(Direction.REQUEST)
        values: dict[str, float | int | str | bool | None] = {
            "mode": machine.mode,
            "plc_link_up": machine.is_linked,
            "object_index": machine.object_index,
            "ready": machine.is_ready,
            "not_ready_because": machine.why_not_ready(),
            "handshake": machine.state.value,
            "profile": self._profile.name,
            "request_hex": self._image[start:end].hex(),
            "response_hex": self._image[self._response_start :].hex(),
            "image_age_s": None if age_s is None else round(age_s, 3),
            "image_rows": json.dumps(image_rows(self._profile, self._image), separators=(",", ":")),
            "longest_exchange_ms": round(1000.0 * self._link.longest_s, 3),
            "journal_has_room": self._has_room,
        }
        if not machine.is_linked:
            return Health("degraded", self._link.fault or "the PLC's program stands still", values)
        if not self._has_room:
            return Health("degraded", "no room on disk to record a cycle; free space", values)
        return Health("ready", "", values)

    def close(self) -> None:
        if self._modbus is not None:
            self._modbus.close()
        self._link.close()
        self._journal.close()

    # --- the shell around the handshake ---

    def _now(self) -> c.Now:
        return c.Now(self._clock(), _utc())

    def _drain(self) -> Iterator[Message]:
        for told in self._link.take():
            yield from self._feed(self._event_of(told))
        while self._learnt:
            yield from self._feed(self._learnt.popleft())

    def _event_of(self, told: LinkEvent) -> c.Event:
        """What the link's thread told, in the handshake's words."""
        match told:
            case ImageRead():
                return self._seen(told)
            case LinkUp(image, connection):
                self._connection = connection
                return c.Linked(self._seen(image))
            case LinkDown(reason):
                return c.LinkLost(reason)
            case WriteDone(token, at_s):
                return c.Written(token, at_s)
            case WriteSkipped(token):
                return c.Skipped(token)

    def _seen(self, image: ImageRead) -> c.Image:
        self._image, self._image_at_s = image.content, image.at_s
        return c.Image(image.content, image.writes, image.at_s)

    def _feed(self, event: c.Event) -> Iterator[Message]:
        yield from self._do(self._handshake.handle(event, self._now()))

    def _do(self, actions: list[c.Action]) -> Iterator[Message]:
        """Do what the handshake says, in its order; after an entry that could not be recorded nothing more of it."""
        for index, action in enumerate(actions):
            try:
                yield from self._do_one(action)
            except RecordError as error:
                assert isinstance(action, c.RecordAccepted | c.RecordOutcome)
                yield self._event("error", str(error), action.cycle.cycle_id)
                yield from self._look_at_disk()
                yield from self._feed(c.NotRecorded(action.cycle.cycle_id))
                for left in actions[index + 1 :]:
                    if isinstance(left, c.WriteResponse):
                        yield from self._feed(c.Skipped(left.token))
                return

    def _do_one(self, action: c.Action) -> Iterator[Message]:
        match action:
            case c.RecordAccepted(cycle):
                self._journal.record_accepted(cycle.request, _utc())
            case c.RecordOutcome(_, outcome):
                self._journal.record_outcome(outcome)
            case c.PublishRequest(request):
                yield request
            case c.WriteResponse(start, block, token, not_after_s):
                self._link.write(self._connection, start, block, token, not_after_s)
            case c.WriteLife(start, content):
                self._link.write(self._connection, start, content)
            case c.PublishOutcome(outcome):
                yield outcome
                self._count(outcome)
                self._record_end(outcome)
            case c.CheckObject(index):
                self._check_object(index)
            case c.Answer():
                self._answer = action
            case c.Say(level, text, cycle_id):
                yield self._event(level, text, cycle_id)

    def _command(self, event: c.Event) -> Done:
        """A command's messages are published with the next tick: an answer has no other way to publish."""
        self._answer = c.Answer(False, "not now")
        self._later.extend(self._feed(event))
        self.wake()
        return Done(ok=self._answer.ok, text=self._answer.text)

    def _record_end(self, outcome: Outcome) -> None:
        try:
            self._journal.record_end(outcome)
        except RecordError:
            # Made up for as soon as there is room; a restart before that says the outcome once more.
            self._unrecorded.append(outcome)

    def _look_at_disk(self) -> Iterator[Message]:
        has_room = self._journal.check_room()
        while has_room and self._unrecorded:
            try:
                self._journal.record_end(self._unrecorded[0])
            except RecordError:
                has_room = False
            else:
                del self._unrecorded[0]
        has_room = has_room and self._judge_accepts
        if has_room is self._has_room:
            return
        self._has_room = has_room
        yield self._event(*(
            ("info", "the disk has room again") if has_room
            else ("error", "no room on disk to record a cycle: Ready is withdrawn; free space")
        ))  # fmt: skip
        yield from self._feed(c.RoomChanged(has_room))

    def _check_object(self, index: int) -> None:
        """Ask judge on a thread of its own: a cycle must not wait for an answer."""
        threading.Thread(target=self._ask_recipe, args=(index,), name="object", daemon=True).start()

    def _ask_recipe(self, index: int) -> None:
        is_known = False
        try:
            assert self._asker is not None
            self._asker.ask(RECIPE, AskRecipe(object_index=index), str(index), ASK_S)
            is_known = True
        except WearlineError:
            # Not known, or nobody there to know it: a Measure will say which.
            is_known = False
        self._learnt.append(c.ObjectChecked(index, is_known))
        self.wake()

    def _ask_trend(self, index: int) -> None:
        try:
            assert self._asker is not None
            answer = self._asker.ask(RECORDS, AskRecords(last=1, object_index=index), timeout_s=ASK_S)
        except WearlineError:
            return
        trends = answer.trends if isinstance(answer, Records) else ()
        trend = next((t for t in trends if t.object_index == index), None)
        if trend is None:
            return
        remaining, wear, limit = trend.remaining_p10, trend.wear_mm, trend.limit_mm
        self._learnt.append(
            c.TrendKnown(
                index,
                None if remaining is None else round(remaining),
                None if wear is None or not limit else round(100.0 * wear / limit),
            )
        )

    def _count(self, outcome: Outcome) -> None:
        index = outcome.request.object_index
        name = "unknown" if outcome.code == ResultCode.UNKNOWN_OBJECT else str(index)
        try:
            decision = _DECISION.get(ResultCode(outcome.code), "NOT_MEASURED")
        except ValueError:
            decision = "NOT_MEASURED"
        CYCLES.labels(self._cell, name, decision).inc()
        if outcome.was_told:
            CYCLE.labels(self._cell).observe(outcome.cycle_seconds)

    def _event(self, level: str, text: str, cycle_id: str = "") -> Event:
        return Event(service=self.name, level=level, text=text, utc=_utc(), cycle_id=cycle_id)


def _utc() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def build(cell: CellSettings, settings: FieldbusSettings) -> Service:
    """The live service.

    Raises:
        ConfigError: settings that cannot be obeyed.
        RecordError: the journal cannot be used.
    """
    profile = make_profile(settings)
    machine = {"basic": Handshake, "extended": ExtendedHandshake}[settings.profile]
    handshake = machine(
        profile,
        settings.handshake,
        plc_is_simulated=cell.plc_is_simulated,
        # Unique for ever: the instant, and chance for a clock that was set back.
        cycle_prefix=f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{secrets.token_hex(3)}",
    )
    port, modbus = _ports(settings, profile)
    link = PlcLink(
        port,
        poll_s=settings.plc.poll_ms / 1000.0,
        quiet=profile.life_bytes,
        observe_poll=POLL.labels(cell.cell).observe,
    )
    journal = JournalFile(cell.data_folder("fieldbus"), settings.journal)
    return Fieldbus(cell.cell, profile, handshake, link, journal, modbus)


def _ports(settings: FieldbusSettings, profile: Profile) -> tuple[PlcPort, ServeModbus]:
    """The way to the PLC, and what starts the Modbus server on the image that the service has last seen."""
    plc, timeout_s = settings.plc, settings.handshake.io_timeout_s
    memory = MemoryPlc(profile.size)
    start, end = profile.span(Direction.REQUEST)
    # Only where the PLC itself is the client: else the request has another writer.
    writable = range(start // 2, end // 2) if plc.kind == "modbus" else range(0)

    def serve(image: Callable[[], bytes]) -> ModbusServer | None:
        if settings.modbus.port is None:
            return None
        source = memory.read if plc.kind == "modbus" else image
        return ModbusServer(settings.modbus, lambda: Area(source(), writable), memory.put)

    port: PlcPort
    if plc.kind == "s7":
        port = S7Plc(plc, profile.size, timeout_s)
    elif plc.kind == "s7_server":
        port = ServedImage(plc.host, plc.port, plc.db, profile.size)
    elif plc.kind == "digital_io":
        port = DigitalIo(settings.digital_io, profile.size, timeout_s)
    else:
        port = memory
    return port, serve
