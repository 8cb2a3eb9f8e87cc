"""The extended profile: golden bytes, each rule of its handshake, and random faults against its reference PLC."""

from __future__ import annotations

import os
import struct
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from tests.contract.examples import VERDICT
from tests.unit.fieldbus.test_handshake_machine import is_good
from tests.unit.fieldbus.world import World, verdict_on
from wearline.messages import Decision
from wearline_fieldbus.core import cycle as c
from wearline_fieldbus.core.extended import (
    EXTENDED_GUARDS,
    EXTENDED_READY,
    EXTENDED_TABLE,
    Command,
    ExtendedHandshake,
    Result,
    worst_zone,
)
from wearline_fieldbus.core.handshake import State
from wearline_fieldbus.core.profiles import EXTENDED, Direction, check_layout
from wearline_fieldbus.core.soft_plc import SoftPlcSettings


def world(has_plc_program: bool = False, period_s: float = 0.0) -> World:
    """A linked world of the extended profile; without a program, Ready for object 3."""
    found = World(
        plc_settings=SoftPlcSettings(stroke_period_s=period_s, object_index=3), has_plc_program=has_plc_program,
        profile=EXTENDED, machine_type=ExtendedHandshake, table=EXTENDED_TABLE, ready=tuple(EXTENDED_READY),
    )  # fmt: skip
    found.connect()
    found.turn(0.05)
    if not has_plc_program:
        ask(found, trigger_enable=True, command=1, argument=3, command_execute=True)
        found.turn(0.05)
        assert found.shown()["command_done"] and found.shown()["object_index"] == 3
        ask(found, command_execute=False)
        found.turn(0.06)
        assert found.shown()["ready"] and not found.shown()["command_done"], found.machine.why_not_ready()
    return found


def ask(found: World, **values: Any) -> None:
    """What the PLC writes, whole."""
    number = int(EXTENDED.decode(bytes(found.memory), Direction.REQUEST)["sequence"]) % 65535 + 1
    found.ask(sequence=number, sequence_end=number, **values)


def triggered(found: World, number: int = 7) -> None:
    """A cycle of the part T7 is under way and the trigger withdrawn."""
    ask(found, measure_number=number, stroke=70000 + number, part_id=f"T{number}")
    found.turn(0.02)
    ask(found, trigger=True)
    found.turn(0.02)
    assert found.shown()["trigger_ack"] and found.machine.state is State.MEASURING
    ask(found, trigger=False)
    found.turn(0.02)
    assert not found.shown()["trigger_ack"]


def test_golden_bytes() -> None:
    check_layout(EXTENDED, "here")
    assert EXTENDED.span(Direction.REQUEST) == (0, 54) and EXTENDED.span(Direction.RESPONSE) == (54, 142)
    request = EXTENDED.encode(
        {"sequence": 0x1122, "trigger_enable": True, "trigger": True, "measure_number": 7, "stroke": 0x01020304,
         "part_id": "AB", "sequence_end": 0x1122}, Direction.REQUEST,
    )  # fmt: skip
    assert request.hex() == (
        "1122" "0300" "0000" "0000" "0000" "0000" "0007" "0000" "01020304" "1e02" "4142" + "00" * 28 + "1122"
    )  # fmt: skip
    result = EXTENDED.encode({"ok": True, "mean_error_mm": 0.5, "echo": 7}, Direction.RESPONSE)
    assert result[72 - 54] == 1 and result[92 - 54 : 96 - 54] == struct.pack(">f", 0.5) and result[77 - 54] == 7


