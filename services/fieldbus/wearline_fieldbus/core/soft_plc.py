"""The PLC's side of each profile, scan by scan: what a careful PLC programmer would write.

The reference against which the handshake is tested, and the program of `wearline plc-sim`. A result is believed only
if it answers this Measure (echo) and came in time; Passed only if every sign of it agrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from pydantic import Field

from wearline.config import Settings
from wearline.messages import ResultCode
from wearline_fieldbus.core.profiles import Value

COMMAND_TIMEOUT_S = 2.0


class SoftPlcSettings(Settings):
    """The simulated press line."""

    stroke_period_s: float = Field(default=3.0, ge=0)
    """From stroke to stroke, when nothing keeps the press waiting. [s]"""
    strokes: int | None = Field(default=None, ge=1)
    """Then it ends; None = never."""
    object_index: int = Field(default=1, ge=0, le=65535)
    result_timeout_s: float = Field(default=3.0, gt=0)
    """After its Measure edge a result is not believed any more. [s]"""
    numbered: bool = True
    """Whether it numbers its measurements and looks at the echo."""


class Step(StrEnum):
    """Of the PLC's sequence."""

    SELECT = "select"
    """Extended: wait until the object is selected."""
    PRESS = "press"
    """The press works until the next part is there."""
    WAIT_READY = "wait_ready"
    WAIT_RESULT = "wait_result"
    RELEASE = "release"
    """Measure is 0 again; wait until Measure finished has fallen."""
    WAIT_ACK = "wait_ack"
    """Extended: the trigger stands until it is acknowledged."""


@dataclass(frozen=True)
class Belief:
    """What the PLC believes of one stroke."""

    stroke: int
    measure_number: int
    object_index: int
    code: int
    """0 = no result came in time."""
    passed: bool
    simulated: bool
    mean_error_um: int | None
    max_error_um: int | None
    ms: float
    """From its Measure edge to the scan that saw Measure finished, or to the end of its patience. [ms]"""


class SoftPlc:
    """One press line; `scan` is called every scan with the response as the PLC's memory holds it."""

    def __init__(self, settings: SoftPlcSettings, stroke: int = 0, measure_number: int = 0) -> None:
        """Go on after ``stroke`` and ``measure_number``."""
        self._settings = settings
        self.step = Step.PRESS
        self.stroke, self.measure_number = stroke, measure_number
        self.object_index = settings.object_index
        self._life = 0
        self._next_s: float | None = None
        self._edge_s = 0.0
        self._measure = False

    @property
    def is_released(self) -> bool:
        """No stroke is under way, and the result of the last one was taken back."""
        return self.step is Step.PRESS

    def scan(self, response: Mapping[str, Value], now_s: float) -> Belief | None:
        """One scan of the program; what it believes of a stroke, in the scan in which it makes up its mind."""
        belief = None
        self._press(now_s)
        if self.step is Step.WAIT_READY and response["ready"] and not response["measure_finished"]:
            self._measure, self._edge_s = True, now_s
            self.step = Step.WAIT_RESULT
        elif self.step is Step.WAIT_RESULT:
            waited_s = now_s - self._edge_s
            is_mine = not self._settings.numbered or response["echo"] == self.measure_number
            if waited_s >= self._settings.result_timeout_s:
                belief = self._belief({}, waited_s)
            elif response["measure_finished"] and is_mine:
                belief = self._belief(response, waited_s)
            if belief is not None:
                self._measure = False
                self.step = Step.RELEASE
        elif self.step is Step.RELEASE and not response["measure_finished"]:
            self.step = Step.PRESS
        return belief

    def _press(self, now_s: float) -> None:
        """Life goes on, and a new part comes when the press has worked."""
        self._life = self._life % 65535 + 1
        if self._next_s is None:
            self._next_s = now_s
        if self.step is Step.PRESS and now_s >= self._next_s:
            self._next_s = max(self._next_s + self._settings.stroke_period_s, now_s)
            self.stroke = (self.stroke + 1) % 65536
            self.measure_number = self.measure_number % 65535 + 1
            self.step = Step.WAIT_READY

    def request(self) -> dict[str, Value]:
        """What the PLC writes after this scan."""
        return {
            "start_camera": True,
            "stop_camera": True,
            "measure": self._measure,
            "link_ok": True,
            "object_index": self.object_index,
            "measure_number": self.measure_number if self._settings.numbered else 0,
            "stroke": self.stroke,
            "plc_life": self._life,
        }

    def _belief(self, response: Mapping[str, Value], waited_s: float) -> Belief:
        code = int(response.get("result_code", 0))
        passed = (
            bool(response.get("passed"))
            and not response.get("failed", True)
            and code == ResultCode.PASSED
        )  # fmt: skip
        mean, largest = (int(response.get(name, 0xFFFF)) for name in ("mean_error_um", "max_error_um"))
        return Belief(
            stroke=self.stroke,
            measure_number=self.measure_number,
            object_index=self.object_index,
            code=code,
            passed=passed,
            simulated=bool(response.get("simulated")),
            mean_error_um=None if mean == 0xFFFF else mean,
            max_error_um=None if largest == 0xFFFF else largest,
            ms=1000.0 * waited_s,
        )


