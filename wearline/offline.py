"""The handlers of the live services run in one process: files in, verdicts out.

`Chain` stands in for the bus: it answers the questions that reconstruct and judge ask (recipe,
calibration, template) and passes each message from one handler to the next.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterable
from importlib.metadata import entry_points
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from wearline.artifact import Calibration, Template, content_hash
from wearline.errors import BusError, CalibrationError, FrameError, UsageError
from wearline.messages import (
    Artifact,
    AskArtifact,
    AskRecipe,
    Frame,
    LinePoints,
    MeasureRequest,
    Message,
    ObjectRecipe,
    ResultCode,
    Verdict,
    View,
)
from wearline.recipe import Recipe, dump_recipe, recipe_hash
from wearline.service import Asker, Service
from wearline.topics import ARTIFACT, FRAME, LINE_POINTS, RECIPE, Query

GROUP = "wearline.services"
U8 = NDArray[np.uint8]
M = TypeVar("M", bound=Message)


def offline_service(name: str, asker: Asker) -> Service:
    """A service without files or devices of its own, from the entry-point group ``wearline.services``.

    Raises:
        UsageError: the service is not installed here.
    """
    for point in entry_points(group=GROUP, name=name):
        service: Service = point.load()(asker)
        return service
    raise UsageError("is not installed here", f"service {name}", f"pip install wearline-{name}")


class Chain:
    """reconstruct and judge in this process, for one recipe, calibration and template.

    ``calibration`` and ``template`` are objects or the bytes of their files; None = there is
    none, and the services answer as they do live.
    """

    def __init__(
        self,
        recipe: Recipe | None = None,
        calibration: Calibration | bytes | None = None,
        template: Template | bytes | None = None,
        *,
        object_index: int = 1,
        object_name: str = "part",
        is_simulated: bool = False,
    ) -> None:
        self.recipe = oriented(recipe or Recipe(), calibration)
        self._artifacts: dict[str, bytes] = {}
        self._is_simulated = is_simulated
        self._object = ObjectRecipe(
            object_index=object_index,
            object_name=object_name,
            recipe_yaml=dump_recipe(self.recipe),
            recipe_hash=recipe_hash(self.recipe),
            calibration_hash=self._keep(calibration),
            template_hash=self._keep(template),
            version=1,
        )
        self._services: dict[str, Service] = {}
        self._frames = 0

    def _keep(self, artifact: Calibration | Template | bytes | None) -> str:
        if artifact is None:
            return ""
        content = artifact if isinstance(artifact, bytes) else artifact.to_bytes()
        name = content_hash(content)
        self._artifacts[name] = content
        return name

    @property
    def object_recipe(self) -> ObjectRecipe:
        """What RECIPE is answered with: the recipe and the hashes."""
        return self._object

    def ask(self, query: Query, question: Message, argument: str = "", timeout_s: float = 1.0) -> Message:
        """Answer RECIPE and ARTIFACT, as judge does live.

        Raises:
            BusError: another question, an object or artifact that is not here.
        """
        if query == RECIPE and isinstance(question, AskRecipe):
            if question.object_index != self._object.object_index:
                raise BusError(f"object {question.object_index} is not in the object list", "offline")
            return self._object
        if query == ARTIFACT and isinstance(question, AskArtifact):
            content = self._artifacts.get(question.content_hash)
            if content is None:
                raise BusError(f"there is no artifact {question.content_hash[:12] or '(none)'}", "offline")
            return Artifact(content_hash=question.content_hash, content=np.frombuffer(content, np.uint8))
        raise BusError(f"nobody answers {query.answerer}/{query.name}", "offline", "ask a running cell")

    def service(self, name: str) -> Service:
        """The one instance of reconstruct or judge in this chain."""
        if name not in self._services:
            self._services[name] = offline_service(name, self)
        return self._services[name]

    def frame(self, image: U8 | FrameError, request: MeasureRequest | None = None, camera: str = "file") -> Frame:
        """The message that capture would send for this image, or for the reason why there is none."""
        self._frames += 1
        if request is None:
            request = MeasureRequest(
                cycle_id=f"offline-{self._frames:06d}",
                is_simulated=self._is_simulated,
                object_index=self._object.object_index,
                stroke=self._frames,
                measure_number=0,
                time_left_ms=60_000.0,
            )
        refused = image if isinstance(image, FrameError) else None
        return Frame(
            cycle_id=request.cycle_id,
            is_simulated=request.is_simulated or self._is_simulated,
            request=request,
            camera=camera,
            pixels=np.zeros((0, 0), np.uint8) if isinstance(image, FrameError) else image,
            exposure_us=self.recipe.exposure_us,
            frame_counter=self._frames,
            refusal_code=refused.code if refused else 0,
            refusal=str(refused) if refused else "",
        )

    def line_points(self, image: U8 | FrameError, request: MeasureRequest | None = None) -> LinePoints:
        """What reconstruct makes of one image, uint8 [row, col].

        Raises:
            UsageError: reconstruct is not installed.
            WearlineError: whatever reconstruct raises.
        """
        return self.points_of(self.frame(image, request))

    def points_of(self, frame: Frame) -> LinePoints:
        """What reconstruct makes of one frame message."""
        return _only(LinePoints, self.service("reconstruct").handlers()[FRAME](frame), "reconstruct")

    def verdict(self, image: U8 | FrameError, request: MeasureRequest | None = None) -> Verdict:
        """What judge says of one image, uint8 [row, col]; a `FrameError` gives its NOT_MEASURED.

        Raises:
            UsageError: reconstruct or judge is not installed.
            WearlineError: whatever they raise.
        """
        return self.judged(self.frame(image, request))[0]

    def judged(self, frame: Frame) -> tuple[Verdict, LinePoints, View | None]:
        """All that one frame message leads to: verdict, line points, and the maps for the eye."""
        points = self.points_of(frame)
        said = list(self.service("judge").handlers()[LINE_POINTS](points))
        view = next((message for message in said if isinstance(message, View)), None)
        return _only(Verdict, said, "judge"), points, view

    def close(self) -> None:
        """Release what the services hold."""
        for service in self._services.values():
            service.close()
        self._services.clear()


def oriented(recipe: Recipe, calibration: Calibration | bytes | None) -> Recipe:
    """A recipe that names no orientation takes that of its calibration."""
    if calibration is None or "orientation" in recipe.model_fields_set:
        return recipe
    if isinstance(calibration, bytes):
        try:
            calibration = Calibration.from_bytes(calibration, "calibration")
        except CalibrationError:
            # The services say so, with the code that belongs to it.
            return recipe
    return recipe.model_copy(update={"orientation": "vertical" if calibration.is_vertical else "horizontal"})


def _only(kind: type[M], messages: Iterable[Message], who: str) -> M:
    found = [message for message in messages if isinstance(message, kind)]
    if len(found) != 1:
        raise BusError(f"said {len(found)} {kind.__name__} to one message", who, "a handler answers exactly once")
    return found[0]


FILE_LIMIT_BYTES = 256 * 2**20
PIXEL_LIMIT = 2**27
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_TIFF = (b"II*\0", b"MM\0*")
_OTHERS = (b"BM", b"P5")
_CURE = "take an 8-bit grey picture of the whole sensor"


def read_frame(path: Path) -> U8:
    """One 8-bit grey image file (PNG, JPEG, BMP, TIFF, PGM) as uint8 [row, col].

    Raises:
        FrameError: missing, truncated, damaged, no image, 16 bit, colour, or beyond 256 MiB or
            2^27 pixels. Code 21.
    """
    where = str(path)
    try:
        size = path.stat().st_size
        if size > FILE_LIMIT_BYTES:
            raise _refused(f"{size / 2**20:.0f} MiB is beyond {FILE_LIMIT_BYTES // 2**20} MiB", where)
        content = path.read_bytes()
    except OSError as error:
        raise _refused(f"cannot be read ({error.strerror})", where, "name an image file") from error
    if not content:
        raise _refused("is empty", where)
    if content.startswith(_PNG):
        _check_png(content, where)
    elif content.startswith(_JPEG):
        _check_jpeg(content, where)
    elif content.startswith(_TIFF):
        _check_tiff(content, where)
    elif not content.startswith(_OTHERS):
        raise _refused("is no image file (PNG, JPEG, BMP, TIFF, PGM)", where, "name an image file")
    return _decoded(content, where)


def _refused(what: str, where: str, cure: str = _CURE) -> FrameError:
    return FrameError(what, where, cure, code=int(ResultCode.BAD_FRAME))


def _decoded(content: bytes, where: str) -> U8:
    # OpenCV reads this once, at its first image; it bounds what a small file can unpack to.
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(PIXEL_LIMIT))
    import cv2

    # What it would print beside our own sentence.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise _refused("cannot be decoded", where) from error
    if image is None:
        raise _refused("is truncated or damaged", where)
    if image.dtype != np.uint8:
        raise _refused(f"has {image.dtype.itemsize * 8} bits per pixel instead of 8", where)
    if image.ndim != 2:
        raise _refused(f"is a colour picture ({image.shape[2]} channels)", where)
    return np.ascontiguousarray(image, np.uint8)


def _check_png(content: bytes, where: str) -> None:
    """Walk the chunks: a decoder fills what is missing with black, and black is no measurement."""
    at, packed, expected = len(_PNG), bytearray(), 0
    while True:
        if at + 12 > len(content):
            raise _refused("is truncated", where)
        length, kind = struct.unpack_from(">I4s", content, at)
        end = at + 12 + length
        if end > len(content):
            raise _refused("is truncated", where)
        if zlib.crc32(content[at + 4 : end - 4]) != struct.unpack_from(">I", content, end - 4)[0]:
            raise _refused("is damaged (checksum)", where)
        if kind == b"IHDR":
            width, height, depth, colour, _, _, interlaced = struct.unpack_from(">IIBBBBB", content, at + 8)
            _check_size(width, height, where)
            if colour != 0:
                raise _refused("is a colour or palette picture", where)
            if depth != 8:
                raise _refused(f"has {depth} bits per pixel instead of 8", where)
            expected = 0 if interlaced else height * (width + 1)
        if kind == b"IDAT":
            packed += content[at + 8 : end - 4]
        if kind == b"IEND":
            break
        at = end
    try:
        rows = zlib.decompressobj().decompress(packed, PIXEL_LIMIT * 2)
    except zlib.error as error:
        raise _refused("is damaged (pixels)", where) from error
    if len(rows) < expected or not rows:
        raise _refused("is truncated", where)


def _check_size(width: int, height: int, where: str) -> None:
    if width * height > PIXEL_LIMIT or not width * height:
        raise _refused(f"is {width} x {height} pixels", where)


def _check_jpeg(content: bytes, where: str) -> None:
    """The segments up to the scan, and the end mark: a decoder fills what is missing with grey."""
    at = 2
    while at + 4 <= len(content) and content[at] == 0xFF:
        marker, length = content[at + 1], struct.unpack_from(">H", content, at + 2)[0]
        if marker == 0xFF:
            at += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            if at + 10 > len(content):
                break
            depth, height, width, channels = struct.unpack_from(">BHHB", content, at + 4)
            _check_size(width, height, where)
            if channels != 1:
                raise _refused(f"is a colour picture ({channels} channels)", where)
            if depth != 8:
                raise _refused(f"has {depth} bits per pixel instead of 8", where)
        if marker == 0xDA:
            if content.rstrip(b"\0\r\n")[-2:] != b"\xff\xd9":
                raise _refused("is truncated", where)
            return
        at += 2 + length
    raise _refused("is truncated", where)


def _check_tiff(content: bytes, where: str) -> None:
    """The first directory to its last byte: it may be the end of the file, and the decoder forgives that."""
    order = "<" if content.startswith(b"II") else ">"
    if len(content) >= 8:
        (at,) = struct.unpack_from(f"{order}I", content, 4)
        if at + 2 <= len(content):
            (entries,) = struct.unpack_from(f"{order}H", content, at)
            if at + 2 + 12 * entries + 4 <= len(content):
                return
    raise _refused("is truncated", where)
