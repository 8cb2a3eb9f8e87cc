"""Hypothesis drives the real handshake against the reference PLC through every order of faults it can think of.

Truth: the part of a stroke is good or bad by its stroke number; judge says so of the part that lay there when the
Measure was accepted. Safety is checked after every step, liveness after the faults have ended.
"""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from tests.unit.fieldbus.world import World, verdict_on
from wearline.messages import Decision
from wearline_fieldbus.core import cycle as c
from wearline_fieldbus.core.handshake import State
from wearline_fieldbus.core.soft_plc import SoftPlcSettings


def is_good(stroke: int) -> bool:
    """The truth about the part of a stroke."""
    return stroke * 2654435761 % 7 < 4


class Faults(RuleBasedStateMachine):
    """One PLC, one link, one chain, one service that is killed now and then."""

    @initialize(period=st.sampled_from([0.0, 0.5, 4.0]))
    def begin(self, period: float) -> None:
        self.world = World(plc_settings=SoftPlcSettings(stroke_period_s=period))
        self.world.connect()
        self.answered: set[str] = set()

    # --- the good weather ---

    @rule(steps=st.integers(1, 30))
    def time_goes_on(self, steps: int) -> None:
        self.world.turn(0.02 * steps, 0.02)

    @rule()
    def long_time_goes_on(self) -> None:
        self.world.turn(3.2, 0.1)

    @rule()
    def plc_scans_twice_between_polls(self) -> None:
        self.world.scan()
        self.world.scan()

    @precondition(lambda self: self.world.requests)
    @rule(back=st.integers(1, 3), is_twice=st.booleans())
    def judge_decides(self, back: int, is_twice: bool) -> None:
        """The verdict on one of the last requests, perhaps twice, perhaps long ago."""
        request = self.world.requests[-min(back, len(self.world.requests))]
        good = is_good(self.world.parts[request.cycle_id])
        told = verdict_on(request, Decision.PASSED if good else Decision.FAILED)
        for _ in range(1 + is_twice):
            self.world.feed(c.VerdictCame(told))
            self.answered.add(request.cycle_id)

    # --- the chain ---

    @precondition(lambda self: self.world.requests)
    @rule(what=st.sampled_from(["cycle", "object", "number"]))
    def somebody_says_passed_of_another_part(self, what: str) -> None:
        request = self.world.requests[-1]
        changes: dict[str, int | str] = {
            "cycle": {"cycle_id": f"{request.cycle_id}x"},
            "object": {"object_index": request.object_index + 1},
            "number": {"measure_number": request.measure_number % 65535 + 1},
        }[what]  # type: ignore[assignment]
        self.world.feed(c.VerdictCame(verdict_on(request.replace(**changes), Decision.PASSED)))

    @precondition(lambda self: self.world.requests)
    @rule()
    def a_simulator_says_passed(self) -> None:
        self.world.feed(c.VerdictCame(verdict_on(self.world.requests[-1], Decision.PASSED, is_simulated=True)))

    @rule(service=st.sampled_from(["capture", "reconstruct", "judge"]), is_alive=st.booleans())
    def a_service_changes(self, service: str, is_alive: bool) -> None:
        (self.world.alive.add if is_alive else self.world.alive.discard)(service)
        self.world.feed(c.ServiceChanged(service, is_alive))

    @rule(has_room=st.booleans())
    def the_disk_changes(self, has_room: bool) -> None:
        self.world.feed(c.RoomChanged(has_room))

    @rule()
    def the_next_entry_fails(self) -> None:
        self.world.journal_fails = 1

    # --- the link and the PLC ---

    @precondition(lambda self: self.world.is_connected)
    @rule(arrives=st.integers(0, 2))
    def the_link_is_cut(self, arrives: int) -> None:
        self.world.cut(arrives)

    @precondition(lambda self: not self.world.is_connected)
    @rule()
    def the_link_comes_back(self) -> None:
        self.world.connect()

    @precondition(lambda self: self.world.limbo)
    @rule()
    def a_lost_write_arrives_after_all(self) -> None:
        """A hung PLC that goes on takes what was in its buffer, whatever happened since."""
        write = self.world.limbo.pop(0)
        self.world.memory[write.start : write.start + len(write.block)] = write.block

    @rule()
    def the_service_is_killed(self) -> None:
        self.world.kill()

    @rule()
    def the_plc_stops_or_runs(self) -> None:
        self.world.is_plc_running = not self.world.is_plc_running

    @rule()
    def the_plc_restarts(self) -> None:
        """Its memory is initialised; its numbers are retained."""
        self.world.restart_plc()

    @rule(index=st.integers(1, 3))
    def the_plc_changes_the_object(self, index: int) -> None:
        self.world.plc.object_index = index

    @rule(is_manual=st.booleans())
    def a_person_changes_the_mode(self, is_manual: bool) -> None:
        self.world.feed(c.ModeWanted("manual" if is_manual else "auto"))
        self.world.feed(c.MeasureWanted())

    # --- what always holds ---

    @invariant()
    def nothing_bad_was_believed(self) -> None:
        if not hasattr(self, "world"):
            return
        for belief in self.world.beliefs:
            assert not belief.passed or is_good(belief.stroke), f"false Passed on stroke {belief.stroke}"

    @invariant()
    def every_outcome_is_the_only_one(self) -> None:
        if not hasattr(self, "world"):
            return
        ids = [outcome.cycle_id for outcome in self.world.outcomes]
        assert len(ids) == len(set(ids)), "a cycle ended twice"
        assert set(self.world.journal) <= {r.cycle_id for r in self.world.requests} | set(ids)

    @invariant()
    def an_untold_cycle_was_not_believed(self) -> None:
        if not hasattr(self, "world"):
            return
        told = {o.request.measure_number: o for o in self.world.outcomes if o.was_told}
        for belief in self.world.beliefs:
            outcome = told.get(belief.measure_number)
            assert outcome is None or not belief.code or belief.code == outcome.code

    def teardown(self) -> None:
        """The faults end: every cycle ends, and the press goes on."""
        if not hasattr(self, "world"):
            return
        world = self.world
        world.limbo.clear()
        world.journal_fails = 0
        world.is_plc_running = True
        for service in ("capture", "reconstruct", "judge"):
            world.feed(c.ServiceChanged(service, True))
        world.feed(c.RoomChanged(True))
        world.connect()
        for _ in range(2):
            world.turn(3.5, 0.05)
            world.feed(c.ModeWanted("auto"))
        before = len(world.beliefs)
        for _ in range(300):
            world.turn(0.05, 0.05)
            if world.machine.state is State.MEASURING:
                request = world.requests[-1]
                good = is_good(world.parts[request.cycle_id])
                world.judge(Decision.PASSED if good else Decision.FAILED)
            if len(world.beliefs) >= before + 3:
                break
        newest = world.beliefs[before:]
        assert len(newest) >= 3, f"the press stands: {world.machine.state} {world.machine.why_not_ready()}"
        assert all(b.code in (1, 2) for b in newest[1:])
        ended = {outcome.cycle_id for outcome in world.outcomes}
        open_cycles = [name for name in world.journal if name not in ended]
        assert len(open_cycles) <= 1, f"cycles without an outcome: {open_cycles}"
        self.nothing_bad_was_believed()
        self.every_outcome_is_the_only_one()


# The default run tries the same histories each time; a number asks for so many new ones (make plc-faults).
EXAMPLES = int(os.environ.get("WEARLINE_FAULT_EXAMPLES", "0"))
TestFaults = Faults.TestCase
TestFaults.settings = settings(
    max_examples=EXAMPLES or 60, derandomize=not EXAMPLES, stateful_step_count=40, deadline=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
