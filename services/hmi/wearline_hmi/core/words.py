"""Figures and words as people read them on the panel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from wearline.messages import CODE_MEANING, ResultCode, WearTrend
from wearline_hmi.core.language import ENGLISH, Language
from wearline_hmi.core.state import CellState, Seen, Stroke, current_object, trends_of

STATE_FRESH_S = 3.0
STATE_LOST_S = 6.0
PREVIEW_STALE_S = 3.0
DASH = "–"


def age_text(age_s: float | None, say: Language = ENGLISH) -> str:
    """'just now', '12 s ago', '3 min ago' or '2 h 05 min ago'; a dash when nothing came yet."""
    if age_s is None:
        return DASH
    if age_s < 1.0:
        return say("just now")
    if age_s < 120.0:
        return say("{n} s ago", n=int(age_s))
    minutes = int(age_s // 60)
    if minutes < 120:
        return say("{n} min ago", n=minutes)
    hours, minutes = divmod(minutes, 60)
    return (
        say("{hours} h {minutes:02d} min ago", hours=hours, minutes=minutes)
        if hours < 48
        else say("{n} days ago", n=hours // 24)
    )


def mm_text(value_mm: float | None, sign: bool = False, say: Language = ENGLISH) -> str:
    """Three decimals, a true minus sign, a dash for what was not measured."""
    if value_mm is None or not math.isfinite(value_mm):
        return DASH
    if abs(value_mm) < 0.0005:
        return say.number("0.000")
    return say.number(f"{value_mm:+.3f}" if sign else f"{value_mm:.3f}")


def ms_text(value_ms: float | None) -> str:
    """Whole milliseconds, or a dash."""
    return DASH if value_ms is None or not math.isfinite(value_ms) else f"{value_ms:.0f}"


def time_text(utc: str) -> str:
    """The time of day of an ISO 8601 instant, to the second, UTC."""
    return utc[11:19] if len(utc) >= 19 and utc[10] in "T " else DASH


def code_text(code: int) -> str:
    """What a result code means."""
    try:
        return CODE_MEANING[ResultCode(code)]
    except ValueError:
        return f"result code {code}"


@dataclass(frozen=True)
class Sign:
    """A state as colour, shape and word: each of the three says it alone."""

    colour: str
    """green, red, amber or grey: a class of the style sheet."""
    icon: str
    """check, cross, question, dash, warn, clock or hand: a shape of the style sheet."""
    word: str
    detail: str = ""


@dataclass(frozen=True)
class VerdictSign:
    """The big panel."""

    sign: Sign
    age: str
    is_stale: bool
    is_told: bool
    """The PLC got this very result."""


_DECISIONS = {
    "PASSED": ("green", "check", "PASSED"),
    "FAILED": ("red", "cross", "FAILED"),
    "UNSURE": ("amber", "question", "UNSURE"),
    "NOT_MEASURED": ("amber", "warn", "NOT MEASURED"),
}


def decision_sign(decision: str, detail: str = "") -> Sign:
    """Colour, shape and word of one decision."""
    colour, icon, word = _DECISIONS[decision]
    return Sign(colour, icon, word, detail)


def verdict_sign(state: CellState, now_s: float, stale_after_s: float, say: Language = ENGLISH) -> VerdictSign:
    """What the big panel says at `now_s`: the newest stroke, or that there is none.

    An outcome that contradicts the verdict (the deadline had gone, a simulated verdict was refused)
    rules: the panel shows what the PLC was told. An old verdict keeps its shape and word and loses its colour.
    """
    verdict = state.verdict
    if verdict is None:
        detail = say("No stroke was measured since this screen started")
        return VerdictSign(Sign("grey", "dash", "NO VERDICT", detail), DASH, True, False)
    sign = decision_sign(verdict.decision.value, verdict.reason or say(code_text(verdict.code)))
    newest = next((row for row in state.strokes if row.cycle_id == verdict.cycle_id), None)
    outcome = state.outcome
    is_told = newest is not None and newest.told_code is not None
    if outcome is not None and outcome.cycle_id == verdict.cycle_id:
        if not outcome.was_told:
            sign = Sign("amber", "warn", sign.word, f"{say('THE PLC WAS NOT TOLD.')} {sign.detail}")
        elif outcome.code >= 10 and verdict.decision.value != "NOT_MEASURED":
            sign = decision_sign("NOT_MEASURED", say(code_text(outcome.code)))
    if state.verdict_at_s is None:
        return VerdictSign(replace(sign, colour="grey"), say("before this screen started"), True, is_told)
    age_s = max(0.0, now_s - state.verdict_at_s)
    is_stale = age_s > stale_after_s
    return VerdictSign(replace(sign, colour="grey") if is_stale else sign, age_text(age_s, say), is_stale, is_told)


def service_sign(seen: Seen, now_s: float, say: Language = ENGLISH) -> Sign:
    """Colour, shape and word of one service; its detail is the age of what it said."""
    age_s = None if seen.at_s is None else max(0.0, now_s - seen.at_s)
    if seen.state is None or age_s is None:
        if seen.is_alive is False:
            return Sign("red", "cross", "gone", DASH)
        return Sign("grey", "dash", "not heard yet", DASH)
    age = age_text(age_s if age_s >= 1.5 else 0.0, say)
    if seen.is_alive is False or age_s > STATE_LOST_S:
        return Sign("red", "cross", "lost", age)
    if age_s > STATE_FRESH_S:
        return Sign("amber", "clock", "late", age)
    colour, icon = {"ready": ("green", "check"), "degraded": ("amber", "warn")}.get(
        seen.state.status, ("amber", "clock")
    )
    return Sign(colour, icon, seen.state.status, age)


@dataclass(frozen=True)
class HeaderWords:
    """The line at the top."""

    ready: Sign
    mode: Sign
    plc: Sign
    object_text: str


UNKNOWN = Sign("grey", "dash", "unknown")


def _flag(value: object, yes: Sign, no: Sign) -> Sign:
    return UNKNOWN if value is None else yes if value else no


def header_words(state: CellState, now_s: float) -> HeaderWords:
    """Ready, mode, PLC link and object; what fieldbus said too long ago is unknown, not true."""
    seen = state.services["fieldbus"]
    index = current_object(state)
    object_text = DASH if index is None else str(index)
    told = seen.state
    if told is None or seen.at_s is None or seen.is_alive is False or now_s - seen.at_s > STATE_LOST_S:
        return HeaderWords(UNKNOWN, UNKNOWN, UNKNOWN, object_text)
    mode = str(told.values.get("mode") or "unknown")
    mode_sign = {
        "auto": Sign("green", "check", "auto"),
        "manual": Sign("amber", "hand", "manual"),
    }.get(mode, UNKNOWN)
    # During a cycle Ready is off by the rules of the handshake, and all is well.
    is_busy = told.values.get("handshake") in ("measuring", "telling", "told")
    not_ready = Sign("amber", "warn", "not ready", str(told.values.get("not_ready_because") or ""))
    return HeaderWords(
        _flag(
            told.values.get("ready"),
            Sign("green", "check", "Ready"),
            Sign("green", "clock", "measuring") if is_busy else not_ready,
        ),
        mode_sign,
        _flag(told.values.get("plc_link_up"), Sign("green", "check", "up"), Sign("red", "cross", "DOWN")),
        object_text,
    )


def stroke_sign(row: Stroke, say: Language = ENGLISH) -> Sign:
    """The verdict column: the word of the decision; amber where the PLC was told something else."""
    sign = decision_sign(row.decision)
    if row.told_code is not None and row.told_code >= 10 and row.decision in ("PASSED", "FAILED", "UNSURE"):
        return Sign("amber", "warn", "NOT MEASURED", say(code_text(row.told_code)))
    return Sign(sign.colour, sign.icon, sign.word, row.reason)


_ALARMS = (
    ("green", "check", "no alarm"), ("grey", "dash", "note"), ("amber", "clock", "warning"), ("red", "warn", "action"),
    ("red", "cross", "stop"),
)  # fmt: skip
RECORDS_LOST_S = 30.0


def alarm_sign(trend: WearTrend) -> Sign:
    """The alarm of one zone; its detail is why."""
    return Sign(*_ALARMS[trend.alarm_level], trend.alarm_reason)


def wear_sign(state: CellState, now_s: float) -> Sign:
    """The worst alarm of the current object; unknown while judge tells no trend."""
    trends = trends_of(state)
    if not trends or state.records_at_s is None or now_s - state.records_at_s > RECORDS_LOST_S:
        return UNKNOWN
    return alarm_sign(max(trends, key=lambda trend: trend.alarm_level))


def pass_rate_text(state: CellState, say: Language = ENGLISH) -> str:
    """Share of the recorded strokes that passed."""
    return DASH if not state.total else say.number(f"{100.0 * state.passed / state.total:.1f} %")
