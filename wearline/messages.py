"""Every message of the cell: frozen, unknown fields refused, units in the names, one array at most.

On the bus the header travels as JSON in the attachment and the array as the raw payload
(`encode`, `decode`); arrays that arrive are read-only views of the received bytes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Annotated, Any, ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from wearline.errors import MessageError


class Decision(StrEnum):
    """What the judge says of one part."""

    PASSED = "PASSED"
    FAILED = "FAILED"
    UNSURE = "UNSURE"
    NOT_MEASURED = "NOT_MEASURED"


class ResultCode(IntEnum):
    """The result code in the process image; 10-99 say why a part was not measured."""

    NONE = 0
    PASSED = 1
    FAILED = 2
    UNSURE = 3
    LATE = 10
    NO_FRAME = 11
    COVERAGE = 12
    NO_CALIBRATION = 13
    NO_TEMPLATE = 14
    UNKNOWN_OBJECT = 15
    CAMERA = 16
    SERVICE_LOST = 17
    RECIPE_CHANGED = 18
    SIMULATED_REFUSED = 19
    DISK = 20
    BAD_FRAME = 21
    REGISTRATION = 22
    INTERRUPTED = 23
    STOPPED = 24


CODE_MEANING: dict[ResultCode, str] = {
    ResultCode.NONE: "no result",
    ResultCode.PASSED: "part passed",
    ResultCode.FAILED: "part failed",
    ResultCode.UNSURE: "inside the guard band",
    ResultCode.LATE: "no verdict before the deadline",
    ResultCode.NO_FRAME: "capture delivered no frame",
    ResultCode.COVERAGE: "too little of the part was seen",
    ResultCode.NO_CALIBRATION: "no valid calibration",
    ResultCode.NO_TEMPLATE: "no template for this object",
    ResultCode.UNKNOWN_OBJECT: "object index is not in the object list",
    ResultCode.CAMERA: "camera fault",
    ResultCode.SERVICE_LOST: "a service of the measuring chain is not there",
    ResultCode.RECIPE_CHANGED: "recipe changed during the cycle",
    ResultCode.SIMULATED_REFUSED: "simulated verdict refused by a real PLC",
    ResultCode.DISK: "no room to record the cycle",
    ResultCode.BAD_FRAME: "frame cannot be measured",
    ResultCode.REGISTRATION: "part lies outside the allowed pose",
    ResultCode.INTERRUPTED: "fieldbus restarted during the cycle",
    ResultCode.STOPPED: "camera stopped by the PLC during the cycle",
}


@dataclass(frozen=True)
class ArraySpec:
    """dtype and named axes of a message's array; checked whenever a message is built."""

    dtype: str
    axes: tuple[str, ...]

    def check(self, value: object) -> NDArray[Any]:
        if not isinstance(value, np.ndarray):
            raise ValueError(f"expected a numpy array of {self.dtype}, got {type(value).__name__}")
        if value.dtype != np.dtype(self.dtype):
            raise ValueError(f"expected dtype {self.dtype}, got {value.dtype}")
        if value.ndim != len(self.axes):
            raise ValueError(f"expected axes {self.axes}, got shape {value.shape}")
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.check)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"type": "array", "x-dtype": self.dtype, "x-axes": list(self.axes)}


