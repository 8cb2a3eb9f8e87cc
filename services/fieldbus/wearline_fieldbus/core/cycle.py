"""What the handshakes share: events in, actions out, the cycle in hand, and what a verdict means to the PLC."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

from pydantic import Field, model_validator

from wearline.config import Settings
from wearline.messages import Decision, MeasureRequest, Outcome, ResultCode, Verdict
from wearline_fieldbus.core.profiles import NO_ERROR_UM

CHAIN = ("capture", "reconstruct", "judge")
"""The services that a measurement needs."""


class HandshakeSettings(Settings):
    """When the PLC is told what."""

    numbered: bool = True
    """False: the PLC cannot number its measurements; it then waits `minimum_pause_s` between two triggers, and a
    stale result is kept away by time alone."""
    minimum_pause_s: float = Field(default=3.5, gt=0)
    """Only with ``numbered: false``: Ready stays away for so long after a Measure. [s]"""
    answer_by_s: float = Field(default=2.5, gt=0)
    """After the Measure edge: then NOT_MEASURED is written. [s]"""
    silent_after_s: float = Field(default=3.0, gt=0)
    """After the Measure edge: from then on nothing is written for that cycle. [s]"""
    io_timeout_s: float = Field(default=0.3, gt=0, le=0.5)
    """No exchange with the PLC takes longer; an exchange that does is given up with its connection. [s]"""
    result_hold_s: float = Field(default=0.5, ge=0)
    """A result stands at least so long where Measure fell before it came. [s]"""
    plc_life_timeout_s: float = Field(default=0.8, gt=0)
    """A supervised PLC life counter that stands still for so long means PLC in STOP. [s]"""
    vision_life_period_s: float = Field(default=0.1, gt=0)
    """Between two steps of Wearline's own life counter. [s]"""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.answer_by_s + self.io_timeout_s > self.silent_after_s:
            raise ValueError(
                f"answer_by_s + io_timeout_s ({self.answer_by_s:g} + {self.io_timeout_s:g}) is later than "
                f"silent_after_s ({self.silent_after_s:g}): the late answer could arrive when nothing may be written"
            )
        if not self.numbered and self.minimum_pause_s <= self.silent_after_s:
            raise ValueError(
                f"minimum_pause_s ({self.minimum_pause_s:g}) must be longer than silent_after_s "
                f"({self.silent_after_s:g}) where measurements are not numbered"
            )
        return self


@dataclass(frozen=True)
class Now:
    """The instant at which an event is handled."""

    s: float
    """Monotonic. [s]"""
    utc: str
    """ISO 8601."""


# --- events: what happened, as the shell saw it ---


@dataclass(frozen=True)
class Image:
    """The process image was read while connected."""

    content: bytes
    """The whole image, request and response."""
    writes: int
    """Block writes of this connection that the PLC had acknowledged before this read."""
    at_s: float
    """Monotonic clock, when the read was sent. [s]"""


@dataclass(frozen=True)
class Linked:
    """A connection stands and the image was read for the first time."""

    image: Image


@dataclass(frozen=True)
class LinkLost:
    """The connection ended; a write that was under way may or may not have arrived."""

    reason: str


@dataclass(frozen=True)
class Written:
    """The PLC acknowledged a block write."""

    token: int
    at_s: float
    """When the acknowledgement came. [s]"""


@dataclass(frozen=True)
class Skipped:
    """A block write was not sent: its time had gone or its connection was another one."""

    token: int


@dataclass(frozen=True)
class VerdictCame:
    """Judge's verdict arrived."""

    verdict: Verdict


@dataclass(frozen=True)
class ExposureEnded:
    """The camera has taken the picture of a cycle: the part may move."""

    cycle_id: str


@dataclass(frozen=True)
class TrendKnown:
    """What judge knows of the wear of an object."""

    object_index: int
    remaining_strokes: int | None
    """With 90 % confidence; None = not known."""
    wear_percent: int | None
    """Of the limit; None = not known."""


@dataclass(frozen=True)
class ServiceChanged:
    """A service of the cell came or went."""

    service: str
    is_alive: bool


@dataclass(frozen=True)
class RoomChanged:
    """The journal can, or cannot, take another cycle."""

    has_room: bool


@dataclass(frozen=True)
class NotRecorded:
    """An entry of this cycle could not be made durable; nothing after it was done."""

    cycle_id: str


@dataclass(frozen=True)
class ObjectChecked:
    """Judge was asked for the recipe of an object."""

    object_index: int
    is_known: bool


@dataclass(frozen=True)
class ModeWanted:
    """Somebody with the right to do so asked for a mode."""

    mode: str


@dataclass(frozen=True)
class ObjectWanted:
    """An object was chosen by hand; obeyed in manual mode."""

    object_index: int


@dataclass(frozen=True)
class MeasureWanted:
    """A measurement by hand; obeyed in manual mode."""


@dataclass(frozen=True)
class Tick:
    """Time went on."""


Event = (
    Image | Linked | LinkLost | Written | Skipped | VerdictCame | ServiceChanged | RoomChanged | NotRecorded
    | ExposureEnded | TrendKnown | ObjectChecked | ModeWanted | ObjectWanted | MeasureWanted | Tick
)  # fmt: skip


