"""Each rule of the handshake, one by one, on a clock that the test turns."""

from __future__ import annotations

import pytest

from tests.unit.fieldbus.world import World, by_hand, verdict_on
from wearline.messages import Decision
from wearline_fieldbus.core import cycle as c
from wearline_fieldbus.core.handshake import GUARDS, READY, TABLE, Handshake, State
from wearline_fieldbus.core.profiles import BASIC, Direction


def measuring(**settings: float | bool) -> World:
    """A world in the middle of cycle 7 of object 3."""
    world = by_hand(**settings)
    world.ask(measure=True, measure_number=7, stroke=70)
    world.turn(0.02)
    assert world.machine.state is State.MEASURING
    return world


def test_a_whole_cycle_step_by_step() -> None:
    world = measuring()
    (request,) = world.requests
    assert (request.object_index, request.measure_number, request.stroke) == (3, 7, 70)
    assert 2480 <= request.time_left_ms <= 2500
    assert not world.shown()["ready"] and not world.shown()["measure_finished"]
    world.judge()
    world.turn(0.02)
    shown = world.shown()
    assert shown["measure_finished"] and shown["passed"] and not shown["failed"] and not shown["ready"]
    assert (shown["result_code"], shown["echo"], shown["mean_error_um"], shown["max_error_um"]) == (1, 7, 12, 34)
    (outcome,) = world.outcomes
    assert outcome.was_told and outcome.passed and outcome.code == 1 and 0.0 < outcome.cycle_seconds < 0.1
    world.turn(1.0)
    assert world.shown()["measure_finished"], "the result stands as long as Measure does"
    world.ask(measure=False)
    world.turn(0.03)
    shown = world.shown()
    assert shown["ready"] and not shown["measure_finished"] and not shown["passed"]
    assert shown["echo"] == 0 and shown["result_code"] == 0 and shown["mean_error_um"] == 0xFFFF
    assert len(world.journal) == len(world.outcomes) == 1


@pytest.mark.parametrize(
    ("decision", "code", "passed"),
    [
        (Decision.FAILED, 2, False),
        (Decision.UNSURE, 3, False),
        (Decision.UNSURE, 1, True),
        (Decision.NOT_MEASURED, 12, False),
    ],
)
def test_passed_is_set_for_code_1_alone(decision: Decision, code: int, passed: bool) -> None:
    world = measuring()
    world.judge(decision, code=code, mean_error_mm=None)
    world.turn(0.02)
    shown = world.shown()
    assert (shown["result_code"], shown["passed"], shown["failed"]) == (code, passed, not passed)
    assert shown["mean_error_um"] == 0xFFFF


@pytest.mark.parametrize(
    ("decision", "code"), [(Decision.FAILED, 1), (Decision.NOT_MEASURED, 1), (Decision.PASSED, 2), (Decision.PASSED, 0)]
)
def test_a_verdict_that_contradicts_itself_is_no_verdict(decision: Decision, code: int) -> None:
    world = measuring()
    world.judge(decision, code=code)
    world.turn(0.02)
    assert (world.shown()["result_code"], world.shown()["passed"]) == (17, False)


def test_a_simulated_verdict_is_refused_by_a_real_plc_and_shown_to_a_simulated_one() -> None:
    world = measuring()
    world.judge(is_simulated=True)
    world.turn(0.02)
    assert (world.shown()["result_code"], world.shown()["passed"], world.shown()["simulated"]) == (19, False, True)
    world = World(plc_is_simulated=True)
    world.connect()
    world.turn(0.1)
    world.judge(is_simulated=True)
    world.turn(0.02)
    assert world.beliefs[0].passed and world.beliefs[0].simulated


def test_measure_is_accepted_only_when_ready_and_by_an_edge() -> None:
    world = World(has_plc_program=False)
    world.ask(start_camera=True, stop_camera=True, link_ok=True, measure=True, measure_number=5)
    world.connect()
    world.turn(0.1)
    assert not world.requests, "a Measure that stood before the link is no edge"
    assert not world.shown()["ready"]
    world.ask(measure=False)
    world.turn(0.05)
    assert world.shown()["ready"]
    world.feed(c.ServiceChanged("reconstruct", False))
    world.turn(0.02)
    assert not world.shown()["ready"] and world.shown()["fault"]
    world.ask(measure=True)
    world.turn(0.02)
    assert not world.requests and "a service" in world.said[-1]
    world.feed(c.ServiceChanged("reconstruct", True))
    world.turn(0.02)
    assert not world.requests, "an edge that was not accepted is never taken later"


