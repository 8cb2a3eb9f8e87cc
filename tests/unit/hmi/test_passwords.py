"""Which passwords are taken, and how long wrong ones must wait."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wearline_hmi.core.passwords import FREE_TRIES, WAIT_MAX_S, fault_of, wait_s


@pytest.mark.parametrize(
    "password",
    ["short", "x" * 12, "abababababab", "abcabcabcabc", "123456789012", "0987654321098", "abcdefghijkl", "qwertzuiopas",
     "Password1234", "passwordpassword", "P4ssw0rd!!!!!!", "!!!!administrator", "ada-lovelace", "summer2026!!!",
     "123!!!456???", "x" * 257, "correct horse", ],
)  # fmt: skip
def test_weak_passwords_are_refused(password: str) -> None:
    assert fault_of(password, "ada", {"correct horse"}) is not None


@pytest.mark.parametrize(
    "password",
    ["die presse läuft rund", "correct horse battery", "x9" + "k" * 62 + "q", "冲压车间 第七号 测量 很准 的",
     "no composition rules", "a" * 200 + "b" * 56, "tulip-anvil-94-fog"],
)  # fmt: skip
def test_long_ones_are_taken_whatever_they_are_made_of(password: str) -> None:
    assert fault_of(password, "ada") is None


def test_the_name_alone_makes_no_password() -> None:
    assert fault_of("konstantin-1", "Konstantin") is not None
    assert fault_of("konstantin likes tulips", "Konstantin") is None


def test_some_wrong_ones_are_free_then_the_pause_doubles_to_a_minute() -> None:
    pauses = [wait_s(n, 0.0) for n in range(FREE_TRIES + 10)]
    assert pauses[: FREE_TRIES + 1] == [0.0] * (FREE_TRIES + 1)
    assert pauses[FREE_TRIES + 1 : FREE_TRIES + 5] == [1.0, 2.0, 4.0, 8.0]
    assert max(pauses) == WAIT_MAX_S


@given(st.integers(0, 10**9), st.floats(0, 1e9))
def test_nobody_is_ever_locked_out(failures: int, since_s: float) -> None:
    left_s = wait_s(failures, since_s)
    assert 0.0 <= left_s <= WAIT_MAX_S
    assert wait_s(failures, since_s + left_s + 1e-6 * max(since_s, 1.0)) == 0.0
