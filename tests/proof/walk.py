"""A random walk of the real handshake against the reference PLC: cycles by the hundred thousand, faults now and then.

Everything is drawn from one seed, which is printed; time is virtual. Checked all the way: I1 Passed is believed only
of a good part, from its own record; I2 an outcome is on disk before the PLC is told; I3 every accepted cycle ends
exactly once; I4 nothing is written after 3 s, and a trigger that no fault touched has its answer in time; I5 after a
connection the block is cleared before Ready.
"""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import dataclass

from tests.proof.plc import IMAGE_BYTES, Believed, ReferencePlc, Step
from wearline.messages import Decision, MeasureRequest, Outcome, Verdict
from wearline_fieldbus.core import cycle as c
from wearline_fieldbus.core.handshake import READY, TABLE, Handshake, Recovered, Row, State
from wearline_fieldbus.core.profiles import BASIC

SETTINGS = c.HandshakeSettings()
RESPONSE = 10
STEP_S = 0.02
CHAIN = ("capture", "reconstruct", "judge")


@dataclass
class Record:
    """One cycle in the journal."""

    request: MeasureRequest
    part: int
    outcome: Outcome | None = None


@dataclass
class Write:
    """One write that waits for the line."""

    start: int
    content: bytes
    token: int | None
    not_after_s: float | None


class BrokenError(AssertionError):
    """An invariant does not hold."""


