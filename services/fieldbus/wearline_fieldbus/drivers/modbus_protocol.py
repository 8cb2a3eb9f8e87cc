"""Modbus TCP without sockets: frames, requests answered from a process image, and the requests of our own client.

Source: MODBUS Application Protocol Specification V1.1b3; MODBUS Messaging on TCP/IP Implementation Guide V1.0b.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

READ_COILS, READ_INPUTS, READ_HOLDING, READ_REGISTERS = 1, 2, 3, 4
WRITE_COIL, WRITE_REGISTER, WRITE_COILS, WRITE_REGISTERS = 5, 6, 15, 16
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, NO_TARGET = 1, 2, 3, 11
MAX_BITS, MAX_REGISTERS, MAX_WRITTEN = 2000, 125, 123
HEADER = struct.Struct(">HHHB")
"""Transaction, protocol (0), length of what follows, unit."""
MAX_LENGTH = 254


class FrameError(ValueError):
    """What arrived is no Modbus TCP: the stream cannot be followed any further."""


@dataclass(frozen=True)
class Frame:
    """One request or answer."""

    transaction: int
    unit: int
    pdu: bytes

    def encoded(self) -> bytes:
        """As it travels."""
        return HEADER.pack(self.transaction, 0, len(self.pdu) + 1, self.unit) + self.pdu


def frames(received: bytearray) -> list[Frame]:
    """Take every whole frame out of what was received so far; the rest stays.

    Raises:
        FrameError: the protocol is not 0 or the length cannot be.
    """
    found = []
    while len(received) >= HEADER.size:
        transaction, protocol, length, unit = HEADER.unpack_from(received)
        if protocol != 0 or not 2 <= length <= MAX_LENGTH:
            raise FrameError(f"protocol {protocol}, length {length}")
        if len(received) < 6 + length:
            break
        found.append(Frame(transaction, unit, bytes(received[7 : 6 + length])))
        del received[: 6 + length]
    return found


@dataclass(frozen=True)
class Area:
    """What a server offers: an image, and the registers that a client may write."""

    image: bytes
    """Register n is bytes 2n and 2n + 1; bit n is bit n % 8 of byte n // 8."""
    writable: range = range(0)
    """Registers that may be written."""


class RefusedError(Exception):
    """A request that gets an exception answer."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


def answer(pdu: bytes, area: Area, write: Callable[[int, bytes], None]) -> bytes:
    """The answer to one request; ``write`` gets first byte and content of what it writes.

    Anything that is not allowed gets the exception that the specification names, and changes nothing.
    """
    function = pdu[0]
    try:
        if function in (READ_COILS, READ_INPUTS):
            return _read_bits(pdu, area.image)
        if function in (READ_HOLDING, READ_REGISTERS):
            return _read_registers(pdu, area.image)
        if function in (WRITE_REGISTER, WRITE_REGISTERS):
            return _write(pdu, area, write)
    except RefusedError as refusal:
        return bytes((function | 0x80, refusal.code))
    # Single bits cannot be written: their byte has one writer, and its other bits would be read back and written.
    return bytes((function | 0x80, ILLEGAL_FUNCTION))


def _start_and_count(pdu: bytes, most: int, available: int) -> tuple[int, int]:
    if len(pdu) != 5:
        raise RefusedError(ILLEGAL_VALUE)
    start, count = struct.unpack_from(">HH", pdu, 1)
    if not 1 <= count <= most:
        raise RefusedError(ILLEGAL_VALUE)
    if start + count > available:
        raise RefusedError(ILLEGAL_ADDRESS)
    return start, count


def _read_bits(pdu: bytes, image: bytes) -> bytes:
    start, count = _start_and_count(pdu, MAX_BITS, 8 * len(image))
    packed = bytearray((count + 7) // 8)
    for i in range(count):
        packed[i // 8] |= (image[(start + i) // 8] >> (start + i) % 8 & 1) << i % 8
    return bytes((pdu[0], len(packed))) + packed


def _read_registers(pdu: bytes, image: bytes) -> bytes:
    start, count = _start_and_count(pdu, MAX_REGISTERS, len(image) // 2)
    return bytes((pdu[0], 2 * count)) + image[2 * start : 2 * (start + count)]


def _write(pdu: bytes, area: Area, write: Callable[[int, bytes], None]) -> bytes:
    if pdu[0] == WRITE_REGISTER:
        if len(pdu) != 5:
            raise RefusedError(ILLEGAL_VALUE)
        start, count, content = struct.unpack_from(">H", pdu, 1)[0], 1, pdu[3:5]
    else:
        if len(pdu) < 8:
            raise RefusedError(ILLEGAL_VALUE)
        start, count, length = struct.unpack_from(">HHB", pdu, 1)
        content = pdu[6:]
        if not 1 <= count <= MAX_WRITTEN or length != 2 * count or len(content) != length:
            raise RefusedError(ILLEGAL_VALUE)
    if start not in area.writable or start + count - 1 not in area.writable:
        raise RefusedError(ILLEGAL_ADDRESS)
    write(2 * start, content)
    return pdu[:5]


def read_inputs(start: int, count: int) -> bytes:
    """Request for discrete inputs."""
    return struct.pack(">BHH", READ_INPUTS, start, count)


def write_coils(start: int, values: list[bool]) -> bytes:
    """Request to set coils, all in one."""
    packed = bytearray((len(values) + 7) // 8)
    for i, value in enumerate(values):
        packed[i // 8] |= value << i % 8
    return struct.pack(">BHHB", WRITE_COILS, start, len(values), len(packed)) + packed


def bits_of(request: bytes, reply: bytes, count: int) -> list[bool]:
    """The inputs in an answer.

    Raises:
        RefusedError: an exception answer.
        FrameError: an answer to something else.
    """
    check_reply(request, reply)
    if len(reply) != 2 + (count + 7) // 8 or reply[1] != len(reply) - 2:
        raise FrameError("an answer of another length")
    return [bool(reply[2 + i // 8] >> i % 8 & 1) for i in range(count)]


def check_reply(request: bytes, reply: bytes) -> None:
    """Whether an answer is one to this request.

    Raises:
        RefusedError: an exception answer.
        FrameError: an answer to something else.
    """
    if len(reply) == 2 and reply[0] == request[0] | 0x80:
        raise RefusedError(reply[1])
    if not reply or reply[0] != request[0] or (request[0] == WRITE_COILS and reply != request[:5]):
        raise FrameError("an answer to another request")


class Debouncer:
    """Inputs that count only when they have been the same for so many reads; one that never settles keeps its value."""

    def __init__(self, count: int, reads: int) -> None:
        self._reads = reads
        self.stable = [False] * count
        self._seen = [(False, reads)] * count

    def take(self, values: list[bool]) -> list[bool]:
        """The inputs after one more read."""
        for i, value in enumerate(values):
            before, times = self._seen[i]
            times = times + 1 if value is before else 1
            self._seen[i] = (value, times)
            if times >= self._reads:
                self.stable[i] = value
        return list(self.stable)