# --- actions: what the shell must do, in this order; one that fails ends the rest ---


@dataclass(frozen=True)
class RecordAccepted:
    """Make the accepted cycle durable."""

    cycle: Cycle


@dataclass(frozen=True)
class RecordOutcome:
    """Make the outcome durable, before the PLC is told."""

    cycle: Cycle
    outcome: Outcome


@dataclass(frozen=True)
class PublishRequest:
    """Tell the cell to measure."""

    request: MeasureRequest


@dataclass(frozen=True)
class WriteResponse:
    """Write a block of the response in one PDU."""

    start: int
    """Its first byte in the image."""
    block: bytes
    token: int
    not_after_s: float | None = None
    """Not to be begun after this instant. [s]"""


@dataclass(frozen=True)
class WriteLife:
    """Write the life counters alone, so that no result is ever written twice."""

    start: int
    content: bytes


@dataclass(frozen=True)
class PublishOutcome:
    """Tell the cell what the PLC was told, or that it was not; then note it as the cycle's end."""

    outcome: Outcome


@dataclass(frozen=True)
class CheckObject:
    """Ask judge whether it knows this object."""

    object_index: int


@dataclass(frozen=True)
class Answer:
    """To who asked for a mode, an object or a measurement by hand."""

    ok: bool
    text: str


@dataclass(frozen=True)
class Say:
    """Worth the log."""

    level: str
    text: str
    cycle_id: str = ""


Action = (
    RecordAccepted | RecordOutcome | PublishRequest | WriteResponse | WriteLife | PublishOutcome | CheckObject | Answer
    | Say
)  # fmt: skip


# --- the cycle in hand ---


@dataclass(frozen=True)
class Ruling:
    """What the PLC is to be told of one cycle."""

    code: int
    is_simulated: bool = False
    mean_error_um: int = NO_ERROR_UM
    max_error_um: int = NO_ERROR_UM
    verdict: Verdict | None = None

    @property
    def passed(self) -> bool:
        """For code 1 alone."""
        return self.code == ResultCode.PASSED


@dataclass(frozen=True)
class Cycle:
    """One accepted Measure."""

    request: MeasureRequest
    edge_s: float
    """When the Measure edge was seen. [s]"""
    is_manual: bool = False
    lost: tuple[str, ...] = ()
    """Services of the chain that went away since."""
    ruling: Ruling | None = None
    """None until it is decided."""
    decided_s: float = 0.0
    recorded: Outcome | None = None
    """As an earlier run of the service recorded it."""

    @property
    def cycle_id(self) -> str:
        return self.request.cycle_id

    def with_loss(self, service: str) -> Cycle:
        """The cycle after a service of the chain went away."""
        return self if service in self.lost else replace(self, lost=(*self.lost, service))


def micrometres(error_mm: float | None) -> int:
    """An error in mm as the unsigned word of the image; 0xFFFF = none, larger ones are clipped to 0xFFFE."""
    if error_mm is None:
        return NO_ERROR_UM
    return min(round(abs(error_mm) * 1000.0), NO_ERROR_UM - 1)


_CODES = {
    Decision.PASSED: {int(ResultCode.PASSED)},
    Decision.FAILED: {int(ResultCode.FAILED)},
    # A recipe may take UNSURE as passed: judge then says so with code 1.
    Decision.UNSURE: {int(ResultCode.UNSURE), int(ResultCode.PASSED)},
    Decision.NOT_MEASURED: set(range(10, 100)),
}


def is_consistent(verdict: Verdict) -> bool:
    """Whether decision and code of a verdict say the same."""
    return verdict.code in _CODES[verdict.decision]


def ruling_of(verdict: Verdict, is_simulated: bool, plc_is_simulated: bool) -> Ruling:
    """What a verdict means to the PLC; a simulated one is refused by a real PLC."""
    simulated = verdict.is_simulated or is_simulated
    figures = (micrometres(verdict.mean_error_mm), micrometres(verdict.max_error_mm))
    if not is_consistent(verdict):
        return Ruling(int(ResultCode.SERVICE_LOST), simulated, verdict=verdict)
    if simulated and not plc_is_simulated:
        return Ruling(int(ResultCode.SIMULATED_REFUSED), simulated, verdict=verdict)
    return Ruling(verdict.code, simulated, *figures, verdict)


def outcome_of(cycle: Cycle, ruling: Ruling, was_told: bool, at_s: float, utc: str) -> Outcome:
    """The outcome message of a decided cycle; ``at_s`` is when the PLC acknowledged, or when hope was given up."""
    if cycle.recorded is not None:
        return cycle.recorded.replace(was_told=was_told, told_utc=utc)
    return Outcome(
        cycle_id=cycle.cycle_id,
        is_simulated=cycle.request.is_simulated or ruling.is_simulated,
        request=cycle.request,
        code=ruling.code,
        passed=ruling.passed,
        failed=not ruling.passed,
        was_told=was_told,
        cycle_seconds=max(0.0, at_s - cycle.edge_s),
        told_utc=utc,
    )