class ExtendedSoftPlc(SoftPlc):
    """The PLC's side of profile `extended`: selects its object, triggers, fetches each result and acknowledges it."""

    def __init__(self, settings: SoftPlcSettings, stroke: int = 0, measure_number: int = 0) -> None:
        super().__init__(settings, stroke, measure_number)
        self.step = Step.SELECT
        self._sequence = 0
        self._execute = False
        self._execute_s = 0.0
        self._result_ack = False
        self._last_result = 0
        self._echo_life = 0

    @property
    def is_released(self) -> bool:
        return self.step is Step.PRESS and not self._result_ack

    def scan(self, response: Mapping[str, Value], now_s: float) -> Belief | None:
        self._sequence = self._sequence % 65535 + 1
        self._echo_life = int(response["vision_life"])
        if response["status_number"] != response["status_number_end"]:
            return None
        self._press(now_s)
        belief = None
        if self.step is Step.SELECT or self._execute or response["object_index"] != self.object_index:
            self._select(response, now_s)
        elif self.step is Step.WAIT_READY and response["ready"] and not response["trigger_ack"]:
            self._measure, self._edge_s = True, now_s
            self.step = Step.WAIT_ACK
        if self.step is Step.WAIT_ACK and response["trigger_ack"]:
            self._measure = False
            self.step = Step.WAIT_RESULT
        if self.step in (Step.WAIT_ACK, Step.WAIT_RESULT):
            waited_s = now_s - self._edge_s
            if waited_s >= self._settings.result_timeout_s:
                belief = self._belief({}, waited_s)
            elif self._is_mine(response) and not self._result_ack:
                belief = self._belief(response, waited_s)
            if belief is not None:
                self._measure = False
                self.step = Step.PRESS
        # Every valid result is acknowledged, whether or not it is this part's.
        self._result_ack = bool(response["result_valid"])
        if self._result_ack:
            self._last_result = int(response["result_number"])
        return belief

    def _select(self, response: Mapping[str, Value], now_s: float) -> None:
        if response["object_index"] == self.object_index and not self._execute:
            self.step = Step.PRESS if self.step is Step.SELECT else self.step
        elif self._execute:
            # What nobody took up (the link was down) is withdrawn and tried again.
            ended = bool(response["command_done"]) or bool(response["command_failed"])
            self._execute = not ended and now_s - self._execute_s < COMMAND_TIMEOUT_S
        elif response["online"] and not any(response[f"command_{sign}"] for sign in ("executing", "done", "failed")):
            self._execute, self._execute_s = True, now_s

    def _is_mine(self, response: Mapping[str, Value]) -> bool:
        return (
            bool(response["result_valid"])
            and response["result_number"] == response["result_number_end"]
            and response["result_number"] != self._last_result
            and response["echo"] == self.measure_number
            and response["echo_stroke"] == self.stroke
            and response["echo_part_id"] == self.part_id
        )

    def _belief(self, response: Mapping[str, Value], waited_s: float) -> Belief:
        # OK and NOK are antivalent: 00 and 11 are faults, and a fault is not Passed.
        signs = {"passed": response.get("ok", False), "failed": response.get("nok", True)}
        errors = {
            f"{name}_error_um": 0xFFFF if float(response.get(f"{name}_error_mm", -1.0)) < 0.0
            else round(1000.0 * float(response[f"{name}_error_mm"]))
            for name in ("mean", "max")
        }  # fmt: skip
        return super()._belief({**response, **signs, **errors}, waited_s)

    @property
    def part_id(self) -> str:
        """As this PLC names the part of the stroke."""
        return f"P{self.stroke:06d}"

    def request(self) -> dict[str, Value]:
        return {
            "sequence": self._sequence,
            "trigger_enable": True,
            "trigger": self._measure,
            "result_ack": self._result_ack,
            "command_execute": self._execute,
            "plc_life": self._life,
            "vision_life_echo": self._echo_life,
            "command": 1,
            "argument": self.object_index,
            "measure_number": self.measure_number,
            "stroke": self.stroke,
            "part_id": self.part_id,
            "sequence_end": self._sequence,
        }


SOFT_PLCS: Mapping[str, type[SoftPlc]] = {"basic": SoftPlc, "extended": ExtendedSoftPlc}
"""By profile."""
