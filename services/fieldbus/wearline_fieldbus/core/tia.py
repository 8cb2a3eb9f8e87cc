"""What a PLC programmer imports into TIA Portal, and what the reference pages say: made from a profile's table.

``.udt``, ``.db`` and ``.scl`` are external source files ("Generate blocks from source") for S7-1200 and S7-1500.
The function blocks do, scan by scan, what the soft PLC does.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from wearline.messages import CODE_MEANING
from wearline_fieldbus.core.profiles import BASIC, EXTENDED, Direction, Field, Profile

VERSION = "0.1"
_SECOND_WRITER = {Direction.REQUEST: "PLC writes", Direction.RESPONSE: "Wearline writes"}


@dataclass(frozen=True)
class Member:
    """One line of the data type: a field, or a filler that keeps the next field at its address."""

    name: str
    tia: str
    field: Field | None = None


def type_name(profile: Profile) -> str:
    """Of the PLC data type."""
    return f"Wearline_{profile.name}"


def members(profile: Profile) -> list[Member]:
    """The members whose order gives every field the address of the table, by the S7's rules for standard access.

    Bits fill a byte upwards, bytes follow at once, anything longer begins at an even byte.

    Raises:
        ValueError: a layout that no order of members gives (a bit below one of the same byte that comes first).
    """
    found: list[Member] = []
    byte, bit = 0, 0
    for field in sorted(profile.fields, key=lambda f: (f.byte, f.bit or 0)):
        if field.bit is not None:
            while (byte, bit) != (field.byte, field.bit):
                if (byte, bit) > (field.byte, field.bit):
                    raise ValueError(f"{field.name} cannot lie at {field.address}")
                if byte < field.byte and bit == 0:
                    found.append(Member(f"spare_{byte}", "Byte"))
                    byte += 1
                else:
                    found.append(Member(f"spare_{byte}_{bit}", "Bool"))
                    byte, bit = (byte, bit + 1) if bit < 7 else (byte + 1, 0)
            found.append(Member(field.name, field.kind.tia, field))
            byte, bit = (byte, bit + 1) if bit < 7 else (byte + 1, 0)
            continue
        if bit:
            byte, bit = byte + 1, 0
        if field.size > 1:
            byte += byte % 2
        while byte < field.byte:
            step = 2 if byte % 2 == 0 and field.byte - byte >= 2 else 1
            found.append(Member(f"spare_{byte}", "Word" if step == 2 else "Byte"))
            byte += step
            if field.size > 1:
                byte += byte % 2
        if byte != field.byte:
            raise ValueError(f"{field.name} cannot lie at {field.address}")
        found.append(Member(field.name, field.kind.tia, field))
        byte += field.size
    return found


def udt(profile: Profile) -> str:
    """The PLC data type."""
    lines = [f'TYPE "{type_name(profile)}"', f"VERSION : {VERSION}", "   STRUCT"]
    for member in members(profile):
        note = "filler" if member.field is None else f"{member.field.address} {_note(member.field)}"
        lines.append(f"      {member.name} : {member.tia};   // {note}")
    return "\n".join([*lines, "   END_STRUCT;", "", "END_TYPE", ""])


def _note(field: Field) -> str:
    return f"[{_SECOND_WRITER[field.direction]}] {field.meaning}"


def db(profile: Profile) -> str:
    """The data block, with standard access: optimised blocks have no addresses and PUT/GET does not reach them."""
    return "\n".join(
        [
            f'DATA_BLOCK "Wearline_{profile.name}_DB"',
            "{ S7_Optimized_Access := 'FALSE' }",
            f"VERSION : {VERSION}",
            "NON_RETAIN",
            f'"{type_name(profile)}"',
            "",
            "BEGIN",
            "",
            "END_DATA_BLOCK",
            "",
        ]
    )


_BASIC_HEAD = """
   VAR_INPUT
      Enable : Bool;   // TRUE = measuring may go on
      Start : Bool;   // rising edge: a part lies there
      ObjectIndex : UInt;   // object index of the part
      Stroke : UInt;   // the press' stroke counter
      AllowSimulated : Bool;   // TRUE only on a test bench
   END_VAR
   VAR_OUTPUT
      Busy : Bool;   // a part waits for its result
      Done : Bool;   // the result below is there, until the next Start
      Accepted : Bool;   // part is proven good
      Rejected : Bool;   // part is not good, or not proven good
      TimedOut : Bool;   // no result came in time
      Code : UInt;   // result code, 0 = none
      VisionAlive : Bool;   // Wearline's life counter moves
   END_VAR
   VAR_IN_OUT
      Wl : "Wearline_basic";   // the data block
   END_VAR
   VAR
      step : UInt;   // 0 no part, 1 wait for Ready, 2 wait for the result, 3 wait until it is taken back
      pending : Bool;   // Start came
      startBefore : Bool;
      visionLife : Byte;
      life : UInt;
      patience : TON_TIME;
      silence : TON_TIME;
   END_VAR
   VAR RETAIN
      number : UInt;   // measure number; retained, so that no number comes twice after a restart
   END_VAR
