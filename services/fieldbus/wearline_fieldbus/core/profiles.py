"""The process image: one declarative table per profile, and the codec that derives from it.

Everything else that knows a byte of the image (soft PLC, I/O monitor, documentation, TIA files) derives
from the same table. Numbers are big-endian, as the S7 stores them.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any

from wearline.errors import ConfigError

Value = bool | int | float | str
LIFE = ("plc_life", "vision_life", "plc_life_echo", "vision_life_echo")
MAX_DIRECTION_BYTES = 200
"""One direction fits one PDU of the smallest negotiated size (240 bytes, S7-1200), so it is never torn."""


class Direction(StrEnum):
    """Who writes a field. Each byte has exactly one writer."""

    REQUEST = "request"
    """The PLC writes, Wearline reads."""
    RESPONSE = "response"
    """Wearline writes, the PLC reads."""


@dataclass(frozen=True)
class Kind:
    """One data type of the image."""

    tia: str
    """Its name in TIA Portal."""
    size: int
    """Bytes; 0 = one bit."""
    code: str = ""
    """Of `struct`; empty for bits and strings."""


BOOL = Kind("Bool", 0)
BYTE = Kind("Byte", 1, "B")
WORD = Kind("Word", 2, "H")
DWORD = Kind("DWord", 4, "I")
REAL = Kind("Real", 4, "f")


def string(length: int) -> Kind:
    """An S7 string: maximum length, actual length, then ``length`` bytes."""
    return Kind(f"String[{length}]", length + 2)


@dataclass(frozen=True)
class Field:
    """One row of a profile's table."""

    name: str
    byte: int
    bit: int | None
    kind: Kind
    direction: Direction
    meaning: str
    is_needed: bool = False
    """Safety rests on it: a remap cannot leave it out."""
    is_numbering: bool = False
    """Needed unless the PLC does not number its measurements (``numbered: false``)."""

    @property
    def size(self) -> int:
        """Bytes that it touches."""
        return self.kind.size or 1

    @property
    def address(self) -> str:
        """As TIA Portal shows it: ``10.2`` or ``14``."""
        return f"{self.byte}.{self.bit}" if self.bit is not None else str(self.byte)


@dataclass(frozen=True)
class Profile:
    """A table of fields and where they lie."""

    name: str
    fields: tuple[Field, ...]

    def of(self, direction: Direction) -> tuple[Field, ...]:
        """The fields of one direction, in the order of the table."""
        return self._of[direction]

    def field(self, name: str) -> Field | None:
        """The field of that name, or None where a remap left it out."""
        return next((f for f in self.fields if f.name == name), None)

    def span(self, direction: Direction) -> tuple[int, int]:
        """First byte and the byte after the last one of one direction."""
        return self._spans[direction]

    # Asked at every poll, and a table never changes.
    @cached_property
    def _of(self) -> dict[Direction, tuple[Field, ...]]:
        return {d: tuple(f for f in self.fields if f.direction is d) for d in Direction}

    @cached_property
    def _spans(self) -> dict[Direction, tuple[int, int]]:
        return {
            d: (min(f.byte for f in fields), max(f.byte + f.size for f in fields))
            for d, fields in self._of.items() if fields
        }  # fmt: skip

    @cached_property
    def size(self) -> int:
        """Bytes of the whole image, from byte 0."""
        return max(f.byte + f.size for f in self.fields)

    @property
    def life_bytes(self) -> frozenset[int]:
        """Bytes of the life counters: their change says nothing but that somebody lives."""
        fields = [f for f in self.fields if f.name in LIFE]
        return frozenset(byte for f in fields for byte in range(f.byte, f.byte + f.size))

    def decode(self, image: bytes, direction: Direction) -> dict[str, Value]:
        """Values of one direction from the whole image.

        Raises:
            ValueError: the image is too short.
        """
        if len(image) < self.span(direction)[1]:
            raise ValueError(f"an image of {len(image)} bytes is shorter than profile {self.name}")
        return {f.name: _decode(f, image) for f in self.of(direction)}

    def encode(self, values: Mapping[str, Value], direction: Direction) -> bytes:
        """The block of one direction (from `span`'s first byte); absent values are 0.

        Raises:
            ValueError: an unknown name or a value that its type cannot hold.
        """
        fields = {f.name: f for f in self.of(direction)}
        start, end = self.span(direction)
        block = bytearray(end - start)
        for field in fields.values():
            _encode(field, block, start, values.get(field.name, "" if field.kind.tia.startswith("String") else 0))
        return bytes(block)