class Message(BaseModel):
    """Base of all messages."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, arbitrary_types_allowed=True)

    array_field: ClassVar[str | None] = None

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        names = [n for n, f in cls.model_fields.items() if any(isinstance(m, ArraySpec) for m in f.metadata)]
        if len(names) > 1:
            raise TypeError(f"{cls.__name__} has {len(names)} arrays; a message has one at most")
        cls.array_field = names[0] if names else None

    def replace(self, **changes: Any) -> Self:
        """A validated copy with some fields changed."""
        return type(self)(**{**{n: getattr(self, n) for n in type(self).model_fields}, **changes})


class FromCycle(Message):
    """What every message of a cycle carries."""

    cycle_id: str = Field(min_length=1, max_length=64)
    """One measurement, from Measure to result; made by fieldbus, unique for ever."""
    is_simulated: bool
    """True when any link of the chain is simulated; travels on to the PLC."""


class MeasureRequest(FromCycle):
    """fieldbus: a Measure was accepted and journalled."""

    object_index: int = Field(ge=0, le=65535)
    """Table 5.1's object index."""
    part_id: str = ""
    """As the PLC names the part; may be empty."""
    stroke: int = Field(ge=0)
    """The press' stroke counter."""
    measure_number: int = Field(ge=0, le=65535)
    """The PLC's number of this measurement, echoed with the result; 0 where it does not number."""
    time_left_ms: float
    """Until the deadline, when this message was sent. Clocks of two hosts do not compare. [ms]"""


class Frame(FromCycle):
    """capture: one camera image, or the reason why there is none (then 0 x 0 pixels)."""

    request: MeasureRequest
    """The request that this frame answers."""
    camera: str
    pixels: Annotated[NDArray[np.uint8], ArraySpec("uint8", ("row", "col"))]
    """Grey values, full sensor."""
    exposure_us: float
    frame_counter: int
    """Of the camera; a gap is a lost frame."""
    refusal_code: int = 0
    """0, or the result code that says why there is no image."""
    refusal: str = ""


class Exposed(FromCycle):
    """capture: the picture is taken, the part may move; said also where the picture is refused."""


class FrameQuality(Message):
    """What one frame says of itself; NaN is not allowed, absent is None."""

    lines_seen: int = 0
    spot_found: bool = False
    stripe_width_px: float | None = None
    """Median Gaussian sigma of the stripes. [px]"""
    saturated_fraction: float = 0.0
    ambient_dn: float = 0.0
    """Median background. [DN]"""
    contrast_dn: float = 0.0
    """Median stripe height above background. [DN]"""
    sentences: tuple[str, ...] = ()
    """Plain sentences for people; empty when nothing is wrong."""


class LinePoints(FromCycle):
    """reconstruct: what was measured on the laser lines."""

    request: MeasureRequest
    points: Annotated[NDArray[np.float32], ArraySpec("float32", ("point", "line_row_col_z_sigma"))]
    """One row per point: line, row_px, col_px, z_mm, sigma_mm; only points that were seen."""
    sigma_frame_mm: float = 0.0
    """The part of sigma that is common to the whole frame (vibration, offset of the calibration). [mm]"""
    coverage: float = 0.0
    """Share of the expected stripe columns that were measured, 0-1."""
    quality: FrameQuality
    timings_ms: dict[str, float] = Field(default_factory=dict)
    refusal_code: int = 0
    refusal: str = ""
    frame_hash: str = ""
    """sha256 of the pixels, hex."""
    calibration_hash: str = ""
    recipe_hash: str = ""
    """Of the recipe that ruled the reconstruction."""


class Region(Message):
    """One connected area of the part that deviates."""

    area_px: int
    area_mm2: float | None
    volume_mm3: float | None
    mean_mm: float
    """Mean absolute deviation. [mm]"""
    max_mm: float
    """Largest deviation, signed, measured minus template. [mm]"""
    p95_mm: float
    """95th percentile of the absolute deviation. [mm]"""
    sigma_mm: float
    """Standard uncertainty of mean_mm. [mm]"""
    row_px: float
    col_px: float
    """Centroid. [px]"""
    box_px: tuple[int, int, int, int]
    """x, y, width, height. [px]"""


class ZoneResult(Message):
    """One zone of the recipe."""

    name: str
    mean_error_mm: float | None
    max_error_mm: float | None
    area_mm2: float | None
    wear_mm: float | None
    coverage: float
    is_within: bool
    profile_mm: float | None = None
    """Profile of the surface in the style of ISO 1101: twice the largest absolute deviation. [mm]"""