def test_a_measure_number_is_needed_and_must_be_another_one() -> None:
    world = by_hand()
    world.ask(measure=True, measure_number=0)
    world.turn(0.02)
    assert not world.requests and "no measure number" in world.said[-1]
    world.ask(measure=False)
    world.turn(0.05)
    for _ in range(2):
        world.ask(measure=True, measure_number=9)
        world.turn(0.02)
        if world.machine.state is State.MEASURING:
            world.judge()
        world.turn(0.02)
        world.ask(measure=False)
        world.turn(0.05)
    assert len(world.requests) == 1 and "is that of the Measure before" in world.said[-1]


@pytest.mark.parametrize(
    "changes",
    [{"cycle_id": "other"}, {"object_index": 4}, {"measure_number": 8}],
)
def test_a_verdict_must_match_cycle_object_and_number(changes: dict[str, int | str]) -> None:
    world = measuring()
    request = world.requests[0]
    alien = request.replace(**changes)
    world.feed(c.VerdictCame(verdict_on(alien)))
    world.turn(0.05)
    assert world.machine.state is State.MEASURING and not world.outcomes
    world.judge(Decision.FAILED)
    world.turn(0.05)
    assert world.shown()["result_code"] == 2


def test_after_two_and_a_half_seconds_not_measured_is_written_with_the_echo() -> None:
    world = measuring()
    world.turn(2.4)
    assert not world.shown()["measure_finished"]
    world.turn(0.2)
    assert (world.shown()["result_code"], world.shown()["echo"], world.shown()["failed"]) == (10, 7, True)
    world.judge()
    world.turn(0.05)
    assert world.shown()["result_code"] == 10 and "late" in world.said[-1]
    assert [o.code for o in world.outcomes] == [10]


def test_a_verdict_at_the_deadline_comes_too_late() -> None:
    world = measuring()
    edge_s = world.machine.cycle.edge_s if world.machine.cycle else 0.0
    world.now_s = edge_s + 2.5
    world.judge()
    world.turn(0.02)
    assert [o.code for o in world.outcomes] == [10]


def test_after_three_seconds_nothing_is_written_for_the_cycle() -> None:
    world = measuring()
    world.now_s += 2.55
    world.feed(c.Tick())
    assert world.machine.state is State.TELLING
    # The link's thread gets round to it only now.
    world.now_s += 0.5
    world.poll()
    assert not world.shown()["measure_finished"]
    (outcome,) = world.outcomes
    assert not outcome.was_told and outcome.code == 10
    world.ask(measure=False)
    world.turn(0.6)
    assert world.shown()["ready"] and not any(
        values["measure_finished"] for at_s, values in world.blocks if at_s > outcome.cycle_seconds + 103.0
    )


def test_a_service_that_was_lost_is_the_reason_at_the_deadline_and_judge_at_once() -> None:
    world = measuring()
    world.feed(c.ServiceChanged("capture", False))
    world.turn(2.6)
    assert world.shown()["result_code"] == 17
    world = measuring()
    world.feed(c.ServiceChanged("judge", False))
    world.turn(0.02)
    assert world.shown()["result_code"] == 17


def test_the_camera_is_stopped_during_a_cycle_and_started_again() -> None:
    world = measuring()
    world.ask(stop_camera=False)
    world.turn(0.03)
    assert (world.shown()["result_code"], world.shown()["echo"]) == (24, 7)
    world.ask(measure=False)
    world.turn(0.05)
    assert not world.shown()["ready"]
    world.ask(stop_camera=True, start_camera=False)
    world.turn(0.05)
    assert not world.shown()["ready"], "Stop camera = 1 alone starts nothing"
    world.ask(start_camera=True)
    world.turn(0.03)
    world.ask(start_camera=False)
    world.turn(0.03)
    assert world.shown()["ready"], "Start camera is latched"


def test_an_object_change_is_confirmed_and_ends_a_cycle_under_way() -> None:
    world = by_hand()
    assert world.checks == [3] and world.shown()["object_changed"]
    world.ask(object_index=4)
    world.turn(0.03)
    assert world.checks == [3, 4]
    world.turn(0.03)
    assert world.shown()["object_changed"] and world.shown()["ready"]
    world.ask(measure=True, measure_number=1)
    world.turn(0.02)
    assert world.requests[0].object_index == 4 and not world.shown()["object_changed"]
    world.ask(object_index=5)
    world.turn(0.03)
    assert (world.shown()["result_code"], world.shown()["echo"]) == (18, 1)


def test_ready_waits_until_the_object_is_settled() -> None:
    world = by_hand()
    world.ask(object_index=4)
    world.poll()
    for answer, why in ((c.ObjectChecked(3, True), "object"), (c.ObjectChecked(4, False), "")):
        world.feed(answer)
        assert why in world.machine.why_not_ready() and bool(why) is bool(world.machine.why_not_ready())
    world.feed(c.Tick())
    world.poll()
    assert world.shown()["ready"] and not world.shown()["object_changed"], "judge does not know it: a Measure says 15"