def test_trigger_exposure_result_and_acknowledgement() -> None:
    found = world()
    triggered(found)
    (request,) = found.requests
    assert (request.part_id, request.stroke, request.measure_number, request.object_index) == ("T7", 70007, 7, 3)
    assert found.shown()["busy"] and not found.shown()["exposure_done"]
    found.feed(c.ExposureEnded("another"))
    found.feed(c.ExposureEnded(request.cycle_id))
    found.turn(0.02)
    assert found.shown()["exposure_done"] and not found.shown()["ready"]
    found.feed(c.TrendKnown(3, 4321, 55))
    told = VERDICT.replace(
        cycle_id=request.cycle_id, request=request, is_simulated=False, decision=Decision.PASSED, code=1
    )
    found.feed(c.VerdictCame(told))
    found.turn(0.02)
    shown = found.shown()
    assert shown["result_valid"] and shown["ok"] and not shown["nok"] and shown["result_code"] == 1
    assert (shown["echo"], shown["echo_stroke"], shown["echo_part_id"]) == (7, 70007, "T7")
    assert (shown["worst_zone"], shown["remaining_strokes"], shown["wear_percent"]) == (1, 4321, 55)
    assert shown["max_error_mm"] == pytest.approx(0.3) and shown["wear_mm"] == pytest.approx(0.25)
    assert shown["p95_error_mm"] == pytest.approx(0.25) and shown["mean_error_mm"] == pytest.approx(0.12)
    found.turn(0.1)
    assert found.shown()["ready"], "the next part need not wait until the result is fetched"
    ask(found, result_ack=True)
    found.turn(0.02)
    assert not found.shown()["result_valid"]
    ask(found, result_ack=False)
    found.turn(0.02)
    assert found.machine._regions[Result] is Result.NONE and [o.was_told for o in found.outcomes] == [True]


def test_results_wait_in_the_buffer_in_order_and_are_given_up_in_time() -> None:
    found = world()
    for number in (1, 2, 3):
        triggered(found, number)
        found.judge(Decision.FAILED if number == 2 else Decision.PASSED)
        found.turn(0.1)
    assert (found.shown()["echo"], found.shown()["results_waiting"]) == (1, 2)
    for number, code in ((2, 2), (3, 1)):
        ask(found, result_ack=True)
        found.turn(0.02)
        ask(found, result_ack=False)
        found.turn(0.04)
        assert (found.shown()["echo"], found.shown()["result_code"]) == (number, code)
    triggered(found, 4)
    found.judge()
    found.turn(3.2)
    assert found.shown()["result_valid"] and found.shown()["echo"] == 3, "a result that was told stands"
    ask(found, result_ack=True)
    found.turn(0.02)
    ask(found, result_ack=False)
    found.turn(0.2)
    assert found.shown()["buffer_overrun"] and not found.shown()["result_valid"]
    assert [(o.request.measure_number, o.was_told) for o in found.outcomes] == [
        (1, True), (2, True), (3, True), (4, False),
    ]  # fmt: skip
    ask(found, clear_error=True)
    found.turn(0.02)
    assert not found.shown()["buffer_overrun"]


def test_a_full_buffer_withdraws_ready_and_a_trigger_is_refused_aloud() -> None:
    found = world()
    for number in range(1, 10):
        triggered(found, number)
        found.judge()
        found.turn(0.06)
    assert found.shown()["results_waiting"] == 8 and not found.shown()["ready"]
    ask(found, measure_number=50, trigger=True)
    found.turn(0.02)
    assert found.shown()["error"] and found.shown()["error_code"] == 101 and not found.shown()["trigger_ack"]
    assert len(found.requests) == 9 and "eight results" in found.said[-1]


def test_numbers_torn_requests_and_commands() -> None:
    found = world()
    found.ask(measure_number=9, trigger=True, sequence=77, sequence_end=78)
    found.turn(0.1)
    assert not found.requests, "a torn request says nothing"
    ask(found, trigger=True, measure_number=0)
    found.turn(0.02)
    assert found.shown()["error_code"] == 102
    ask(found, trigger=False)
    found.turn(0.02)
    commands = ((9, 0, "command_failed", 103), (1, 5, "command_failed", 15), (2, 0, "command_done", 15))
    for command, argument, sign, code in commands:
        found.unknown_objects = {5}
        ask(found, command=command, argument=argument, command_execute=True)
        found.turn(0.04)
        assert found.shown()[sign] and found.shown()["error_code"] == code, command
        ask(found, command_execute=False)
        found.turn(0.03)
        assert not found.shown()[sign]
    assert not found.shown()["mode"] and not found.shown()["ready"] and found.shown()["object_index"] == 3
    ask(found, command=2, argument=1, command_execute=True)
    found.turn(0.02)
    ask(found, command_execute=False)
    found.turn(0.1)
    triggered(found, 3)
    ask(found, command=1, argument=4, command_execute=True)
    found.turn(0.02)
    assert found.shown()["command_failed"], "not in the middle of a cycle"


