"""The PLC's side of profile `basic`, scan by scan: what a careful PLC programmer would write.

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

    PRESS = "press"
    """The press works until the next part is there."""
    WAIT_READY = "wait_ready"
    WAIT_RESULT = "wait_result"
    RELEASE = "release"
    """Measure is 0 again; wait until Measure finished has fallen."""


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
        self._life = self._life % 65535 + 1
        if self._next_s is None:
            self._next_s = now_s
        belief = None
        if self.step is Step.PRESS and now_s >= self._next_s:
            self._next_s = max(self._next_s + self._settings.stroke_period_s, now_s)
            self.stroke = (self.stroke + 1) % 65536
            self.measure_number = self.measure_number % 65535 + 1
            self.step = Step.WAIT_READY
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