def test_no_room_on_disk_withdraws_ready_and_a_failed_entry_is_code_20() -> None:
    world = by_hand()
    world.feed(c.RoomChanged(False))
    world.turn(0.02)
    assert not world.shown()["ready"] and world.shown()["fault"]
    world.feed(c.RoomChanged(True))
    world.turn(0.02)
    assert world.shown()["ready"] and not world.shown()["fault"]
    world.journal_fails = 1
    world.ask(measure=True, measure_number=7)
    world.turn(0.03)
    assert not world.requests, "what cannot be recorded is not measured"
    assert (world.shown()["result_code"], world.shown()["passed"], world.shown()["echo"]) == (20, False, 7)
    world = measuring()
    world.journal_fails = 1
    world.judge()
    world.turn(0.03)
    assert (world.shown()["result_code"], world.shown()["passed"], world.shown()["echo"]) == (20, False, 7)
    assert [o.code for o in world.outcomes] == [20]


def test_link_ok_and_a_frozen_life_counter_withdraw_ready() -> None:
    world = by_hand()
    world.ask(link_ok=False)
    world.turn(0.03)
    assert not world.shown()["ready"]
    world.ask(link_ok=True, plc_life=5)
    world.turn(0.03)
    assert world.shown()["ready"] and world.machine.is_linked
    world.turn(0.9)
    assert not world.shown()["ready"] and not world.machine.is_linked, "PLC in STOP"
    world.ask(plc_life=6)
    world.turn(0.03)
    assert world.shown()["ready"] and world.machine.is_linked


def test_a_plc_that_restarts_is_cleared_and_its_cycle_is_not_told() -> None:
    world = by_hand()
    world.ask(plc_life=5)
    world.turn(0.02)
    world.ask(measure=True, measure_number=7)
    world.turn(0.02)
    world.ask(measure=False, plc_life=0)
    world.turn(0.05)
    assert [(o.code, o.was_told) for o in world.outcomes] == [(23, False)]
    world.judge()
    world.turn(0.05)
    assert not any(values["measure_finished"] for _, values in world.blocks) and world.shown()["ready"]


def test_after_a_reconnect_the_block_is_cleared_before_ready() -> None:
    world = by_hand()
    world.cut()
    world.memory[10:20] = bytes.fromhex("17aa000100010001000a")
    world.turn(0.05)
    count = len(world.blocks)
    world.connect()
    assert world.machine.state is State.CLEARING
    world.turn(0.03)
    ready = [bool(values["ready"]) for _, values in world.blocks[count:]]
    assert ready == [False, True]


def test_a_short_cut_does_not_cost_the_result() -> None:
    world = measuring()
    world.cut()
    world.turn(0.2)
    world.judge(Decision.PASSED)
    world.turn(0.2)
    assert not world.outcomes
    world.connect()
    world.turn(0.03)
    assert (world.shown()["passed"], world.shown()["echo"]) == (True, 7)
    assert [o.was_told for o in world.outcomes] == [True]


def test_a_cut_during_which_the_plc_gave_up_is_not_told() -> None:
    world = measuring()
    world.cut()
    world.judge()
    world.ask(measure=False)
    world.connect()
    world.turn(0.05)
    assert [(o.code, o.was_told) for o in world.outcomes] == [(1, False)]
    assert world.shown()["ready"] and not any(values["measure_finished"] for _, values in world.blocks)


def test_a_long_cut_ends_the_cycle_untold() -> None:
    world = measuring()
    world.cut()
    world.turn(2.6)
    assert [(o.code, o.was_told) for o in world.outcomes] == [(10, False)] and world.machine.state is State.DOWN


@pytest.mark.parametrize("arrives", [0, 1])
def test_a_result_lost_with_the_connection_is_looked_for_and_never_written_again(arrives: int) -> None:
    world = measuring()
    world.judge()
    world.cut(arrives=arrives)
    count = len(world.blocks)
    assert world.machine.state is State.DOUBTFUL
    world.turn(0.1)
    world.connect()
    world.turn(0.05)
    assert [o.was_told for o in world.outcomes] == [bool(arrives)]
    assert not any(values["measure_finished"] for _, values in world.blocks[count:])


def test_foreign_writes_are_noticed_and_cleared() -> None:
    world = by_hand()
    world.memory[10] = 0x06
    world.turn(0.05)
    assert "somebody else" in " ".join(world.said)
    assert world.shown()["ready"] and not world.shown()["passed"]
    world.memory[11] = 200
    count = len(world.said)
    world.turn(0.05)
    assert len(world.said) == count, "the life counter is no result"


