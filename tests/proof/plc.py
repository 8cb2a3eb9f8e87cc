"""A reference PLC, written from the description of profile `basic` alone: it shares nothing with the service.

Byte and bit are spelled out here on purpose: a shared table would hide an error in it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import Enum, auto

IMAGE_BYTES = 20
WATCHDOG_S = 3.0
LINK_OK, MEASURE, STOP_CAMERA, START_CAMERA = 8, 4, 2, 1


class Step(Enum):
    """Of the press program."""

    FORM = auto()
    """The press works; the part of the next stroke comes."""
    AWAIT_READY = auto()
    RAISE = auto()
    """Number and stroke are written; Measure follows a scan later."""
    AWAIT_RESULT = auto()
    RELEASE = auto()


@dataclass(frozen=True)
class Believed:
    """How one trigger ended."""

    part: int
    number: int
    passed: bool
    code: int
    """0: the watchdog ended it."""
    waited_s: float


class ReferencePlc:
    """Byte 0-9 are its own, 10-19 are Wearline's; it looks at a copy of them that it took at the start of a scan."""

    def __init__(self, object_index: int = 3) -> None:
        self.memory = bytearray(IMAGE_BYTES)
        self.object_index = object_index
        self.part = 1
        self.number = 0
        self.step = Step.FORM
        self.raised_s = 0.0
        self.life = 0
        self.camera_runs = True
        self.copy = bytes(IMAGE_BYTES)

    @property
    def awaits_result(self) -> bool:
        """Whether a trigger is open."""
        return self.step is Step.AWAIT_RESULT

    def scan(self, now_s: float, gives_up: bool = False) -> Believed | None:
        """One scan; how its trigger ended, in the scan in which that is known. ``gives_up``: it loses patience."""
        copy, self.copy = self.copy, bytes(self.memory)
        self.life = self.life % 65535 + 1
        measure, end = self.step is Step.AWAIT_RESULT, None
        if self.step is Step.FORM:
            self.step = Step.AWAIT_READY
        elif self.step is Step.AWAIT_READY:
            # The copy of the scan before: outputs are always decided on what was read earlier.
            if copy[10] & 1 and not copy[10] & 2:
                self.number = self.number % 65535 + 1
                self.step = Step.RAISE
        elif self.step is Step.RAISE:
            self.step, self.raised_s, measure = Step.AWAIT_RESULT, now_s, True
        elif self.step is Step.AWAIT_RESULT:
            end = self._result(copy, now_s)
            if end is None and (gives_up or now_s - self.raised_s >= WATCHDOG_S):
                end = Believed(self.part, self.number, False, 0, now_s - self.raised_s)
            if end is not None:
                self.step, measure = Step.RELEASE, False
                self.part += 1
        elif not copy[10] & 2:
            self.step = Step.FORM
        bits = LINK_OK | START_CAMERA | (STOP_CAMERA if self.camera_runs else 0) | (MEASURE if measure else 0)
        struct.pack_into(
            ">BxHHHH", self.memory, 0, bits, self.object_index, self.number, self.part & 0xFFFF, self.life
        )  # fmt: skip
        return end

    def _result(self, copy: bytes, now_s: float) -> Believed | None:
        finished, passed, failed = copy[10] & 2, copy[10] & 4, copy[10] & 8
        code, echo = struct.unpack_from(">H4xH", copy, 12)
        if not finished or echo != self.number:
            return None
        is_good = bool(passed) and not failed and code == 1
        return Believed(self.part, self.number, is_good, code, now_s - self.raised_s)

    def restart(self, keeps_memory: bool) -> None:
        """Power off and on: the number counter is retentive, the response bytes may be or not."""
        if self.awaits_result:
            self.part += 1
        self.step, self.life, self.copy = Step.FORM, 0, bytes(IMAGE_BYTES)
        self.memory[0] = 0
        self.memory[8:10] = b"\0\0"
        if not keeps_memory:
            self.memory[:] = bytes(IMAGE_BYTES)