def test_deadlines_stop_and_disk() -> None:
    found = world()
    triggered(found, 1)
    found.turn(2.6)
    assert (found.shown()["result_code"], found.shown()["nok"], found.shown()["max_error_mm"]) == (10, True, -1.0)
    found = world()
    triggered(found, 1)
    ask(found, trigger_enable=False)
    found.turn(0.05)
    assert found.shown()["result_code"] == 24 and not found.shown()["ready"]
    for fails_at in ("accept", "decide"):
        found = world()
        if fails_at == "accept":
            found.journal_fails = 1
        ask(found, measure_number=4)
        found.turn(0.02)
        ask(found, trigger=True)
        found.turn(0.02)
        if fails_at == "decide":
            found.journal_fails = 1
            found.judge()
        found.turn(0.1)
        assert (found.shown()["result_code"], found.shown()["ok"], found.shown()["echo"]) == (20, False, 4), fails_at
        assert [o.code for o in found.outcomes] == [20]


@pytest.mark.parametrize("arrives", [0, 1])
def test_a_result_lost_with_the_connection_is_looked_for_and_never_written_again(arrives: int) -> None:
    found = world()
    triggered(found)
    found.judge()
    found.cut(arrives=arrives)
    assert found.machine._regions[Result] is Result.DOUBTFUL
    count = len(found.blocks)
    found.turn(0.1)
    found.connect()
    found.turn(0.1)
    assert [o.was_told for o in found.outcomes] == [bool(arrives)]
    assert not any(values["result_valid"] for _, values in found.blocks[count:])


def test_a_cut_in_the_middle_of_a_measurement_does_not_cost_it() -> None:
    for verdict_first in (True, False):
        found = world()
        triggered(found)
        found.cut()
        if verdict_first:
            found.judge()
        found.turn(0.2)
        found.connect()
        found.turn(0.06)
        if not verdict_first:
            found.judge()
        found.turn(0.06)
        assert found.shown()["result_valid"] and found.shown()["ok"], verdict_first


def test_after_three_seconds_nothing_is_written_for_the_cycle() -> None:
    found = world()
    triggered(found)
    found.now_s += 2.55
    found.feed(c.Tick())
    assert found.machine._regions[Result] is Result.TELLING
    # The link's thread gets round to it only now.
    found.now_s += 0.5
    found.poll()
    assert not found.shown()["result_valid"] and found.shown()["result_code"] == 0
    assert [(o.code, o.was_told) for o in found.outcomes] == [(10, False)]
    found.turn(0.2)
    assert found.shown()["buffer_overrun"] and found.shown()["ready"]


def test_two_way_life_counters() -> None:
    found = world()
    ask(found, plc_life=77)
    found.turn(0.2)
    assert found.shown()["plc_life_echo"] == 77 and found.machine.is_linked
    found.turn(1.0)
    assert not found.machine.is_linked and not found.shown()["ready"]


def test_worst_zone() -> None:
    (zone,) = VERDICT.zones
    big = zone.replace(name="b", max_error_mm=-0.9, is_within=True)
    bad = zone.replace(name="c", max_error_mm=0.2, is_within=False)
    assert worst_zone(VERDICT.replace(zones=(zone.replace(is_within=True), big))) == 2
    assert worst_zone(VERDICT.replace(zones=(big, bad))) == 2 and worst_zone(VERDICT.replace(zones=())) == 0


def test_the_table_names_only_what_exists() -> None:
    used = {name for row in EXTENDED_TABLE for name in row.guards} | set(EXTENDED_READY)
    assert used <= set(EXTENDED_GUARDS)
    assert all(callable(getattr(ExtendedHandshake, row.effect)) for row in EXTENDED_TABLE)
    kinds = [{type(state) for state in (*row.states, *((row.target,) if row.target else ()))} for row in EXTENDED_TABLE]
    assert all(len(kind) == 1 for kind in kinds) and set.union(*kinds) == {State, Result, Command}


def test_the_reference_plc_and_the_handshake_agree_for_a_thousand_strokes() -> None:
    found = world(has_plc_program=True)
    while len(found.beliefs) < 1000:
        found.turn(0.01)
        if found.machine.state is State.MEASURING:
            good = is_good(found.parts[found.requests[-1].cycle_id])
            found.judge(Decision.PASSED if good else Decision.FAILED)
    assert [b.passed for b in found.beliefs] == [is_good(b.stroke) for b in found.beliefs]
    assert [b.stroke for b in found.beliefs] == list(range(1, len(found.beliefs) + 1))