@pytest.mark.parametrize("point", ["accepted", "decided", "told"])
def test_a_restart_ends_every_cycle_exactly_once(point: str) -> None:
    world = measuring()
    if point != "accepted":
        world.judge()
    if point == "told":
        world.turn(0.02)
    world.kill()
    world.turn(0.05)
    world.connect()
    world.turn(0.1)
    expected = {"accepted": (23, False), "decided": (1, False), "told": (1, True)}[point]
    assert [(o.code, o.was_told) for o in world.outcomes] == [expected]
    assert all(entry.is_ended for entry in world.journal.values())


def test_a_result_that_arrived_before_a_restart_is_found_in_the_plc() -> None:
    world = measuring()
    world.judge()
    world.cut(arrives=1, is_told=False)
    world.boot()
    world.connect()
    world.turn(0.05)
    assert [(o.code, o.was_told) for o in world.outcomes] == [(1, True)]


def test_the_life_counter_steps_and_is_never_zero() -> None:
    world = by_hand()
    seen = set()
    for _ in range(400):
        world.turn(0.1)
        seen.add(int(world.shown()["vision_life"]))
    assert seen == set(range(1, 256))


def test_manual_mode_refuses_the_plc_and_measures_by_hand() -> None:
    world = by_hand()
    world.feed(c.MeasureWanted())
    assert not world.answers[-1].ok and "automatic" in world.answers[-1].text
    world.feed(c.ObjectWanted(8))
    assert not world.answers[-1].ok
    world.feed(c.ModeWanted("manual"))
    assert world.answers[-1].ok
    world.turn(0.03)
    assert not world.shown()["mode"] and not world.shown()["ready"]
    world.ask(measure=True, measure_number=1)
    world.turn(0.02)
    assert not world.requests and "manual" in world.said[-1]
    world.feed(c.ObjectWanted(8))
    world.feed(c.MeasureWanted())
    assert world.answers[-1].ok and world.requests[-1].object_index == 8
    world.feed(c.ModeWanted("auto"))
    assert not world.answers[-1].ok
    world.feed(c.MeasureWanted())
    assert not world.answers[-1].ok
    world.judge(is_simulated=True)
    assert [(o.code, o.was_told) for o in world.outcomes] == [(1, False)]
    assert not any(values["measure_finished"] for _, values in world.blocks)
    world.feed(c.MeasureWanted())
    world.turn(2.6)
    assert world.outcomes[-1].code == 10
    world.ask(measure=False)
    world.feed(c.ModeWanted("auto"))
    world.turn(0.05)
    assert world.shown()["mode"] and world.shown()["ready"]
    world.ask(measure=True, measure_number=2)
    world.turn(0.02)
    world.feed(c.ModeWanted("manual"))
    assert not world.answers[-1].ok and "under way" in world.answers[-1].text


def test_without_numbers_a_pause_is_kept_and_a_cut_ends_the_cycle() -> None:
    world = by_hand(numbered=False, minimum_pause_s=4.0)
    world.ask(measure=True)
    world.turn(0.02)
    world.judge()
    world.turn(0.02)
    assert world.shown()["passed"] and world.shown()["echo"] == 0
    world.ask(measure=False)
    world.turn(3.8)
    assert not world.shown()["ready"]
    world.turn(0.2)
    assert world.shown()["ready"]
    world.ask(measure=True)
    world.turn(0.02)
    world.cut()
    assert [(o.code, o.was_told) for o in world.outcomes] == [(1, True), (23, False)]
    world.connect()
    world.judge()
    world.turn(0.1)
    assert not world.shown()["measure_finished"]


def test_measure_that_falls_early_leaves_the_result_for_a_while() -> None:
    world = measuring()
    world.ask(measure=False)
    world.turn(0.1)
    world.judge()
    world.turn(0.4)
    assert world.shown()["measure_finished"]
    world.turn(0.2)
    assert world.shown()["ready"] and not world.shown()["measure_finished"]


def test_settings_that_would_break_the_deadlines_are_refused() -> None:
    with pytest.raises(ValueError, match="later than silent_after_s"):
        c.HandshakeSettings(answer_by_s=2.8)
    with pytest.raises(ValueError, match="minimum_pause_s"):
        c.HandshakeSettings(numbered=False, minimum_pause_s=2.0)


def test_the_table_names_only_guards_and_effects_that_exist_and_uses_all_of_them() -> None:
    used = {name for row in TABLE for name in row.guards} | set(READY)
    assert used == set(GUARDS)
    assert all(callable(getattr(Handshake, row.effect)) for row in TABLE)
    assert BASIC.span(Direction.RESPONSE) == (10, 20)