class RegistrationResult(Message):
    """The rigid motion that was removed before comparison."""

    dz_mm: float = 0.0
    tilt_x_mrad: float = 0.0
    tilt_y_mrad: float = 0.0
    dx_mm: float = 0.0
    dy_mm: float = 0.0
    turn_mrad: float = 0.0
    """In plane, from x to y. [mrad]"""
    undetermined: tuple[str, ...] = ()
    """Directions that the surface does not determine; left at zero."""
    datum: str = Field(default="best fit", pattern="^(best fit|zones)$")
    """What deviations refer to: a best fit to the whole part, or to the recipe's datum zones."""


class Verdict(FromCycle):
    """judge: the decision on one part, with its reason, figures and references."""

    request: MeasureRequest
    decision: Decision
    code: int
    reason: str
    mean_error_mm: float | None = None
    """Mean absolute deviation over the deviating area; 0 when nothing deviates, None when not measured. [mm]"""
    max_error_mm: float | None = None
    """Signed, measured minus template. [mm]"""
    wear_mm: float | None = None
    """95th percentile of the absolute deviation in the largest significant region; 0 when none. [mm]"""
    profile_mm: float | None = None
    """Profile of the surface in the style of ISO 1101, by `registration.datum`: twice the largest absolute
    deviation. [mm]"""
    deviating_area_mm2: float | None = None
    deviating_area_px: int | None = None
    coverage: float = 0.0
    """Share of the template's points that were seen, 0-1."""
    regions: tuple[Region, ...] = ()
    zones: tuple[ZoneResult, ...] = ()
    registration: RegistrationResult = RegistrationResult()
    quality: FrameQuality = FrameQuality()
    timings_ms: dict[str, float] = Field(default_factory=dict)
    frame_hash: str = ""
    calibration_hash: str = ""
    template_hash: str = ""
    recipe_hash: str = ""
    code_version: str = ""


class View(FromCycle):
    """judge: decimated maps for the eye."""

    maps_mm: Annotated[NDArray[np.float32], ArraySpec("float32", ("map", "row", "col"))]
    """Maps in the order of `names`; NaN = not measured. [mm]"""
    names: tuple[str, ...] = ("standard", "measured", "difference", "error")
    step_px: float
    """Sensor pixels between two elements."""
    origin_px: tuple[float, float]
    """Sensor x, y of element [0, 0]."""
    mm_per_pixel: float | None = None
    stroke: int = 0
    decision: Decision = Decision.NOT_MEASURED


class Outcome(FromCycle):
    """fieldbus: what the PLC was told, and when."""

    request: MeasureRequest
    code: int
    passed: bool
    failed: bool
    was_told: bool
    """False when the deadline had gone or the link was down: the PLC got nothing for this cycle."""
    cycle_seconds: float
    """From the Measure edge seen to the result written. [s]"""
    told_utc: str
    """ISO 8601."""


class Preview(Message):
    """capture: a JPEG for the eye."""

    jpeg: Annotated[NDArray[np.uint8], ArraySpec("uint8", ("byte",))]
    frame_counter: int
    is_simulated: bool
    step_px: float = 1.0
    """Sensor pixels for each pixel of the picture. [px]"""


class ServiceState(Message):
    """Each service: how it is, about once a second."""

    service: str
    status: str = Field(pattern="^(starting|ready|degraded|stopping)$")
    detail: str = ""
    pid: int
    uptime_s: float
    version: str
    values: dict[str, float | int | str | bool | None] = Field(default_factory=dict)
    """The service's own figures, for the eye (fieldbus: mode, plc_link_up, object_index, ...)."""


class Event(Message):
    """Each service: something worth the log."""

    service: str
    level: str = Field(pattern="^(info|warning|error)$")
    text: str
    utc: str
    cycle_id: str = ""


class Ask(Message):
    """Base of what may be asked in a query."""


class Ping(Ask):
    """An empty question, for queries that need no more than their key."""