class ExtendedFaults(RuleBasedStateMachine):
    """As `Faults` of the basic profile, with what is different here."""

    @initialize(period=st.sampled_from([0.0, 0.5, 4.0]))
    def begin(self, period: float) -> None:
        self.world = world(has_plc_program=True, period_s=period)

    @rule(steps=st.integers(1, 30))
    def time_goes_on(self, steps: int) -> None:
        self.world.turn(0.02 * steps, 0.02)

    @rule()
    def long_time_goes_on(self) -> None:
        self.world.turn(3.2, 0.1)

    @precondition(lambda self: self.world.requests)
    @rule(back=st.integers(1, 3), is_twice=st.booleans())
    def judge_decides(self, back: int, is_twice: bool) -> None:
        request = self.world.requests[-min(back, len(self.world.requests))]
        good = is_good(self.world.parts[request.cycle_id])
        for _ in range(1 + is_twice):
            self.world.feed(c.VerdictCame(verdict_on(request, Decision.PASSED if good else Decision.FAILED)))

    @precondition(lambda self: self.world.requests)
    @rule(what=st.sampled_from(["cycle", "object", "number", "simulated"]))
    def somebody_says_passed_of_another_part(self, what: str) -> None:
        request = self.world.requests[-1]
        alien = {
            "cycle": request.replace(cycle_id=f"{request.cycle_id}x"),
            "object": request.replace(object_index=request.object_index + 1),
            "number": request.replace(measure_number=request.measure_number % 65535 + 1),
        }.get(what, request)
        self.world.feed(c.VerdictCame(verdict_on(alien, is_simulated=what == "simulated")))

    @rule(service=st.sampled_from(["capture", "judge"]), is_alive=st.booleans())
    def a_service_changes(self, service: str, is_alive: bool) -> None:
        (self.world.alive.add if is_alive else self.world.alive.discard)(service)
        self.world.feed(c.ServiceChanged(service, is_alive))

    @rule(has_room=st.booleans())
    def the_disk_changes(self, has_room: bool) -> None:
        self.world.feed(c.RoomChanged(has_room))

    @rule()
    def the_next_entry_fails(self) -> None:
        self.world.journal_fails = 1

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
        self.world.restart_plc()

    @rule(index=st.integers(1, 3))
    def the_plc_changes_the_object(self, index: int) -> None:
        self.world.plc.object_index = index

    @invariant()
    def nothing_bad_was_believed_and_no_cycle_ended_twice(self) -> None:
        if not hasattr(self, "world"):
            return
        for belief in self.world.beliefs:
            assert not belief.passed or is_good(belief.stroke), f"false Passed on stroke {belief.stroke}"
        ids = [outcome.cycle_id for outcome in self.world.outcomes]
        assert len(ids) == len(set(ids)), "a cycle ended twice"

    def teardown(self) -> None:
        if not hasattr(self, "world"):
            return
        found = self.world
        found.limbo.clear()
        found.journal_fails, found.is_plc_running = 0, True
        for service in ("capture", "judge"):
            found.feed(c.ServiceChanged(service, True))
        found.feed(c.RoomChanged(True))
        found.connect()
        found.turn(7.0, 0.05)
        before = len(found.beliefs)
        for _ in range(300):
            found.turn(0.05, 0.05)
            if found.machine.state is State.MEASURING:
                good = is_good(found.parts[found.requests[-1].cycle_id])
                found.judge(Decision.PASSED if good else Decision.FAILED)
            if len(found.beliefs) >= before + 3:
                break
        newest = found.beliefs[before:]
        assert len(newest) >= 3, f"the press stands: {found.machine.state} {found.machine.why_not_ready()}"
        assert all(b.code in (1, 2) for b in newest[1:])
        ended = {outcome.cycle_id for outcome in found.outcomes}
        assert len([name for name in found.journal if name not in ended]) <= 2
        self.nothing_bad_was_believed_and_no_cycle_ended_twice()


EXAMPLES = int(os.environ.get("WEARLINE_FAULT_EXAMPLES", "0"))
TestExtendedFaults = ExtendedFaults.TestCase
TestExtendedFaults.settings = settings(
    max_examples=EXAMPLES or 25, derandomize=not EXAMPLES, stateful_step_count=40, deadline=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
