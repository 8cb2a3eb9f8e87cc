"""A cell around one handshake, on a clock that the test turns: PLC, link with all its vices, chain, journal."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

from wearline.messages import Decision, MeasureRequest, Outcome, Verdict
from wearline_fieldbus.core import cycle as c
from wearline_fieldbus.core.handshake import READY, TABLE, Handshake, Recovered, Row, State
from wearline_fieldbus.core.profiles import BASIC, Direction, Profile, Value
from wearline_fieldbus.core.soft_plc import SOFT_PLCS, Belief, SoftPlcSettings

CODES = {Decision.PASSED: 1, Decision.FAILED: 2, Decision.UNSURE: 3, Decision.NOT_MEASURED: 12}


def verdict_on(request: MeasureRequest, decision: Decision = Decision.PASSED, **changes: Any) -> Verdict:
    """What judge would say of a request."""
    fields: dict[str, Any] = {
        "cycle_id": request.cycle_id, "is_simulated": False, "request": request, "decision": decision,
        "code": CODES[decision], "reason": "", "mean_error_mm": 0.0125, "max_error_mm": -0.034,
    }  # fmt: skip
    return Verdict(**{**fields, **changes})


@dataclass
class Pending:
    """A write on its way to the PLC."""

    start: int
    block: bytes
    token: int | None
    not_after_s: float | None


@dataclass
class Entry:
    """One cycle in the journal."""

    request: MeasureRequest
    outcome: Outcome | None = None
    is_ended: bool = False


@dataclass
class World:
    """Everything outside the handshake, turned by hand; `check` holds after every step."""

    settings: c.HandshakeSettings = field(default_factory=c.HandshakeSettings)
    plc_settings: SoftPlcSettings = field(default_factory=lambda: SoftPlcSettings(stroke_period_s=0.0))
    plc_is_simulated: bool = False
    table: tuple[Row, ...] = TABLE
    ready: tuple[str, ...] = tuple(READY)
    has_plc_program: bool = True
    profile: Profile = BASIC
    machine_type: type[Handshake] = Handshake

    def __post_init__(self) -> None:
        self.now_s = 100.0
        self.memory = bytearray(self.profile.size)
        self.requests_end = self.profile.span(Direction.REQUEST)[1]
        self.plc = SOFT_PLCS[self.profile.name](self.plc_settings)
        self.is_plc_running = True
        self.is_connected = False
        self.pending: deque[Pending] = deque()
        self.limbo: list[Pending] = []
        """Writes of lost connections that may still arrive."""
        self.writes = 0
        self.told_image: bytes | None = None
        self.journal: dict[str, Entry] = {}
        self.journal_fails = 0
        """So many of the next entries cannot be made durable."""
        self.requests: list[MeasureRequest] = []
        self.parts: dict[str, int] = {}
        """Cycle -> the stroke whose part lay there when it was accepted."""
        self.outcomes: list[Outcome] = []
        self.beliefs: list[Belief] = []
        self.said: list[str] = []
        self.checks: list[int] = []
        self.unanswered: list[int] = []
        """Objects that judge was asked about and has not yet answered."""
        self.unknown_objects: set[int] = set()
        self.answers: list[c.Answer] = []
        self.blocks: list[tuple[float, dict[str, Value]]] = []
        """Response blocks that were handed to the link."""
        self.edges: dict[str, float] = {}
        self.runs = 0
        self.alive = {"capture", "reconstruct", "judge"}
        self.boot()

    # --- the fieldbus service ---

    def boot(self) -> None:
        """Start (anew): all that is left of an earlier run is the journal."""
        self.runs += 1
        self.machine = self.machine_type(
            self.profile, self.settings, plc_is_simulated=self.plc_is_simulated, cycle_prefix=f"run{self.runs}",
            table=self.table, ready=self.ready,
        )  # fmt: skip
        unfinished = [e for e in self.journal.values() if not e.is_ended]
        self._do(self.machine.recover([Recovered(e.request, False, e.outcome) for e in unfinished], self.now))
        for service in sorted(self.alive):
            self.feed(c.ServiceChanged(service, True))

    def kill(self) -> None:
        """kill -9 of the service; what it had handed to its socket may arrive or not."""
        self.cut(is_told=False)
        self.boot()

    @property
    def now(self) -> c.Now:
        return c.Now(self.now_s, f"t{self.now_s:.3f}")

    def feed(self, event: c.Event) -> None:
        self._do(self.machine.handle(event, self.now))

    def _do(self, actions: list[c.Action]) -> None:
        for index, action in enumerate(actions):
            if not self._do_one(action):
                assert isinstance(action, c.RecordAccepted | c.RecordOutcome)
                self.feed(c.NotRecorded(action.cycle.cycle_id))
                for left in actions[index + 1 :]:
                    if isinstance(left, c.WriteResponse):
                        self.feed(c.Skipped(left.token))
                return

    def _do_one(self, action: c.Action) -> bool:
        match action:
            case c.RecordAccepted(cycle):
                if self._fails():
                    return False
                assert cycle.cycle_id not in self.journal, "a cycle was accepted twice"
                self.journal[cycle.cycle_id] = Entry(cycle.request)
            case c.RecordOutcome(cycle, outcome):
                if self._fails():
                    return False
                self.journal[cycle.cycle_id].outcome = outcome
            case c.PublishRequest(request):
                assert request.cycle_id in self.journal, "measured before it was on disk"
                self.requests.append(request)
                self.parts[request.cycle_id] = self.plc.stroke
                self.edges[request.cycle_id] = self.now_s
            case c.WriteResponse(start, block, token, not_after_s):
                values = self._decoded(start, block)
                self.blocks.append((self.now_s, values))
                (self._check_block if self.profile is BASIC else self._check_extended)(start, block, values)
                self.pending.append(Pending(start, block, token, not_after_s))
            case c.WriteLife(start, content):
                self.pending.append(Pending(start, content, None, None))
            case c.PublishOutcome(outcome):
                self.outcomes.append(outcome)
                if outcome.cycle_id in self.journal:
                    self.journal[outcome.cycle_id] = Entry(outcome.request, outcome, True)
            case c.CheckObject(index):
                self.checks.append(index)
                self.unanswered.append(index)
            case c.Answer():
                self.answers.append(action)
            case c.Say(_, text, _):
                self.said.append(text)
        return True

    def _fails(self) -> bool:
        if self.journal_fails:
            self.journal_fails -= 1
            return True
        return False

    def _decoded(self, start: int, block: bytes) -> dict[str, Value]:
        return self.profile.decode((bytes(start) + block).ljust(self.profile.size, b"\0"), Direction.RESPONSE)

    def _check_extended(self, start: int, block: bytes, values: dict[str, Value]) -> None:
        assert start >= 58 and values["status_number"] == values["status_number_end"] != 0
        if len(block) <= 12:
            return
        assert values["result_number"] == values["result_number_end"]
        if values["result_valid"]:
            assert values["result_number"] and bool(values["ok"]) is not bool(values["nok"])
            assert bool(values["ok"]) is (values["result_code"] == 1)
            told = self.machine._told  # type: ignore[attr-defined]
            assert told is not None and values["echo"] == told.request.measure_number
            entry = self.journal.get(told.cycle_id)
            assert values["result_code"] == 20 or (entry is not None and entry.outcome is not None), "not recorded"
        else:
            assert not any(values[name] for name in ("ok", "nok", "result_number", "result_code", "echo"))

    def _check_block(self, start: int, block: bytes, values: dict[str, Value]) -> None:
        signs = (bool(values["passed"]), bool(values["failed"]))
        assert signs in ((False, True), (True, False)) if values["measure_finished"] else signs == (False, False)
        assert not values["passed"] or values["result_code"] == 1
        assert not (values["ready"] and values["measure_finished"])
        if values["measure_finished"]:
            cycle = self.machine.cycle
            assert cycle is not None and values["echo"] == cycle.request.measure_number
            entry = self.journal.get(cycle.cycle_id)
            assert values["result_code"] == 20 or (entry is not None and entry.outcome is not None), (
                "told, not recorded"
            )

    # --- the link ---

    def connect(self) -> None:
        """A connection stands; the first image is read."""
        if not self.is_connected:
            self.is_connected, self.writes = True, 0
            self.pending.clear()
            self.feed(c.Linked(self._read()))

    def cut(self, arrives: int = 0, is_told: bool = True) -> None:
        """The connection goes; of what was on its way ``arrives`` writes reach the PLC, the next one may later."""
        for _ in range(min(arrives, len(self.pending))):
            self._apply(self.pending.popleft())
        if self.pending:
            self.limbo.append(self.pending[0])
        self.pending.clear()
        was_connected, self.is_connected = self.is_connected, False
        if was_connected and is_told:
            self.feed(c.LinkLost("cut"))

    def _apply(self, write: Pending) -> None:
        if write.not_after_s is not None:
            assert self.now_s <= write.not_after_s + 0.5
        self.memory[write.start : write.start + len(write.block)] = write.block

    def _read(self) -> c.Image:
        return c.Image(bytes(self.memory), self.writes, self.now_s)

    def poll(self) -> None:
        """One turn of the poll thread: write all, read once."""
        if not self.is_connected:
            return
        while self.pending:
            write = self.pending.popleft()
            if write.not_after_s is not None and self.now_s > write.not_after_s:
                assert write.token is not None
                self.feed(c.Skipped(write.token))
                continue
            self._apply(write)
            if write.token is not None:
                self.writes += 1
                self.feed(c.Written(write.token, self.now_s))
        self.feed(self._read())

    # --- the PLC ---

    def scan(self) -> None:
        """One scan of the PLC's program."""
        if self.is_plc_running and self.has_plc_program:
            belief = self.plc.scan(self.shown(), self.now_s)
            self.memory[0 : self.requests_end] = self.profile.encode(self.plc.request(), Direction.REQUEST)
            if belief is not None:
                self.beliefs.append(belief)

    def restart_plc(self) -> None:
        """Power off and on: memory initialised, connections gone, numbers retained."""
        self.cut()
        self.memory[:] = bytes(self.profile.size)
        self.plc = SOFT_PLCS[self.profile.name](self.plc_settings, self.plc.stroke, self.plc.measure_number)

    def ask(self, **values: Value) -> None:
        """What a PLC without a program writes, by hand: what is not named keeps its value."""
        request = {**self.profile.decode(bytes(self.memory), Direction.REQUEST), **values}
        self.memory[0 : self.requests_end] = self.profile.encode(request, Direction.REQUEST)

    def shown(self) -> dict[str, Value]:
        """The response as the PLC's memory holds it."""
        return self.profile.decode(bytes(self.memory), Direction.RESPONSE)

    # --- time ---

    def turn(self, seconds: float = 0.01, step_s: float = 0.01) -> None:
        """Let time go on: poll, scan and tick at every step."""
        end_s = self.now_s + seconds
        while self.now_s < end_s - 1e-9:
            self.now_s += step_s
            while self.unanswered:
                index = self.unanswered.pop(0)
                self.feed(c.ObjectChecked(index, index not in self.unknown_objects))
            self.poll()
            self.scan()
            self.feed(c.Tick())

    def judge(self, decision: Decision = Decision.PASSED, **changes: Any) -> None:
        """The verdict on the newest request."""
        self.feed(c.VerdictCame(verdict_on(self.requests[-1], decision, **changes)))


def by_hand(**settings: Any) -> World:
    """A linked world without a PLC program, Ready, Measure low."""
    world = World(c.HandshakeSettings(**settings), has_plc_program=False)
    world.ask(start_camera=True, stop_camera=True, link_ok=True, object_index=3, plc_life=0)
    world.connect()
    world.turn(0.05)
    assert world.machine.state is State.IDLE and world.shown()["ready"], world.machine.why_not_ready()
    return world