"""

_BASIC_BODY = """
   // Life counters, both ways.
   IF #life >= 65535 THEN
      #life := 1;
   ELSE
      #life := #life + 1;
   END_IF;
   #Wl.plc_life := UINT_TO_WORD(#life);
   #silence(IN := #Wl.vision_life = #visionLife, PT := T#1s);
   #visionLife := #Wl.vision_life;
   #VisionAlive := NOT #silence.Q;

   #Wl.link_ok := TRUE;
   #Wl.start_camera := #Enable;
   #Wl.stop_camera := #Enable;
   #Wl.object_index := UINT_TO_WORD(#ObjectIndex);
   #patience(IN := #step = 2, PT := T#3s);

   IF #Start AND NOT #startBefore THEN
      #pending := TRUE;
   END_IF;
   #startBefore := #Start;

   IF #step = 0 AND #pending THEN
      #pending := FALSE;
      #Done := FALSE;
      #Accepted := FALSE;
      #Rejected := FALSE;
      #TimedOut := FALSE;
      #Code := 0;
      IF #number >= 65535 THEN
         #number := 1;
      ELSE
         #number := #number + 1;
      END_IF;
      #step := 1;
   END_IF;

   IF #step = 1 AND #Wl.ready AND NOT #Wl.measure_finished THEN
      // The number first: Measure must never be seen with the number of the part before.
      #Wl.measure_number := UINT_TO_WORD(#number);
      #Wl.stroke := UINT_TO_WORD(#Stroke);
      #Wl.measure := TRUE;
      #step := 2;
   ELSIF #step = 2 THEN
      IF #patience.Q THEN
         #TimedOut := TRUE;
         #Accepted := FALSE;
         #Rejected := TRUE;
         #Done := TRUE;
      ELSIF #Wl.measure_finished AND WORD_TO_UINT(#Wl.echo) = #number THEN
         #Code := WORD_TO_UINT(#Wl.result_code);
         // Anything that does not prove the part good rejects it.
         #Accepted := #Wl.passed AND NOT #Wl.failed AND #Code = 1 AND (NOT #Wl.simulated OR #AllowSimulated);
         #Rejected := NOT #Accepted;
         #Done := TRUE;
      END_IF;
      IF #Done THEN
         #Wl.measure := FALSE;
         #step := 3;
      END_IF;
   ELSIF #step = 3 AND NOT #Wl.measure_finished THEN
      #step := 0;
   END_IF;
   #Busy := #step = 1 OR #step = 2;
"""

_EXTENDED_HEAD = """
   VAR_INPUT
      Enable : Bool;   // TRUE = measuring may go on
      Start : Bool;   // rising edge: a part lies there
      ObjectIndex : UInt;   // object index of the part
      Stroke : UDInt;   // the press' stroke counter
      PartId : String[30];   // as the line names the part
      AllowSimulated : Bool;   // TRUE only on a test bench
   END_VAR
   VAR_OUTPUT
      Busy : Bool;   // a part waits for its result
      MayMove : Bool;   // the picture of the part is taken
      Done : Bool;   // the result below is there, until the next Start
      Accepted : Bool;   // part is proven good
      Rejected : Bool;   // part is not good, or not proven good
      TimedOut : Bool;   // no result came in time
      Code : UInt;   // result code, 0 = none
      VisionAlive : Bool;   // Wearline's life counter moves
   END_VAR
   VAR_IN_OUT
      Wl : "Wearline_extended";   // the data block
   END_VAR
   VAR
      step : UInt;   // 0 no part, 1 wait for Ready, 2 wait for the acknowledgement, 3 wait for the result
      selected : Bool;   // the object was in force once
      pending : Bool;   // Start came
      startBefore : Bool;
      visionLife : Word;
      lastResult : Word;   // number of the last result that was read
      life : UInt;
      sequence : UInt;
      patience : TON_TIME;
      silence : TON_TIME;
      command : TON_TIME;
   END_VAR
   VAR RETAIN
      number : UInt;   // measure number; retained, so that no number comes twice after a restart
   END_VAR