def _decode(field: Field, image: bytes) -> Value:
    if field.bit is not None:
        return bool(image[field.byte] >> field.bit & 1)
    if field.kind.code:
        value: Value = struct.unpack_from(f">{field.kind.code}", image, field.byte)[0]
        return value
    # A PLC that never wrote the string leaves lengths that cannot be: read no further than the field.
    length = min(image[field.byte + 1], field.kind.size - 2)
    return image[field.byte + 2 : field.byte + 2 + length].decode("latin-1")


def _encode(field: Field, block: bytearray, start: int, value: Value) -> None:
    at = field.byte - start
    if field.bit is not None:
        if value:
            block[at] |= 1 << field.bit
        return
    try:
        if field.kind.code:
            struct.pack_into(f">{field.kind.code}", block, at, value)
            return
    except struct.error as error:
        raise ValueError(f"{field.name} cannot hold {value!r} ({error})") from error
    room = field.kind.size - 2
    text = str(value).encode("latin-1", errors="replace")[:room]
    block[at : at + 2 + len(text)] = bytes((room, len(text))) + text


def _request(name: str, byte: int, bit: int | None, kind: Kind, meaning: str, **marks: bool) -> Field:
    return Field(name, byte, bit, kind, Direction.REQUEST, meaning, **marks)


def _response(name: str, byte: int, bit: int | None, kind: Kind, meaning: str, **marks: bool) -> Field:
    return Field(name, byte, bit, kind, Direction.RESPONSE, meaning, **marks)


NO_ERROR_UM = 0xFFFF
"""Word 14 or 16 where there is no figure."""

BASIC = Profile(
    "basic",
    (
        _request("start_camera", 0, 0, BOOL, "1 = camera starts capturing (latched until Stop camera is 0)"),
        _request("stop_camera", 0, 1, BOOL, "0 = camera stops capturing", is_needed=True),
        _request("measure", 0, 2, BOOL, "rising edge = measure this part; hold until Measure finished", is_needed=True),
        _request("link_ok", 0, 3, BOOL, "1 = PLC drives the handshake", is_needed=True),
        _request("object_index", 2, None, WORD, "object index of the part", is_needed=True),
        _request(
            "measure_number", 4, None, WORD, "1-65535, another one for every Measure, written before it",
            is_numbering=True,
        ),
        _request("stroke", 6, None, WORD, "the press' stroke counter"),
        _request("plc_life", 8, None, WORD, "life counter of the PLC, changes every scan (0 = not supervised)"),
        _response("ready", 10, 0, BOOL, "1 = a Measure will be accepted", is_needed=True),
        _response("measure_finished", 10, 1, BOOL, "1 = the result below is valid", is_needed=True),
        _response("passed", 10, 2, BOOL, "1 = part is good; only with result code 1", is_needed=True),
        _response("failed", 10, 3, BOOL, "1 = part is not good, or not proven good", is_needed=True),
        _response("mode", 10, 4, BOOL, "1 = automatic, 0 = manual (no Measure is accepted)"),
        _response("object_changed", 10, 5, BOOL, "1 = the object index of the PLC is now in force"),
        _response("fault", 10, 6, BOOL, "1 = equipment fault (a service, the camera or the disk)"),
        _response("simulated", 10, 7, BOOL, "1 = the result comes from a simulation", is_needed=True),
        _response("vision_life", 11, None, BYTE, "life counter of Wearline, 1-255"),
        _response("result_code", 12, None, WORD, "1 passed, 2 failed, 3 unsure, 10-99 not measured and why"),
        _response("mean_error_um", 14, None, WORD, "mean error [um], 65535 = none"),
        _response("max_error_um", 16, None, WORD, "largest absolute error [um], 65535 = none"),
        _response("echo", 18, None, WORD, "measure number of the Measure that the result answers", is_numbering=True),
    ),
)  # fmt: skip

PART_ID_LENGTH = 30
NO_STROKES = 0xFFFFFFFF
"""Remaining strokes where they cannot be told."""