class AskArtifact(Ask):
    """`judge/artifact/<hash>`: one immutable artifact."""

    content_hash: str


class Artifact(Message):
    """Answer: the bytes of a calibration or template file."""

    content_hash: str
    content: Annotated[NDArray[np.uint8], ArraySpec("uint8", ("byte",))]


class AskRecipe(Ask):
    """`judge/recipe/<object index>`: what is wanted of one object."""

    object_index: int


class ObjectRecipe(Message):
    """Answer: the released recipe of an object, with its references."""

    object_index: int
    object_name: str
    recipe_yaml: str
    recipe_hash: str
    calibration_hash: str
    template_hash: str
    version: int


class ObjectEntry(Message):
    """One line of the object list."""

    object_index: int
    object_name: str
    recipe_hash: str
    calibration_hash: str
    template_hash: str
    version: int


class ObjectList(Message):
    """Answer to `judge/recipe/list`."""

    objects: tuple[ObjectEntry, ...]


class AskRecords(Ask):
    """`judge/records`: the newest records, or the wear trend."""

    last: int = Field(default=100, ge=1, le=10000)
    object_index: int | None = None
    cycle_id: str = ""
    with_verdict: bool = False
    decisions: tuple[Decision, ...] = ()
    """Only these; empty = all."""
    search: str = Field(default="", max_length=100)
    """Only parts whose id contains this, or whose stroke it is."""
    before: int | None = None
    """Only records with a smaller `record_id`: the next page."""
    with_trends: bool = True
    """False spares judge the fit where only rows are wanted."""


class RecordRow(Message):
    """One cycle as recorded."""

    record_id: int
    cycle_id: str
    utc: str
    object_index: int
    part_id: str
    stroke: int
    measure_number: int
    decision: Decision
    code: int
    reason: str
    mean_error_mm: float | None
    max_error_mm: float | None
    wear_mm: float | None
    told_code: int | None
    """None until the PLC was told."""
    cycle_seconds: float | None
    is_simulated: bool
    verdict_json: str = ""


class WearTrend(Message):
    """Wear of one zone of one object against the stroke counter, since the last service of the die."""

    object_index: int
    zone: str = ""
    """Empty: the whole part."""
    points: tuple[tuple[int, float], ...]
    """(stroke, wear_mm), decimated to what a chart shows."""
    wear_mm: float | None
    slope_mm_per_kilostroke: float | None
    slope_sigma: float | None
    limit_mm: float | None
    remaining_p10: float | None
    remaining_p50: float | None
    remaining_p90: float | None
    """Strokes to the limit; None = not identifiable."""
    strokes_since_service: int
    die_events: tuple[tuple[int, str], ...] = ()
    """(stroke, what was done)."""
    jumps: tuple[tuple[int, float], ...] = ()
    """(stroke, size in mm) of sudden changes: a chip, a displaced insert."""
    alarm_level: int = Field(default=0, ge=0, le=4)
    """0 none, 1 info, 2 warning, 3 action, 4 stop; from 2 on held until acknowledged."""
    alarm_reason: str = ""
    alarm_stroke: int = 0
    """At which this level was reached."""
    acknowledged_by: str = ""
    """Empty while somebody should look; then who did."""
    acknowledged_reason: str = ""


class Records(Message):
    """Answer to AskRecords, newest first."""

    rows: tuple[RecordRow, ...]
    total: int
    trends: tuple[WearTrend, ...] = ()
    """Of each object: the whole part first, then its zones."""
    passed: int = 0
    failed: int = 0
    not_measured: int = 0


class AskWearMap(Ask):
    """`judge/wear_map`: where errors are frequent and where wear grows."""

    object_index: int


class WearMap(Message):
    """Answer: maps over squares of the part, of all parts since the last service of the die."""

    object_index: int
    maps: Annotated[NDArray[np.float32], ArraySpec("float32", ("map", "row", "col"))]
    """Maps in the order of `names`; NaN = no part was seen there, or too few for a slope."""
    names: tuple[str, ...] = ("error_share", "slope_mm_per_kilostroke", "slope_sigma")
    square_px: int
    """Sensor pixels along the side of a square."""
    origin_px: tuple[int, int]
    """Sensor x, y of the first square's corner."""
    parts: int
    """Measured parts in it."""


