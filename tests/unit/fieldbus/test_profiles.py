"""The table of the process image: golden bytes, round trips, and remaps that are refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wearline.errors import ConfigError
from wearline_fieldbus.core.profiles import BASIC, Direction, Field, Profile, image_rows, remapped, string

REQUEST, RESPONSE = Direction.REQUEST, Direction.RESPONSE


def test_golden_request() -> None:
    """Table 5.1: input byte 0 bits 0-3, word 2 object index; its spare words 4, 6, 8."""
    image = bytes.fromhex("0f00" "0003" "1234" "ffff" "8001") + bytes(10)  # fmt: skip
    assert BASIC.decode(image, REQUEST) == {
        "start_camera": True, "stop_camera": True, "measure": True, "link_ok": True, "object_index": 3,
        "measure_number": 0x1234, "stroke": 65535, "plc_life": 0x8001,
    }  # fmt: skip
    assert BASIC.encode(BASIC.decode(image, REQUEST), REQUEST) == image[:10]


@pytest.mark.parametrize(
    ("name", "first"),
    [("ready", "01"), ("measure_finished", "02"), ("passed", "04"), ("failed", "08"), ("mode", "10"),
     ("object_changed", "20"), ("fault", "40"), ("simulated", "80")],
)  # fmt: skip
def test_golden_response_bits(name: str, first: str) -> None:
    assert BASIC.encode({name: True}, RESPONSE).hex() == first + "00" * 9


def test_golden_response_words() -> None:
    values = {"vision_life": 255, "result_code": 19, "mean_error_um": 300, "max_error_um": 0xFFFF, "echo": 65535}
    assert BASIC.encode(values, RESPONSE).hex() == "00ff" "0013" "012c" "ffff" "ffff"  # fmt: skip
    assert BASIC.span(REQUEST) == (0, 10) and BASIC.span(RESPONSE) == (10, 20) and BASIC.size == 20


@given(st.binary(min_size=20, max_size=20))
def test_every_image_survives_a_round_trip(image: bytes) -> None:
    for direction in Direction:
        start, _ = BASIC.span(direction)
        again = BASIC.encode(BASIC.decode(image, direction), direction)
        assert BASIC.decode(bytes(start) + again, direction) == BASIC.decode(image, direction)


def test_values_that_do_not_fit_are_refused() -> None:
    for value in (-1, 65536):
        with pytest.raises(ValueError, match="echo cannot hold"):
            BASIC.encode({"echo": value}, RESPONSE)
    with pytest.raises(ValueError, match="shorter"):
        BASIC.decode(bytes(9), REQUEST)


def test_strings_are_cut_and_never_read_beyond_their_field() -> None:
    profile = Profile(
        "text", (Field("part", 0, None, string(4), REQUEST, ""), Field("x", 6, 0, BASIC.fields[0].kind, RESPONSE, ""))
    )
    assert profile.encode({"part": "Teil\u20ac7"}, REQUEST).hex() == "0404" + b"Teil".hex()
    assert profile.decode(bytes.fromhex("ff ff 41 42 43 44 00"), REQUEST) == {"part": "ABCD"}


def test_a_remap_moves_fields_and_leaves_out_what_may_be() -> None:
    moves = {"echo": "12", "result_code": "18", "start_camera": "-", "fault": "-", "plc_life": "-"}
    profile = remapped(BASIC, moves, True, "here")
    assert profile.encode({"echo": 0xABCD}, RESPONSE).hex() == "0000" "abcd" + "00" * 6  # fmt: skip
    assert "start_camera" not in profile.decode(bytes(20), REQUEST)
    assert remapped(BASIC, {"measure_number": "-", "echo": "-"}, False, "here").field("echo") is None


@pytest.mark.parametrize(
    ("moves", "sentence"),
    [
        ({"echo": "16"}, "'echo' overlaps 'max_error_um' at byte 16"),
        ({"passed": "10.0"}, "'passed' overlaps 'ready' at byte 10"),
        ({"passed": "0.5"}, "byte 0 would have two writers"),
        ({"measure_number": "12"}, "two writers"),
        ({"plc_life": "30"}, "lies inside the request block"),
        ({"echo": "-"}, "safety rests on it"),
        ({"measure": "-"}, "safety rests on it"),
        ({"simulated": "-"}, "safety rests on it"),
        ({"echo": "13.2"}, "is no address"),
        ({"passed": "10"}, "is no address"),
        ({"passed": "10.8"}, "is no address"),
        ({"echo": "21"}, "at an odd byte"),
        ({"nonsense": "4"}, "has no field 'nonsense'"),
        ({"echo": "400"}, "keep it within 200"),
    ],
)
def test_a_remap_that_would_be_unsafe_is_refused_with_a_sentence(moves: dict[str, str], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence) as caught:
        remapped(BASIC, moves, True, "fieldbus.remap")
    assert str(caught.value).startswith("fieldbus.remap: ") and ";" in str(caught.value)


def test_rows_for_the_monitor() -> None:
    rows = image_rows(BASIC, bytes.fromhex("0400 0003 0007 0000 0000 0100 0000 ffff ffff 0000"))
    values = {row["name"]: row["value"] for row in rows}
    assert values["measure"] is True and values["object_index"] == 3 and values["ready"] is True
    assert {row["address"] for row in rows} >= {"0.2", "10.7", "18"} and len(rows) == len(BASIC.fields)
    assert image_rows(BASIC, b"")[0]["value"] is None