EXTENDED = Profile(
    "extended",
    (
        _request("sequence", 0, None, WORD, "changes with every change of this block", is_needed=True),
        _request("trigger_enable", 2, 0, BOOL, "1 = triggers may come; 0 = reset", is_needed=True),
        _request(
            "trigger", 2, 1, BOOL, "rising edge = measure this part; hold until Trigger ack equals it", is_needed=True
        ),
        _request("result_ack", 2, 2, BOOL, "1 = result read; hold until Result valid is 0", is_needed=True),
        _request("command_execute", 2, 3, BOOL, "rising edge = do the command; hold until done or failed"),
        _request("clear_error", 2, 4, BOOL, "rising edge = forget Error and Buffer overrun"),
        _request("plc_life", 4, None, WORD, "life counter of the PLC, changes every scan (0 = not supervised)"),
        _request("vision_life_echo", 6, None, WORD, "Wearline's life counter, as the PLC last read it"),
        _request("command", 8, None, WORD, "1 = select object (argument), 2 = mode (argument 0 manual, 1 automatic)"),
        _request("argument", 10, None, WORD, "of the command"),
        _request(
            "measure_number", 12, None, WORD, "1-65535, another one for every trigger, written before it",
            is_needed=True,
        ),
        _request("stroke", 16, None, DWORD, "the press' stroke counter"),
        _request("part_id", 20, None, string(PART_ID_LENGTH), "as the PLC names the part"),
        _request("sequence_end", 52, None, WORD, "the same as sequence, or the block is torn", is_needed=True),
        _response("vision_life", 54, None, WORD, "life counter of Wearline, 1-65535"),
        _response("plc_life_echo", 56, None, WORD, "the PLC's life counter, as Wearline last read it"),
        _response("status_number", 58, None, WORD, "changes with every change of the status (bytes 58-69)"),
        _response("online", 60, 0, BOOL, "1 = measuring chain, disk and mode allow triggers"),
        _response("ready", 60, 1, BOOL, "1 = a trigger will be accepted", is_needed=True),
        _response("trigger_ack", 60, 2, BOOL, "equals Trigger once it was accepted", is_needed=True),
        _response("busy", 60, 3, BOOL, "1 = a part is being measured"),
        _response("exposure_done", 60, 4, BOOL, "1 = the picture is taken, the part may move"),
        _response("result_valid", 60, 5, BOOL, "1 = the result below is valid", is_needed=True),
        _response("buffer_overrun", 60, 6, BOOL, "1 = a result was given up because the PLC did not fetch it in time"),
        _response("error", 60, 7, BOOL, "1 = Error code says what was refused"),
        _response("mode", 61, 0, BOOL, "1 = automatic, 0 = manual (no trigger is accepted)"),
        _response("command_executing", 61, 1, BOOL, "1 = the command is being done"),
        _response("command_done", 61, 2, BOOL, "1 = done, until Execute is 0"),
        _response("command_failed", 61, 3, BOOL, "1 = refused, until Execute is 0"),
        _response("fault", 61, 4, BOOL, "1 = equipment fault (a service, the camera or the disk)"),
        _response("error_code", 62, None, WORD, "as result code; 101 not ready, 102 number, 103 unknown command"),
        _response("object_index", 64, None, WORD, "object in force"),
        _response("results_waiting", 66, None, WORD, "results in the buffer (8 at most), the shown one not counted"),
        _response("status_number_end", 68, None, WORD, "the same as status number, or the status is torn"),
        _response("result_number", 70, None, WORD, "1-65535, another one for every result", is_needed=True),
        _response("ok", 72, 0, BOOL, "1 = part is good; only with result code 1", is_needed=True),
        _response("nok", 72, 1, BOOL, "the opposite of OK in every valid result", is_needed=True),
        _response("unsure", 72, 2, BOOL, "1 = inside the guard band"),
        _response("simulated", 72, 3, BOOL, "1 = the result comes from a simulation", is_needed=True),
        _response("result_code", 74, None, WORD, "1 passed, 2 failed, 3 unsure, 10-99 not measured", is_needed=True),
        _response("echo", 76, None, WORD, "measure number of the trigger that the result answers", is_needed=True),
        _response("worst_zone", 78, None, WORD, "number of the recipe's zone with the largest error, 0 = none"),
        _response("echo_stroke", 80, None, DWORD, "stroke that the result answers"),
        _response("max_error_mm", 84, None, REAL, "largest absolute error [mm], -1 = none"),
        _response("p95_error_mm", 88, None, REAL, "95th percentile of the error in the worst region [mm], -1 = none"),
        _response("mean_error_mm", 92, None, REAL, "mean error [mm], -1 = none"),
        _response("wear_mm", 96, None, REAL, "wear of this stroke [mm], -1 = none"),
        _response("wear_percent", 100, None, WORD, "wear level in per cent of its limit, 65535 = not known"),
        _response("cycle_ms", 102, None, WORD, "from trigger to decision [ms]"),
        _response("remaining_strokes", 104, None, DWORD, "until the limit (90 % confidence), 16#FFFFFFFF = not known"),
        _response("echo_part_id", 108, None, string(PART_ID_LENGTH), "part that the result answers", is_needed=True),
        _response("result_number_end", 140, None, WORD, "the same as result number, or it is torn", is_needed=True),
    ),
)  # fmt: skip