class Do(Message):
    """Base of commands."""

    user: str = ""
    """Who asked; empty for a program."""


class DoMeasure(Do):
    """`fieldbus/do/measure`: measure by hand, in manual mode."""


class SelectObject(Do):
    """`fieldbus/do/select_object`."""

    object_index: int = Field(ge=0, le=65535)


class SetMode(Do):
    """`fieldbus/do/mode`."""

    mode: str = Field(pattern="^(auto|manual)$")


class AskJournal(Do):
    """`fieldbus/do/journal`: accepted cycles and outcomes, for reconciliation."""

    since_utc: str = ""


class JournalEntry(Message):
    """One accepted cycle as fieldbus journalled it."""

    request: MeasureRequest
    is_simulated: bool
    accepted_utc: str
    outcome: Outcome | None


class Journal(Message):
    """Answer to AskJournal, oldest first."""

    entries: tuple[JournalEntry, ...]


class SetCamera(Do):
    """`capture/do/set`."""

    exposure_us: float | None = Field(default=None, gt=0)
    gain_db: float | None = None


class Teach(Do):
    """`judge/do/teach`: make a template from the next or stored golden cycles."""

    object_index: int
    cycle_ids: tuple[str, ...]


class DieEvent(Do):
    """`judge/do/die_event`: the die was serviced; the trend starts anew."""

    object_index: int
    kind: str = Field(pattern="^(regrind|polish|insert|die_change|coil_change)$")
    note: str = ""


class Acknowledge(Do):
    """`judge/do/acknowledge`: somebody took notice of an alarm; it goes when its cause has gone."""

    object_index: int
    zone: str = ""
    reason: str = Field(min_length=1, max_length=500)


class Done(Message):
    """Answer to a command."""

    ok: bool
    text: str = ""


def encode(message: Message) -> tuple[bytes, bytes]:
    """Header (JSON) and payload (the array's raw bytes, empty without one)."""
    name = type(message).array_field
    fields = message.model_dump_json(exclude={name} if name else None)
    array: NDArray[Any] | None = getattr(message, name) if name else None
    shape = "null" if array is None else json.dumps(array.shape)
    header = f'{{"message":"{type(message).__name__}","shape":{shape},"fields":{fields}}}'
    return header.encode(), b"" if array is None else np.ascontiguousarray(array).tobytes()


M = TypeVar("M", bound=Message)


def decode(kind: type[M], header: bytes, payload: bytes) -> M:
    """Rebuild one message.

    Raises:
        MessageError: another message, an unknown field, a wrong dtype, or a payload whose length
            does not fit the shape.
    """
    try:
        outer = json.loads(header)
        name, shape, fields = outer["message"], outer["shape"], outer["fields"]
    except (ValueError, KeyError, TypeError) as error:
        raise MessageError("header is not a Wearline header", kind.__name__, "check the publisher's version") from error
    if name != kind.__name__:
        raise MessageError(f"got {name}", f"expected {kind.__name__}", "one topic carries one message")
    if (field := kind.array_field) is not None:
        spec = next(m for m in kind.model_fields[field].metadata if isinstance(m, ArraySpec))
        dtype = np.dtype(spec.dtype)
        if not isinstance(shape, list) or len(payload) != dtype.itemsize * int(np.prod(shape)):
            raise MessageError(
                f"payload of {len(payload)} bytes does not fit shape {shape} of {spec.dtype}", kind.__name__
            )
        fields = {**fields, field: np.frombuffer(payload, dtype).reshape(shape)}
    try:
        return kind(**fields)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise MessageError(f"{first['msg']}", f"{kind.__name__}.{place}", "both sides need one version") from error