"""

_EXTENDED_BODY = """
   // Life counters, both ways.
   IF #life >= 65535 THEN
      #life := 1;
   ELSE
      #life := #life + 1;
   END_IF;
   IF #sequence >= 65535 THEN
      #sequence := 1;
   ELSE
      #sequence := #sequence + 1;
   END_IF;
   // The block is torn while its two ends differ.
   #Wl.sequence := UINT_TO_WORD(#sequence);
   #silence(IN := #Wl.vision_life = #visionLife, PT := T#1s);
   #visionLife := #Wl.vision_life;
   #VisionAlive := NOT #silence.Q;
   #Wl.plc_life := UINT_TO_WORD(#life);
   #Wl.vision_life_echo := #Wl.vision_life;
   #Wl.trigger_enable := #Enable;
   #patience(IN := #step >= 2, PT := T#3s);
   #command(IN := #Wl.command_execute, PT := T#2s);

   IF #Start AND NOT #startBefore THEN
      #pending := TRUE;
   END_IF;
   #startBefore := #Start;

   // A status that is torn says nothing in this scan.
   IF #Wl.status_number = #Wl.status_number_end THEN
      IF #step = 0 AND #pending AND #selected THEN
         #pending := FALSE;
         #Done := FALSE;
         #Accepted := FALSE;
         #Rejected := FALSE;
         #TimedOut := FALSE;
         #Code := 0;
         IF #number >= 65535 THEN
            #number := 1;
         ELSE
            #number := #number + 1;
         END_IF;
         #step := 1;
      END_IF;

      // The object first.
      IF NOT #selected OR #Wl.command_execute OR WORD_TO_UINT(#Wl.object_index) <> #ObjectIndex THEN
         IF WORD_TO_UINT(#Wl.object_index) = #ObjectIndex AND NOT #Wl.command_execute THEN
            #selected := TRUE;
         ELSIF #Wl.command_execute THEN
            IF #Wl.command_done OR #Wl.command_failed OR #command.Q THEN
               #Wl.command_execute := FALSE;
            END_IF;
         ELSIF #Wl.online AND NOT (#Wl.command_executing OR #Wl.command_done OR #Wl.command_failed) THEN
            #Wl.command := UINT_TO_WORD(1);
            #Wl.argument := UINT_TO_WORD(#ObjectIndex);
            #Wl.command_execute := TRUE;
         END_IF;
      ELSIF #step = 1 AND #Wl.ready AND NOT #Wl.trigger_ack THEN
         // Who the part is first: the trigger must never be seen with the names of the part before.
         #Wl.measure_number := UINT_TO_WORD(#number);
         #Wl.stroke := UDINT_TO_DWORD(#Stroke);
         #Wl.part_id := #PartId;
         #Wl.trigger := TRUE;
         #step := 2;
      END_IF;

      IF #step = 2 AND #Wl.trigger_ack THEN
         #Wl.trigger := FALSE;
         #step := 3;
      END_IF;
      #MayMove := #step = 0 OR (#step = 3 AND #Wl.exposure_done);

      IF #step >= 2 THEN
         IF #patience.Q THEN
            #TimedOut := TRUE;
            #Accepted := FALSE;
            #Rejected := TRUE;
            #Done := TRUE;
         ELSIF #Wl.result_valid AND NOT #Wl.result_ack AND #Wl.result_number = #Wl.result_number_end
               AND #Wl.result_number <> #lastResult AND WORD_TO_UINT(#Wl.echo) = #number
               AND DWORD_TO_UDINT(#Wl.echo_stroke) = #Stroke AND #Wl.echo_part_id = #PartId THEN
            #Code := WORD_TO_UINT(#Wl.result_code);
            // OK and NOK are opposites; anything that does not prove the part good rejects it.
            #Accepted := #Wl.ok AND NOT #Wl.nok AND #Code = 1 AND (NOT #Wl.simulated OR #AllowSimulated);
            #Rejected := NOT #Accepted;
            #Done := TRUE;
         END_IF;
         IF #Done THEN
            #Wl.trigger := FALSE;
            #step := 0;
         END_IF;
      END_IF;

      // Every valid result is acknowledged, whether or not it is this part's.
      #Wl.result_ack := #Wl.result_valid;
      IF #Wl.result_ack THEN
         #lastResult := #Wl.result_number;
      END_IF;
   END_IF;
   #Busy := #step >= 1;
   #Wl.sequence_end := UINT_TO_WORD(#sequence);
"""

_BLOCKS: Mapping[str, tuple[str, str]] = {
    BASIC.name: (_BASIC_HEAD, _BASIC_BODY),
    EXTENDED.name: (_EXTENDED_HEAD, _EXTENDED_BODY),
}


def scl(profile: Profile) -> str:
    """The function block with the whole PLC side; what it writes to fields that a remap left out goes with them.

    Raises:
        ValueError: it reads a field that was left out.
    """
    head, body = _BLOCKS[profile.name]
    full = {f.name for f in (BASIC if profile.name == BASIC.name else EXTENDED).fields}
    missing = full - {f.name for f in profile.fields}
    lines = [line for line in body.strip("\n").splitlines() if not any(f"#Wl.{name} :=" in line for name in missing)]
    read = next((name for name in sorted(missing) if any(re.search(rf"#Wl\.{name}\b", line) for line in lines)), None)
    if read is not None:
        raise ValueError(f"{read} is left out, and the function block reads it")
    return "\n".join(
        [
            f'FUNCTION_BLOCK "FB_Wearline_{profile.name}"',
            "{ S7_Optimized_Access := 'TRUE' }",
            f"VERSION : {VERSION}",
            *head.strip("\n").splitlines(),
            "",
            "BEGIN",
            *lines,
            "END_FUNCTION_BLOCK",
            "",
        ]
    )


def sheet(profile: Profile, number: int, poll_ms: float) -> str:
    """One page for who commissions the PLC."""
    name = profile.name
    start, end = profile.span(Direction.RESPONSE)
    return "\n".join(
        [
            f"# Commissioning sheet: Wearline, profile {name}",
            "",
            f"1. TIA Portal, *External source files*: add `Wearline_{name}.udt`, `Wearline_{name}.db` and "
            f"`FB_Wearline_{name}.scl`, in this order; *Generate blocks from source*.",
            f"2. Give the data block the number {number} (`fieldbus.plc.db` in cell.yaml). Its property "
            "*Optimized block access* is off; leave it off.",
            "3. CPU, *Protection & Security*, *Connection mechanisms*: permit PUT/GET. It is not authenticated: keep "
            "port 102 reachable from the Wearline host alone, and let no other DB be non-optimised.",
            f"4. Call `FB_Wearline_{name}` once in every scan of OB1 with the data block as `Wl`. Nobody else writes "
            f"its bytes; bytes {start}-{end - 1} belong to Wearline.",
            "5. Load, run. In the watch table the life counter of Wearline moves ten times a second.",
            "6. Prove it before production: a good part gives Accepted; a bad one Rejected; a pulled cable while a "
            "part waits gives Rejected with TimedOut within 3 s; CPU to STOP withdraws Ready within 1 s.",
            "",
            "| what | value |",
            "| --- | --- |",
            f"| data block | {profile.size} bytes, standard access |",
            f"| poll | every {poll_ms:g} ms |",
            "| result | within 2.5 s of the Measure edge; nothing is written after 3 s |",
            "| Accepted | only if every sign agrees: good, not bad, code 1, this part's number, in time |",
            "",
            "Word order is big-endian, as the S7 has it. An S7-300 or S7-400 takes the data block, not the function "
            "block (it has no UInt): port it statement by statement.",
            "",
        ]
    )


def reference_page(profiles: Mapping[str, Profile]) -> str:
    """docs/reference: the process image of every profile and the result codes."""
    lines = [
        "# Process image",
        "",
        "Made from the tables in `services/fieldbus`; do not edit (`python tests/unit/fieldbus/reference_page.py`).",
        "All numbers are big-endian. One direction travels in one piece. Each byte has one writer.",
    ]
    for profile in profiles.values():
        lines += ["", f"## Profile `{profile.name}` ({profile.size} bytes)"]
        for direction in Direction:
            start, end = profile.span(direction)
            lines += [
                "",
                f"### {direction.value.capitalize()}: {_SECOND_WRITER[direction]}, bytes {start}-{end - 1}",
                "",
            ]
            lines += ["| address | type | name | meaning |", "| ---: | --- | --- | --- |"]
            lines += [f"| {f.address} | {f.kind.tia} | `{f.name}` | {f.meaning} |" for f in profile.of(direction)]
    lines += ["", "## Result codes", "", "| code | name | meaning |", "| ---: | --- | --- |"]
    lines += [f"| {int(code)} | {code.name} | {meaning} |" for code, meaning in CODE_MEANING.items()]
    return "\n".join([*lines, ""])


def kit(profile: Profile, number: int, poll_ms: float) -> Iterator[tuple[str, str]]:
    """File names and contents of the whole kit."""
    name = type_name(profile)
    yield f"{name}.udt", udt(profile)
    yield f"{name}.db", db(profile)
    yield f"FB_{name}.scl", scl(profile)
    yield f"{name}_sheet.md", sheet(profile, number, poll_ms)
