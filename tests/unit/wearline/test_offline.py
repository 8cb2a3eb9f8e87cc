"""Frames from files, and the chain of handlers in one process."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from wearline import messages as m
from wearline import offline
from wearline.errors import BusError, FrameError
from wearline.offline import Chain, read_frame
from wearline.recipe import Recipe, parse_recipe, recipe_hash
from wearline.service import Asker, Service
from wearline.topics import ARTIFACT, FRAME, LINE_POINTS, RECIPE, RECIPE_LIST, Topic

IMAGE = (np.arange(40 * 60, dtype=np.uint32).reshape(40, 60) * 2654435761 >> 24).astype(np.uint8)


def encoded(kind: str, image: Any = IMAGE) -> bytes:
    ok, content = cv2.imencode(kind, image)
    assert ok
    return bytes(content.tobytes())


@pytest.mark.parametrize("kind", [".png", ".bmp", ".tiff", ".pgm"])
def test_a_grey_picture_is_read_as_it_is(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"frame{kind}"
    path.write_bytes(encoded(kind))
    assert np.array_equal(read_frame(path), IMAGE)


def test_a_grey_jpeg_is_read(tmp_path: Path) -> None:
    path = tmp_path / "frame.jpg"
    path.write_bytes(encoded(".jpg"))
    assert read_frame(path).shape == IMAGE.shape


def refused(path: Path, content: bytes | None) -> str:
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FrameError) as caught:
        read_frame(path)
    assert caught.value.code == m.ResultCode.BAD_FRAME
    assert str(caught.value).startswith(f"{path}: ")
    assert ";" in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("kind", [".png", ".jpg", ".bmp", ".tiff", ".pgm"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.95, 0.999])
def test_a_truncated_picture_is_refused(tmp_path: Path, kind: str, share: float) -> None:
    content = encoded(kind)
    refused(tmp_path / f"frame{kind}", content[: min(len(content) - 1, int(len(content) * share))])


def png(*chunks: tuple[bytes, bytes]) -> bytes:
    body = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body


def header(width: int, height: int, depth: int = 8, colour: int = 0) -> tuple[bytes, bytes]:
    return b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "cannot be read"),
        (b"", "is empty"),
        (b"not an image\n", "no image file"),
        (encoded(".png", np.zeros((9, 9), np.uint16)), "16 bits"),
        (encoded(".tiff", np.zeros((9, 9), np.uint16)), "16 bits"),
        (encoded(".png", np.zeros((9, 9, 3), np.uint8)), "colour"),
        (encoded(".jpg", np.zeros((9, 9, 3), np.uint8)), "colour"),
        (encoded(".bmp", np.zeros((9, 9, 3), np.uint8)), "colour"),
        (png(header(9, 9), (b"IDAT", zlib.compress(bytes(50))), (b"IEND", b"")), "truncated"),
        (png(header(9, 9), (b"IEND", b"")), "truncated"),
        (png(header(9, 9), (b"IDAT", b"garbage"), (b"IEND", b"")), "damaged"),
        (png(header(2**20, 2**20), (b"IDAT", zlib.compress(bytes(50))), (b"IEND", b"")), "1048576 x 1048576"),
        (png((b"IEND", b"")), "truncated"),
        (b"\xff\xd8\xff", "truncated"),
    ],
)
def test_what_is_no_whole_grey_frame_is_refused(tmp_path: Path, content: bytes | None, said: str) -> None:
    assert said in refused(tmp_path / "frame", content)


def test_a_flipped_bit_is_refused(tmp_path: Path) -> None:
    content = bytearray(encoded(".png"))
    content[len(content) // 2] ^= 4
    assert "checksum" in refused(tmp_path / "frame.png", bytes(content))


def test_a_folder_and_a_huge_file_are_refused(tmp_path: Path) -> None:
    assert "cannot be read" in refused(tmp_path, None)
    huge = tmp_path / "huge.pgm"
    with huge.open("wb") as file:
        file.truncate(offline.FILE_LIMIT_BYTES + 1)
    assert "beyond 256 MiB" in refused(huge, None)


class Reconstruct(Service):
    name = "reconstruct"

    def __init__(self, asker: Asker) -> None:
        self._asker = asker

    def handlers(self) -> Mapping[Topic, Callable[[Any], Iterable[m.Message]]]:
        return {FRAME: self.on_frame}

    def on_frame(self, frame: m.Frame) -> Iterable[m.Message]:
        recipe = self._asker.ask(RECIPE, m.AskRecipe(object_index=frame.request.object_index))
        assert isinstance(recipe, m.ObjectRecipe)
        calibration = self._asker.ask(ARTIFACT, m.AskArtifact(content_hash=recipe.calibration_hash))
        assert isinstance(calibration, m.Artifact)
        yield m.LinePoints(
            cycle_id=frame.cycle_id, is_simulated=frame.is_simulated, request=frame.request,
            points=np.full((1, 5), float(frame.pixels.size + calibration.content.size), np.float32),
            quality=m.FrameQuality(), recipe_hash=recipe.recipe_hash, refusal_code=frame.refusal_code,
            refusal=frame.refusal,
        )  # fmt: skip


class Judge(Service):
    name = "judge"

    def handlers(self) -> Mapping[Topic, Callable[[Any], Iterable[m.Message]]]:
        return {LINE_POINTS: self.on_line_points}

    def on_line_points(self, points: m.LinePoints) -> Iterable[m.Message]:
        decision = m.Decision.NOT_MEASURED if points.refusal_code else m.Decision.PASSED
        yield m.Verdict(
            cycle_id=points.cycle_id, is_simulated=points.is_simulated, request=points.request, decision=decision,
            code=points.refusal_code or 1, reason=points.refusal, recipe_hash=points.recipe_hash,
        )  # fmt: skip


@pytest.fixture
def fake_services(monkeypatch: pytest.MonkeyPatch) -> None:
    def offered(name: str, asker: Asker) -> Service:
        return Reconstruct(asker) if name == "reconstruct" else Judge()

    monkeypatch.setattr(offline, "offline_service", offered)


@pytest.mark.usefixtures("fake_services")
def test_a_frame_goes_through_both_handlers() -> None:
    recipe = parse_recipe("precision_mm: 0.2")
    chain = Chain(recipe, b"four")
    points = chain.line_points(IMAGE)
    assert float(points.points[0, 0]) == IMAGE.size + 4
    verdict = chain.verdict(IMAGE)
    assert (verdict.decision, verdict.recipe_hash) == (m.Decision.PASSED, recipe_hash(recipe))
    assert verdict.cycle_id != points.cycle_id
    assert not verdict.is_simulated


@pytest.mark.usefixtures("fake_services")
def test_a_frame_that_cannot_be_read_is_not_measured() -> None:
    verdict = Chain(None, b"four").verdict(FrameError("is truncated", "a.png", "take another", code=21))
    assert (verdict.decision, verdict.code) == (m.Decision.NOT_MEASURED, 21)
    assert "a.png: is truncated" in verdict.reason


def test_the_chain_answers_what_is_here_and_nothing_else() -> None:
    chain = Chain(Recipe(), None, b"template", object_index=4)
    assert chain.object_recipe.calibration_hash == ""
    artifact = chain.ask(ARTIFACT, m.AskArtifact(content_hash=chain.object_recipe.template_hash))
    assert isinstance(artifact, m.Artifact)
    assert artifact.content.tobytes() == b"template"
    with pytest.raises(BusError, match="no artifact"):
        chain.ask(ARTIFACT, m.AskArtifact(content_hash=""))
    with pytest.raises(BusError, match="object 5"):
        chain.ask(RECIPE, m.AskRecipe(object_index=5))
    with pytest.raises(BusError, match="nobody answers"):
        chain.ask(RECIPE_LIST, m.Ping())
