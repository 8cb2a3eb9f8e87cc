"""The PLC kit: its addresses are those of the table, its function block does what the soft PLC does, scan by scan."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.unit.fieldbus.reference_page import PAGE
from tests.unit.fieldbus.scl import Block, Parser, SclError, offsets_of
from tests.unit.fieldbus.test_handshake_machine import is_good
from tests.unit.fieldbus.world import World
from wearline.cli import main
from wearline.messages import Decision
from wearline_fieldbus.core.extended import EXTENDED_READY, EXTENDED_TABLE, ExtendedHandshake
from wearline_fieldbus.core.handshake import State
from wearline_fieldbus.core.profiles import BASIC, EXTENDED, PROFILES, Profile, Value, remapped
from wearline_fieldbus.core.soft_plc import Belief, SoftPlcSettings
from wearline_fieldbus.core.tia import db, reference_page, scl, udt


@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda p: p.name)
def test_the_data_type_puts_every_field_at_its_address(profile: Profile) -> None:
    offsets = offsets_of(udt(profile))
    assert {f.name: offsets[f.name] for f in profile.fields} == {f.name: (f.byte, f.bit) for f in profile.fields}
    assert "S7_Optimized_Access := 'FALSE'" in db(profile)


def test_a_remap_gets_fillers() -> None:
    moves = {
        "measure": "0.6",
        "start_camera": "-",
        "echo": "24",
        "vision_life": "27",
        "result_code": "-",
        "ready": "12.3",
    }
    profile = remapped(BASIC, moves, True, "here")
    offsets = offsets_of(udt(profile))
    assert {f.name: offsets[f.name] for f in profile.fields} == {f.name: (f.byte, f.bit) for f in profile.fields}


def test_a_block_that_reads_a_field_that_was_left_out_is_refused() -> None:
    with pytest.raises(ValueError, match="vision_life"):
        scl(remapped(BASIC, {"vision_life": "-"}, True, "here"))
    assert "start_camera" not in scl(remapped(BASIC, {"start_camera": "-"}, True, "here"))


def test_the_reference_page_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == reference_page(PROFILES), "run tests/unit/fieldbus/reference_page.py"


def test_the_command_writes_what_tia_portal_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plc-kit", "--profile", "extended", "--out", str(tmp_path / "kit")]) == 0
    names = sorted(path.name for path in (tmp_path / "kit").iterdir())
    assert names == [
        "FB_Wearline_extended.scl", "Wearline_extended.db", "Wearline_extended.udt", "Wearline_extended_sheet.md",
    ]  # fmt: skip
    raw = (tmp_path / "kit" / "Wearline_extended.udt").read_bytes()
    assert raw.startswith(b'\xef\xbb\xbfTYPE "Wearline_extended"\r\n')
    cell = {"cell": "c", "data_dir": ".", "fieldbus": {"remap": {"fault": "-"}, "plc": {"db": 77}}}
    (tmp_path / "cell.yaml").write_text(yaml.safe_dump(cell))
    assert main(["plc-kit", "--config", str(tmp_path / "cell.yaml"), "--out", str(tmp_path / "two")]) == 0
    assert "number 77" in (tmp_path / "two" / "Wearline_basic_sheet.md").read_text()
    assert "fault" not in (tmp_path / "two" / "Wearline_basic.udt").read_text()
    capsys.readouterr()
    for section in ({"handshake": {"numbered": False}}, {"remap": {"vision_life": "-"}}):
        (tmp_path / "cell.yaml").write_text(yaml.safe_dump({**cell, "fieldbus": section}))
        assert main(["plc-kit", "--config", str(tmp_path / "cell.yaml"), "--out", str(tmp_path / "no")]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def parsed(profile: Profile) -> Block:
    return Parser(scl(profile), udt(profile)).block()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("#Wl.measure := TRUE;", "#Wl.measure := 1;"),
        ("#Wl.measure := TRUE;", "#Wl.mesure := TRUE;"),
        ("UINT_TO_WORD(#life)", "#life"),
        ("WORD_TO_UINT(#Wl.echo) = #number", "#Wl.echo = #number"),
        ("#step := 2;", "#step := 2"),
        ("END_IF;\n   #Busy", "#Busy"),
        ("#Enable;", "#Enable AND;"),
        ("#startBefore := #Start;", "#Start := #startBefore;"),
    ],
)
def test_the_interpreter_refuses_what_tia_portal_would(old: str, new: str) -> None:
    source = scl(BASIC)
    assert old in source
    with pytest.raises(SclError):
        Parser(source.replace(old, new), udt(BASIC)).block()


class Recorded(World):
    """Notes what the soft PLC saw, wrote and believed at each scan."""

    def __post_init__(self) -> None:
        self.trace: list[tuple[float, dict[str, Value], dict[str, Value], bool, Belief | None]] = []
        super().__post_init__()

    def scan(self) -> None:
        saw, stroke, count = self.shown(), self.plc.stroke, len(self.beliefs)
        super().scan()
        belief = self.beliefs[-1] if len(self.beliefs) > count else None
        self.trace.append((self.now_s, saw, self.plc.request(), self.plc.stroke != stroke, belief))


def recorded(profile: Profile, seed: int, seconds: float) -> Recorded:
    """A run in which verdicts are late, missing or bad, the link is cut and the service is killed."""
    chance = random.Random(seed)
    machine: dict[str, Any] = {}
    if profile is EXTENDED:
        machine = {"machine_type": ExtendedHandshake, "table": EXTENDED_TABLE, "ready": tuple(EXTENDED_READY)}
    world = Recorded(plc_settings=SoftPlcSettings(stroke_period_s=0.4), profile=profile, **machine)
    world.connect()
    end_s = world.now_s + seconds
    decided: set[str] = set()
    while world.now_s < end_s:
        world.turn(0.01)
        cycle = world.machine.cycle
        if cycle and world.machine.state is State.MEASURING and cycle.cycle_id not in decided and chance.random() < 0.1:
            decided.add(cycle.cycle_id)
            if chance.random() < 0.9:
                good = is_good(world.parts[cycle.cycle_id])
                world.judge(Decision.PASSED if good else Decision.FAILED, is_simulated=chance.random() < 0.05)
        if chance.random() < 0.003:
            world.cut(chance.randint(0, 2))
        if not world.is_connected and chance.random() < 0.03:
            world.connect()
        if chance.random() < 0.001:
            world.kill()
    return world


@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda p: p.name)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_function_block_does_what_the_soft_plc_does_scan_by_scan(profile: Profile, seed: int) -> None:
    world = recorded(profile, seed, 90.0)
    block = parsed(profile)
    life = ("plc_life", "sequence", "sequence_end")
    names = [name for name in world.trace[0][2] if name not in life]
    believed: list[tuple[bool, int]] = []
    was_done, waits = False, 0
    for now_s, saw, wrote, is_new_part, _ in world.trace:
        block.db.update(saw)
        part = {"ObjectIndex": int(wrote.get("object_index", wrote.get("argument", 0))), "Stroke": int(wrote["stroke"])}
        if profile is EXTENDED:
            part["PartId"] = str(wrote["part_id"])  # type: ignore[assignment]
        block.scan(now_s, Enable=True, Start=is_new_part, AllowSimulated=True, **part)
        if block.values["Done"] and not was_done:
            believed.append((block.values["Accepted"], block.values["Code"]))
        was_done = block.values["Done"]
        asked = {name: block.db[name] for name in names}
        wanted = {name: wrote[name] for name in names}
        for late in ("measure_number", "stroke", "part_id", "command", "argument"):
            # The soft PLC names the part when it comes, the block with its trigger: what counts is then.
            if not (asked.get("measure") or asked.get("trigger")) or late in ("command", "argument"):
                asked.pop(late, None)
                wanted.pop(late, None)
        if asked != wanted:
            waits += 1
            # A timer's output is a scan late, and what follows from it one more.
            assert waits <= 3, (now_s, {k: (asked[k], wanted[k]) for k in asked if asked[k] != wanted[k]})
        else:
            waits = 0
    beliefs = [(b.passed, b.code) for b in world.beliefs]
    assert len(beliefs) > 30 and len({code for _, code in beliefs}) >= 3
    # A part that was timed out is new to both; the last one may be under way.
    assert believed[: len(beliefs)] == beliefs[: len(believed)] and abs(len(believed) - len(beliefs)) <= 1


def test_the_function_block_believes_nothing_that_is_not_proven() -> None:
    good: dict[str, Value] = {
        "measure_finished": True, "passed": True, "failed": False, "simulated": False, "result_code": 1, "echo": 1,
    }  # fmt: skip
    for changes, accepted in (
        ({}, True), ({"failed": True}, False), ({"passed": False}, False), ({"result_code": 2}, False),
        ({"simulated": True}, False), ({"echo": 2}, None), ({"measure_finished": False}, None),
    ):  # fmt: skip
        block = parsed(BASIC)
        block.scan(0.0, Enable=True, Start=True, ObjectIndex=1, Stroke=9, AllowSimulated=False)
        block.db.update({"ready": True, "measure_finished": True})
        block.scan(0.005, Start=False)
        assert not block.db["measure"], "the result of another part still stands"
        block.db["measure_finished"] = False
        block.scan(0.01)
        assert block.db["measure"] and block.db["measure_number"] == 1 and block.values["Busy"]
        block.db.update({"ready": False, **good, **changes})
        block.scan(0.02)
        assert block.values["Accepted"] is bool(accepted) and block.values["Rejected"] is (accepted is False)
        if accepted is None:
            block.scan(3.2)
            block.scan(3.21)
            assert block.values["TimedOut"] and block.values["Rejected"] and not block.values["Accepted"]
        assert not block.db["measure"]


def test_the_extended_block_believes_nothing_that_is_not_proven() -> None:
    good: dict[str, Value] = {
        "result_valid": True, "ok": True, "nok": False, "simulated": False, "result_code": 1, "echo": 1,
        "echo_stroke": 9, "echo_part_id": "T", "result_number": 5, "result_number_end": 5,
    }  # fmt: skip
    for changes, accepted in (
        ({}, True), ({"nok": True}, False), ({"ok": False}, False), ({"result_code": 2}, False),
        ({"simulated": True}, False), ({"echo": 2}, None), ({"echo_stroke": 8}, None), ({"echo_part_id": "U"}, None),
        ({"result_valid": False}, None), ({"result_number_end": 4}, None), ({"status_number": 1}, None),
        ({"result_number": 0, "result_number_end": 0}, None),
    ):  # fmt: skip
        block = parsed(EXTENDED)
        block.db.update({"online": True, "object_index": 3})
        part = {"ObjectIndex": 3, "Stroke": 9, "PartId": "T", "Enable": True, "AllowSimulated": False}
        block.scan(0.0, Start=True, **part)
        block.scan(0.01, Start=False)
        block.db.update({"ready": True, "trigger_ack": True})
        block.scan(0.02)
        assert not block.db["trigger"], "the acknowledgement of another trigger still stands"
        block.db["trigger_ack"] = False
        block.scan(0.03)
        assert block.db["trigger"] and block.db["measure_number"] == 1 and block.db["part_id"] == "T"
        block.db.update({"ready": False, "trigger_ack": True})
        block.scan(0.04)
        assert not block.db["trigger"] and block.values["Busy"] and not block.values["MayMove"]
        block.db["exposure_done"] = True
        block.scan(0.05)
        assert block.values["MayMove"]
        block.db.update({**good, **changes})
        block.scan(0.06)
        assert block.values["Accepted"] is bool(accepted) and block.values["Rejected"] is (accepted is False)
        assert block.db["result_ack"] is (block.db["result_valid"] and "status_number" not in changes)
        if accepted is None:
            block.db["status_number"] = 0
            block.db["result_valid"] = False
            block.scan(3.2)
            block.scan(3.21)
            assert block.values["TimedOut"] and block.values["Rejected"] and not block.values["Accepted"]
