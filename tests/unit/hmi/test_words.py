"""What the screens say of states and figures: an unknown or old value is never green."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.contract.examples import OUTCOME, TREND, VERDICT
from wearline import messages as m
from wearline_hmi.core import state as s
from wearline_hmi.core import words as w
from wearline_hmi.core.language import LANGUAGES, chosen
from wearline_hmi.core.state import CellState, Seen

GERMAN = LANGUAGES["de"]


def fieldbus(**values: float | int | str | bool | None) -> m.ServiceState:
    return m.ServiceState(service="fieldbus", status="ready", pid=1, uptime_s=1, version="0", values=values)


@given(
    status=st.sampled_from(["starting", "ready", "degraded", "stopping"]),
    age_s=st.floats(0, 1e5),
    is_alive=st.sampled_from([True, False, None]),
)
def test_a_service_is_green_only_when_it_said_ready_a_moment_ago_and_is_there(
    status: str, age_s: float, is_alive: bool | None
) -> None:
    told = m.ServiceState(service="judge", status=status, pid=1, uptime_s=1, version="0")
    sign = w.service_sign(Seen(told, 100.0, is_alive), 100.0 + age_s)
    is_well = status == "ready" and age_s <= w.STATE_FRESH_S and is_alive is not False
    assert (sign.colour == "green") == is_well
    assert (sign.icon == "check") == is_well


def test_a_service_that_was_never_heard_is_grey_and_one_that_went_is_red() -> None:
    assert w.service_sign(Seen(), 5.0) == w.Sign("grey", "dash", "not heard yet", w.DASH)
    assert w.service_sign(Seen(is_alive=False), 5.0).colour == "red"


@given(
    values=st.fixed_dictionaries(
        {},
        optional={
            "mode": st.sampled_from(["auto", "manual", "strange", "", None]),
            "plc_link_up": st.sampled_from([True, False, None]),
            "ready": st.sampled_from([True, False, None]),
        },
    ),
    age_s=st.floats(0, 100),
    is_alive=st.booleans(),
)
def test_the_header_is_green_only_for_what_fieldbus_says_now(
    values: dict[str, bool | str | None], age_s: float, is_alive: bool
) -> None:
    state = s.with_service(CellState("c"), fieldbus(**values), 10.0)
    state = s.with_alive(state, "fieldbus", is_alive)
    words = w.header_words(state, 10.0 + age_s)
    is_known = is_alive and age_s <= w.STATE_LOST_S
    assert (words.ready.colour == "green") == (is_known and values.get("ready") is True)
    assert (words.plc.colour == "green") == (is_known and values.get("plc_link_up") is True)
    assert (words.mode.colour == "green") == (is_known and values.get("mode") == "auto")
    if not is_known:
        assert {words.ready, words.plc, words.mode} == {w.UNKNOWN}


def test_ready_is_off_during_a_cycle_and_that_is_no_fault() -> None:
    def ready(**values: str | bool) -> w.Sign:
        return w.header_words(s.with_service(CellState("c"), fieldbus(ready=False, **values), 1.0), 1.0).ready

    assert ready(handshake="measuring").word == "measuring"
    assert ready(handshake="idle", not_ready_because="the disk is full") == w.Sign(
        "amber", "warn", "not ready", "the disk is full"
    )


@given(decision=st.sampled_from(list(m.Decision)), age_s=st.floats(0, 1e4))
def test_the_last_verdict_is_green_only_when_passed_and_fresh(decision: m.Decision, age_s: float) -> None:
    code = {"PASSED": 1, "FAILED": 2, "UNSURE": 3}.get(decision.value, 12)
    state = s.with_verdict(CellState("c"), VERDICT.replace(decision=decision, code=code), 50.0)
    shown = w.verdict_sign(state, 50.0 + age_s, 30.0)
    assert (shown.sign.colour == "green") == (decision is m.Decision.PASSED and age_s <= 30.0)
    assert shown.is_stale == (age_s > 30.0)
    assert shown.sign.word == decision.value.replace("_", " ")


def test_a_verdict_of_unknown_age_is_old() -> None:
    state = s.with_verdict(CellState("c"), VERDICT.replace(decision=m.Decision.PASSED, code=1), None)
    shown = w.verdict_sign(state, 50.0, 30.0)
    assert (shown.sign.colour, shown.is_stale, shown.age) == ("grey", True, "before this screen started")


def test_no_verdict_is_said_to_be_none() -> None:
    shown = w.verdict_sign(CellState("c"), 5.0, 30.0)
    assert (shown.sign.colour, shown.sign.word, shown.is_told) == ("grey", "NO VERDICT", False)


@pytest.mark.parametrize(
    ("code", "was_told", "colour", "word"),
    [(1, True, "green", "PASSED"), (10, True, "amber", "NOT MEASURED"), (1, False, "amber", "PASSED")],
)
def test_what_the_plc_was_told_rules_the_big_panel(code: int, was_told: bool, colour: str, word: str) -> None:
    passed = VERDICT.replace(decision=m.Decision.PASSED, code=1)
    state = s.with_verdict(CellState("c"), passed, 1.0)
    state = s.with_outcome(state, OUTCOME.replace(code=code, was_told=was_told))
    shown = w.verdict_sign(state, 1.5, 30.0)
    assert (shown.sign.colour, shown.sign.word) == (colour, word)
    assert ("NOT TOLD" in shown.sign.detail) == (not was_told)
    assert shown.is_told == was_told


def test_each_decision_has_its_own_colour_shape_and_word() -> None:
    signs = [w.decision_sign(decision.value) for decision in m.Decision]
    assert len({sign.icon for sign in signs}) == len(signs)
    assert len({sign.word for sign in signs}) == len(signs)


@pytest.mark.parametrize(
    ("age_s", "text"),
    [
        (None, "–"), (0.9, "just now"), (1.0, "1 s ago"), (119.9, "119 s ago"), (120, "2 min ago"),
        (7199, "119 min ago"), (7500, "2 h 05 min ago"), (3 * 86400, "3 days ago"),
    ],
)  # fmt: skip
def test_ages_in_words(age_s: float | None, text: str) -> None:
    assert w.age_text(age_s) == text


@pytest.mark.parametrize(
    ("value", "sign", "text"),
    [(None, False, "–"), (math.nan, False, "–"), (0.0004, True, "0.000"), (-0.0004, False, "0.000"),
     (-0.3, False, "−0.300"), (0.12, True, "+0.120")],
)  # fmt: skip
def test_millimetres_in_words(value: float | None, sign: bool, text: str) -> None:
    assert w.mm_text(value, sign) == text
    assert w.mm_text(value, sign, GERMAN) == text.replace(".", ",")


def test_an_unknown_code_is_named() -> None:
    assert w.code_text(77) == "result code 77"


@pytest.mark.parametrize(
    ("wanted", "code"), [("de", "de"), ("de-AT,en;q=0.5", "de"), ("fr, zh-CN;q=0.8", "zh"), ("", "en"), ("xx", "en")]
)
def test_the_language_is_chosen_from_what_the_browser_wants(wanted: str, code: str) -> None:
    assert chosen(wanted).code == code


@pytest.mark.parametrize(
    ("levels", "age_s", "word", "colour"),
    [((0, 0), 0.0, "no alarm", "green"), ((0, 4), 0.0, "stop", "red"), ((2, 1), 0.0, "warning", "amber"),
     ((0, 0), 31.0, "unknown", "grey"), ((), 0.0, "unknown", "grey")],
)  # fmt: skip
def test_the_worst_wear_alarm_rules_and_an_old_one_is_unknown(
    levels: tuple[int, ...], age_s: float, word: str, colour: str
) -> None:
    trends = tuple(
        TREND.replace(zone="" if n == 0 else f"zone {n}", alarm_level=level) for n, level in enumerate(levels)
    )  # fmt: skip
    state = s.with_records(CellState("c"), m.Records(rows=(), total=0, trends=trends), 10.0)
    sign = w.wear_sign(state, 10.0 + age_s)
    assert (sign.word, sign.colour) == (word, colour)