class Walk:
    """One cell whose every step is drawn from ``seed``."""

    def __init__(
        self, seed: int, fault_rate: float = 0.01, table: tuple[Row, ...] = TABLE, ready: tuple[str, ...] = tuple(READY)
    ) -> None:
        """``fault_rate``: faults per step of 20 ms; another ``table`` and ``ready`` for mutations."""
        self.table, self.ready = table, ready
        self.random = random.Random(seed)
        self.seed, self.fault_rate = seed, fault_rate
        self.now_s = 1000.0
        self.plc = ReferencePlc()
        self.good = True
        self.journal: dict[str, Record] = {}
        self.ended: set[str] = set()
        self.verdicts: list[tuple[float, Verdict]] = []
        self.queue: list[Write] = []
        self.in_network: list[Write] = []
        self.linked = False
        self.acknowledged = 0
        self.cleared = False
        self.link_back_s = 0.0
        self.plc_back_s = 0.0
        self.frozen_until_s = 0.0
        self.alive = dict.fromkeys(CHAIN, True)
        self.has_room = True
        self.fails = 0
        self.calm_since_s = self.now_s
        self.late_verdict = False
        self.starts = 0
        self.cycles = 0
        self.tally: Counter[str] = Counter()
        self.last_said: list[str] = []
        self._start()

    # --- the service: what the handshake says is done, in order ---

    def _start(self) -> None:
        self.starts += 1
        self.machine = Handshake(
            BASIC,
            SETTINGS,
            plc_is_simulated=True,
            cycle_prefix=f"s{self.starts}",
            table=self.table,
            ready=self.ready,
        )
        self.queue.clear()
        self.linked = False
        self.link_back_s = self.now_s + self.random.uniform(0.02, 0.5)
        found = [Recovered(r.request, False, r.outcome) for r in self.journal.values()]
        self._do(self.machine.recover(found, self._now()))
        for name, alive in self.alive.items():
            if alive:
                self._feed(c.ServiceChanged(name, True))
        self._feed(c.RoomChanged(self.has_room))

    def _now(self) -> c.Now:
        return c.Now(self.now_s, "")

    def _feed(self, event: c.Event) -> None:
        self._do(self.machine.handle(event, self._now()))

    def _do(self, actions: list[c.Action]) -> None:
        for index, action in enumerate(actions):
            if isinstance(action, c.WriteLife):
                self.queue.append(Write(action.start, action.content, None, None))
            elif isinstance(action, c.WriteResponse):
                self._check_told(action.block)
                self.queue.append(Write(action.start, action.block, action.token, action.not_after_s))
            elif isinstance(action, c.RecordAccepted | c.RecordOutcome):
                if self.fails:
                    self.fails -= 1
                    self._feed(c.NotRecorded(action.cycle.cycle_id))
                    for left in actions[index + 1 :]:
                        if isinstance(left, c.WriteResponse):
                            self._feed(c.Skipped(left.token))
                    return
                self._record(action)
            elif isinstance(action, c.PublishRequest):
                self._measure(action.request)
            elif isinstance(action, c.PublishOutcome):
                self._end(action.outcome)
            elif isinstance(action, c.CheckObject):
                self._feed(c.ObjectChecked(action.object_index, True))
            elif isinstance(action, c.Say):
                self.last_said.append(f"{self.now_s:.3f} {action.text}")
                del self.last_said[:-8]

    def _record(self, action: c.RecordAccepted | c.RecordOutcome) -> None:
        name = action.cycle.cycle_id
        if isinstance(action, c.RecordAccepted):
            self._claim(name not in self.journal and name not in self.ended, f"I3: {name} was accepted twice")
            self.journal[name] = Record(action.cycle.request, self.plc.part)
        else:
            record = self.journal.get(name)
            self._claim(
                record is not None and record.outcome is None, f"I3: {name} has two outcomes, or was never accepted"
            )
            assert record is not None
            record.outcome = action.outcome

    def _end(self, outcome: Outcome) -> None:
        name = outcome.cycle_id
        self._claim(name not in self.ended, f"I3: {name} ended twice")
        record = self.journal.pop(name, None)
        self._claim(record is not None or outcome.code == 20, f"I3: {name} ended and was never accepted")
        if record is not None and record.outcome is not None:
            self._claim(record.outcome.code == outcome.code or outcome.code == 20, f"I3: {name} changed its outcome")
        self._claim(outcome.passed == (outcome.code == 1), f"I1: {name} says passed with code {outcome.code}")
        self.ended.add(name)
        if len(self.ended) > 1000:
            self.ended = set(sorted(self.ended)[-500:])
        self.tally[f"outcome {outcome.code}{' told' if outcome.was_told else ''}"] += 1

    def _check_told(self, block: bytes) -> None:
        if block[0] & 2:
            cycle = self.machine.cycle
            record = self.journal.get(cycle.cycle_id) if cycle is not None else None
            code = int.from_bytes(block[2:4], "big")
            self._claim(
                code == 20 or (record is not None and record.outcome is not None and record.outcome.code == code),
                "I2: the PLC is told what is not on disk",
            )
            self._claim(bool(block[0] & 4) != bool(block[0] & 8), "both or neither of Passed and Failed")
        else:
            self._claim(not block[0] & 12, "Passed or Failed without Measure finished")

    # --- capture, reconstruct, judge ---

    def _measure(self, request: MeasureRequest) -> None:
        self._claim(request.cycle_id in self.journal, "I2: measured before it was on disk")
        if not all(self.alive.values()):
            return
        draw = self.random.random()
        delay = self.random.uniform(0.1, 0.9) if draw < 0.97 else self.random.uniform(2.0, 4.0)
        self.late_verdict = delay > 2.3
        good = self.good if delay < 2.5 else bool(self.random.getrandbits(1))
        self.verdicts.append((self.now_s + delay, self._verdict(request, good)))

    def _verdict(self, request: MeasureRequest, good: bool) -> Verdict:
        return Verdict.model_construct(
            cycle_id=request.cycle_id, is_simulated=False, request=request, reason="",
            decision=Decision.PASSED if good else Decision.FAILED, code=1 if good else 2,
            mean_error_mm=0.01, max_error_mm=0.02,
        )  # fmt: skip

    # --- the line ---

    def _connect(self) -> None:
        self.linked, self.acknowledged, self.cleared = True, 0, False
        self.queue.clear()
        self._feed(c.Linked(self._image()))

    def _image(self) -> c.Image:
        return c.Image(bytes(self.plc.memory), self.acknowledged, self.now_s)

    def _cut(self) -> None:
        """The connection ends; the write under way arrives, is lost, or comes later."""
        fate = self.random.randrange(3)
        if self.queue and fate:
            (self._arrive if fate == 1 else self.in_network.append)(self.queue[0])
        self.queue.clear()
        self.linked = False
        self.link_back_s = self.now_s + self.random.choice((0.02, 0.1, 0.5, 3.0))

    def _arrive(self, write: Write) -> None:
        self.plc.memory[write.start : write.start + len(write.content)] = write.content

    def _poll(self) -> None:
        while self.queue and self.linked:
            write = self.queue.pop(0)
            if write.not_after_s is not None and self.now_s > write.not_after_s:
                assert write.token is not None
                self._feed(c.Skipped(write.token))
                continue
            self._check_write(write)
            self._arrive(write)
            if write.token is not None:
                self.acknowledged += 1
                self._feed(c.Written(write.token, self.now_s))
        if self.linked:
            self._feed(self._image())

    def _check_write(self, write: Write) -> None:
        if write.start != RESPONSE:
            return
        bits = write.content[0]
        if bits & 2:
            cycle = self.machine.cycle
            age_s = self.now_s - cycle.edge_s if cycle is not None else 0.0
            self._claim(cycle is not None and age_s < SETTINGS.silent_after_s, "I4: written after 3 s")
        self._claim(self.cleared or not bits & 3, "I5: a result or Ready before the block was cleared")
        self.cleared = self.cleared or not bits & 3

    # --- faults ---

    def _fault(self) -> None:
        self.calm_since_s = self.now_s + 0.3
        kind = self.random.randrange(12)
        self.tally["faults"] += 1
        if kind <= 2 and self.linked:
            self._cut()
            self._feed(c.LinkLost("cut"))
        elif kind == 3:
            if self.linked:
                self._cut()
            self._start()
        elif kind == 4 and self.in_network:
            self._arrive(self.in_network.pop())
        elif kind == 5:
            self.plc.restart(bool(self.random.getrandbits(1)))
            self._new_part()
            if self.linked:
                self._cut()
                self._feed(c.LinkLost("PLC restarts"))
        elif kind == 6:
            self.fails = 1
        elif kind == 7:
            name = self.random.choice(CHAIN)
            self.alive[name] = not self.alive[name]
            self._feed(c.ServiceChanged(name, self.alive[name]))
        elif kind == 8:
            self.plc.camera_runs = False
        elif kind == 9:
            self.plc.object_index = self.random.randrange(1, 4)
        elif kind == 10 and self.machine.cycle is not None:
            self._odd_verdict(self.machine.cycle.request)
        elif kind == 11:
            # The process is stopped (SIGSTOP) or the PLC is, for a while.
            if self.random.getrandbits(1):
                self.frozen_until_s = self.now_s + self.random.choice((0.2, 1.0, 4.0))
            else:
                self.plc_back_s = self.now_s + self.random.choice((0.2, 1.0, 4.0))

    def _odd_verdict(self, request: MeasureRequest) -> None:
        """Passed, with one mark of another part."""
        choices: tuple[dict[str, int | str], ...] = (
            {"cycle_id": f"{request.cycle_id}x"},
            {"object_index": request.object_index + 1},
            {"measure_number": (request.measure_number + 1) & 0xFFFF},
        )  # fmt: skip
        self._feed(c.VerdictCame(self._verdict(request.replace(**self.random.choice(choices)), True)))

    def _heal(self) -> None:
        """What a fault broke comes back by itself, or somebody mends it."""
        broken = not all(self.alive.values()) or not self.plc.camera_runs
        if broken and self.random.random() < 0.05:
            self.plc.camera_runs = True
            for name, alive in self.alive.items():
                if not alive:
                    self.alive[name] = True
                    self._feed(c.ServiceChanged(name, True))
        if broken or not self.linked or self.now_s < max(self.frozen_until_s, self.plc_back_s) or self.fails:
            self.calm_since_s = max(self.calm_since_s, self.now_s + 0.3)

    # --- one step ---

    def _new_part(self) -> None:
        self.good = bool(self.random.getrandbits(1))

    def step(self) -> Believed | None:
        """20 ms, or the time until the next thing that is due."""
        jump = STEP_S
        cycle = self.machine.cycle
        if self.machine.state is State.MEASURING and cycle is not None and self.random.random() < 0.8:
            due_s = min([cycle.edge_s + SETTINGS.answer_by_s, *(at_s for at_s, _ in self.verdicts)])
            jump = max(STEP_S, due_s - self.now_s)
        self.now_s += jump
        if self.random.random() < self.fault_rate:
            self._fault()
        self._heal()
        end = None
        if self.now_s >= self.plc_back_s:
            gives_up = self.fault_rate > 0 and self.random.random() < 0.002
            if gives_up:
                self.calm_since_s = self.now_s + 0.3
            was_raising = self.plc.step is Step.RAISE
            end = self.plc.scan(self.now_s, gives_up)
            if was_raising:
                self.late_verdict = False
            if end is not None:
                self._believed(end)
        if self.now_s >= self.frozen_until_s:
            self._serve()
        return end

    def _serve(self) -> None:
        if not self.linked and self.now_s >= self.link_back_s:
            self._connect()
        self._poll()
        due = [verdict for at_s, verdict in self.verdicts if at_s <= self.now_s]
        if due:
            self.verdicts = [(at_s, verdict) for at_s, verdict in self.verdicts if at_s > self.now_s]
            for verdict in due:
                self._feed(c.VerdictCame(verdict))
        self._feed(c.Tick())

    def _believed(self, end: Believed) -> None:
        self.cycles += 1
        if end.passed:
            self._claim(self.good, f"I1: part {end.part} is not good and was Passed")
        calm = self.calm_since_s < self.now_s - end.waited_s
        if calm:
            wanted = (1 if self.good else 2,) if not self.late_verdict else (1, 2, 10)
            self._claim(end.code in wanted, f"I4: part {end.part} without a fault ended with code {end.code}")
            self._claim(end.waited_s <= 2.5 + 10 * STEP_S, f"I4: the answer took {end.waited_s:.3f} s")
            self.tally["untouched"] += 1
        self.tally[f"believed {end.code}"] += 1
        self._new_part()

    def run(self, cycles: int) -> None:
        """So many triggers; then faults end, and every accepted cycle must have ended.

        Raises:
            BrokenError: an invariant does not hold; seed and trigger are named.
        """
        steps, limit = 0, 3000
        while self.cycles < cycles:
            steps = 0 if self.step() is not None else steps + 1
            self._claim(steps < limit, f"I4: nothing has ended for {limit} steps; {self.machine.why_not_ready()}")
        self.fault_rate = 0.0
        self.in_network.clear()
        last = self.cycles + 3
        while self.cycles < last:
            steps = 0 if self.step() is not None else steps + 1
            self._claim(steps < limit, f"I4: no recovery; {self.machine.why_not_ready()}")
        open_cycles = [name for name in self.journal if not self.machine.cycle or name != self.machine.cycle.cycle_id]
        self._claim(not open_cycles, f"I3: never ended: {open_cycles[:3]}")

    def _claim(self, holds: bool, what: str) -> None:
        if not holds:
            said = "; ".join(self.last_said)
            raise BrokenError(f"{what} (seed {self.seed}, trigger {self.cycles}, state {self.machine.state}; {said})")


assert BASIC.size == IMAGE_BYTES