PROFILES: Mapping[str, Profile] = {p.name: p for p in (BASIC, EXTENDED)}


def remapped(profile: Profile, moves: Mapping[str, str], is_numbered: bool, where: str) -> Profile:
    """The profile with fields moved (``name: "12.3"`` or ``"14"``) or left out (``"-"``), checked.

    Raises:
        ConfigError: an unknown field or address, an overlap, a byte with two writers, a field without which
            a stale result could be believed, or a direction that does not fit one PDU.
    """
    known = {f.name: f for f in profile.fields}
    for name in moves:
        if name not in known:
            raise ConfigError(f"profile {profile.name} has no field '{name}'", where, f"one of {', '.join(known)}")
    fields = tuple(f if f.name not in moves else _moved(f, moves[f.name], where) for f in profile.fields)
    kept = tuple(f for f in fields if f is not None)
    names = {f.name for f in kept}
    for field in profile.fields:
        if field.name in names:
            continue
        if field.is_needed or (field.is_numbering and is_numbered):
            hint = " or say 'numbered: false' and keep its pause" if field.is_numbering else ""
            raise ConfigError(f"'{field.name}' is left out, and safety rests on it", where, f"give it an address{hint}")
    moved = replace(profile, fields=kept)
    check_layout(moved, where)
    return moved


def _moved(field: Field, address: str, where: str) -> Field | None:
    text = address.strip()
    if text == "-":
        return None
    byte, dot, bit = text.partition(".")
    is_bit = field.bit is not None
    if not byte.isdigit() or bool(dot) is not is_bit or (is_bit and bit not in tuple("01234567")):
        wanted = "BYTE.BIT with a bit from 0 to 7" if is_bit else "a byte number"
        raise ConfigError(
            f"'{address}' is no address for '{field.name}'", where, f"write {wanted}, or '-' to leave it out"
        )
    if field.kind.size > 1 and int(byte) % 2:
        raise ConfigError(f"'{field.name}' at byte {byte} is at an odd byte", where, "the S7 wants words at even bytes")
    return replace(field, byte=int(byte), bit=int(bit) if is_bit else None)


def check_layout(profile: Profile, where: str) -> None:
    """Refuse overlaps, bytes with two writers and directions that are torn apart or too long.

    Raises:
        ConfigError: with both fields in the sentence.
    """
    bits: dict[tuple[int, int], Field] = {}
    writers: dict[int, Field] = {}
    for field in profile.fields:
        for byte in range(field.byte, field.byte + field.size):
            other = writers.setdefault(byte, field)
            if other.direction is not field.direction:
                raise ConfigError(
                    f"byte {byte} would have two writers ('{other.name}' and '{field.name}')", where,
                    "keep request and response in bytes of their own",
                )  # fmt: skip
            for bit in range(8) if field.bit is None else (field.bit,):
                taken = bits.setdefault((byte, bit), field)
                if taken is not field:
                    raise ConfigError(
                        f"'{field.name}' overlaps '{taken.name}' at byte {byte}", where, "move one of them"
                    )
    for direction in Direction:
        start, end = profile.span(direction)
        alien = next((f for f in profile.fields if f.direction is not direction and start <= f.byte < end), None)
        if alien is not None:
            raise ConfigError(
                f"'{alien.name}' lies inside the {direction} block (bytes {start}-{end - 1})", where,
                "keep each direction in one block, so that it travels in one piece",
            )  # fmt: skip
        if end - start > MAX_DIRECTION_BYTES:
            raise ConfigError(
                f"the {direction} block has {end - start} bytes", where,
                f"keep it within {MAX_DIRECTION_BYTES}, so that it travels in one piece",
            )  # fmt: skip


def image_rows(profile: Profile, image: bytes) -> list[dict[str, Any]]:
    """The image as rows for an I/O monitor: direction, address, type, name, value, meaning."""
    return [
        {
            "direction": f.direction.value,
            "address": f.address,
            "type": f.kind.tia,
            "name": f.name,
            "value": _decode(f, image) if len(image) >= f.byte + f.size else None,
            "meaning": f.meaning,
        }
        for f in profile.fields
    ]
