"""What a password must be, and how long a wrong one makes its sender wait."""

from __future__ import annotations

from collections.abc import Collection

LENGTH_MIN, LENGTH_MAX = 12, 256
FREE_TRIES = 3
WAIT_MAX_S = 60.0
FORGOTTEN_S = 3600.0
"""So long after the last wrong one they no longer count. [s]"""

_RUNS = (
    "abcdefghijklmnopqrstuvwxyz",
    "qwertyuiopasdfghjklzxcvbnm",
    "qwertzuiopasdfghjklyxcvbnm",
    "01234567890123456789",
)
_WORDS = """
password passwort passw0rd letmein welcome willkommen changeme admin administrator operator maintenance iloveyou
princess sunshine football baseball dragon monkey master shadow superman batman trustno qwerty qwertz secret geheim
hallo hello test testing guest default system siemens simatic wearline press presse stamping michael jordan jennifer
daniel thomas charlie starwars computer internet summer winter spring autumn sommer fruehling herbst liverpool chelsea
arsenal google facebook whatever freedom nothing access login zugang
"""
_COMMON = frozenset(_WORDS.split())


_AROUND = "0123456789!?.,#*+-_$ @"
_LETTERS = str.maketrans("0134578@$!", "oieastbasi")


def _is_run(password: str) -> bool:
    text = password.casefold()
    for run in _RUNS:
        for line in (run * 3, run[::-1] * 3):
            if text in line:
                return True
    return any(text == (text[:n] * len(text))[: len(text)] for n in range(1, 5))


def fault_of(password: str, name: str = "", forbidden: Collection[str] = ()) -> str | None:
    """Why a password cannot be taken, as a sentence, or None.

    Length counts and composition does not (NIST SP 800-63B, ASVS 5.0 section 6.2). `forbidden` holds known
    passwords in lower case; beside it common words with figures or signs around them are refused.
    """
    if len(password) < LENGTH_MIN:
        return "A password has 12 characters at least; several words make a good one."
    if len(password) > LENGTH_MAX:
        return "A password has 256 characters at most."
    text = password.casefold()
    if _is_run(password):
        return "This password is a mere run or repetition."
    if len(name) >= 3 and name.casefold() in text and len(password) - len(name) < 10:
        return "This password is little more than the name."
    bare = text.strip(_AROUND)
    core = {bare, bare.translate(_LETTERS)}
    halves = {part[: len(part) // 2] for part in core if part[: len(part) // 2] * 2 == part}
    if text in forbidden or (core | halves) & _COMMON or not bare:
        return "This password is well known."
    return None


def wait_s(failures: int, since_last_s: float) -> float:
    """How long its sender must still wait after so many wrong ones in a row. [s]

    It doubles from 1 s to a minute and never locks anybody out: an operator must reach the press.
    """
    if failures <= FREE_TRIES or since_last_s > FORGOTTEN_S:
        return 0.0
    pause_s = min(WAIT_MAX_S, 2.0 ** min(failures - FREE_TRIES - 1, 30))
    return max(0.0, pause_s - since_last_s)
