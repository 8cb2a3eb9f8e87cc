"""Every message arrives as it was sent, and nothing else is taken for it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from numpy.typing import NDArray

from tests.contract.examples import CYCLE, EXAMPLES, QUALITY, REQUEST
from tests.contract.message_schemas import FOLDER, message_kinds, schema_of
from wearline import messages as m
from wearline.errors import MessageError


def same(one: m.Message, other: m.Message) -> bool:
    """Equal in every field, arrays bit for bit (NaN equals NaN)."""
    names = type(one).model_fields
    for name in names:
        a, b = getattr(one, name), getattr(other, name)
        if isinstance(a, np.ndarray):
            if a.dtype != b.dtype or a.shape != b.shape or a.tobytes() != b.tobytes():
                return False
        elif a != b:
            return False
    return type(one) is type(other)


def test_every_message_has_an_example() -> None:
    assert {type(example) for example in EXAMPLES} == set(message_kinds())


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_every_message_round_trips(message: m.Message) -> None:
    assert same(m.decode(type(message), *m.encode(message)), message)


@given(
    pixels=st_numpy.arrays(np.uint8, st_numpy.array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=9)),
    text=st.text(max_size=20),
    exposure_us=st.floats(0, 1e6),
    counter=st.integers(0, 2**53),
)
@settings(max_examples=60, deadline=None)
def test_frames_round_trip(pixels: NDArray[np.uint8], text: str, exposure_us: float, counter: int) -> None:
    frame = m.Frame(
        **CYCLE, request=REQUEST, camera=text, pixels=pixels, exposure_us=exposure_us, frame_counter=counter
    )
    assert same(m.decode(m.Frame, *m.encode(frame)), frame)


@given(st_numpy.arrays(np.float32, st.tuples(st.integers(0, 9), st.just(5))))
@settings(max_examples=60, deadline=None)
def test_line_points_round_trip_with_every_bit_pattern(points: NDArray[np.float32]) -> None:
    message = m.LinePoints(**CYCLE, request=REQUEST, points=points, quality=QUALITY)
    assert same(m.decode(m.LinePoints, *m.encode(message)), message)


def test_a_transposed_array_arrives_as_it_looked() -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4).T
    frame = m.Frame(**CYCLE, request=REQUEST, camera="", pixels=pixels, exposure_us=1.0, frame_counter=0)
    assert np.array_equal(m.decode(m.Frame, *m.encode(frame)).pixels, pixels)


@pytest.mark.parametrize("kind", message_kinds(), ids=lambda kind: kind.__name__)
def test_schema_is_the_committed_one(kind: type[m.Message]) -> None:
    committed = FOLDER / f"{kind.__name__}.json"
    cure = "if the change is wanted: python tests/contract/message_schemas.py"
    assert committed.exists(), cure
    assert committed.read_text(encoding="utf-8") == schema_of(kind), cure


def test_no_schema_is_left_over() -> None:
    assert {Path(path).stem for path in FOLDER.glob("*.json")} == {kind.__name__ for kind in message_kinds()}


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_an_unknown_field_is_refused_by_name(message: m.Message) -> None:
    header, payload = m.encode(message)
    outer = json.loads(header)
    outer["fields"]["surprise"] = 1
    with pytest.raises(MessageError, match=f"{type(message).__name__}.surprise"):
        m.decode(type(message), json.dumps(outer).encode(), payload)


@pytest.mark.parametrize(
    "pixels",
    [np.zeros((2, 2), np.uint16), np.zeros((2, 2), np.int8), np.zeros((2, 2, 3), np.uint8), [[1, 2]], None],
    ids=["uint16", "int8", "colour", "list", "none"],
)
def test_a_wrong_array_is_refused(pixels: Any) -> None:
    with pytest.raises(ValueError, match="expected"):
        m.Frame(**CYCLE, request=REQUEST, camera="", pixels=pixels, exposure_us=1.0, frame_counter=0)


def test_a_payload_of_another_dtype_is_refused() -> None:
    frame = EXAMPLES[1]
    header, payload = m.encode(frame)
    wide = np.frombuffer(payload, np.uint8).astype(np.uint16).tobytes()
    with pytest.raises(MessageError, match="does not fit shape"):
        m.decode(m.Frame, header, wide)


@pytest.mark.parametrize("header", [b"", b"{", b"[]", b"null", b'{"message":"Frame"}', b"\xff"])
def test_a_header_that_is_none_is_refused(header: bytes) -> None:
    with pytest.raises(MessageError):
        m.decode(m.Frame, header, b"")


def test_another_message_is_refused() -> None:
    with pytest.raises(MessageError, match="expected Verdict"):
        m.decode(m.Verdict, *m.encode(REQUEST))


def test_an_array_that_arrived_cannot_be_written() -> None:
    frame = m.decode(m.Frame, *m.encode(EXAMPLES[1]))
    with pytest.raises(ValueError, match="read-only"):
        frame.pixels[0, 0] = 1
