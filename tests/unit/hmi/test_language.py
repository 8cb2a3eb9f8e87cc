"""Every text of the screens is there in every language."""

from __future__ import annotations

import ast
import string
from functools import cache
from pathlib import Path

import pytest

import wearline_hmi
from wearline.messages import CODE_MEANING, Decision
from wearline_hmi.core.language import ENGLISH, LANGUAGES, Language
from wearline_hmi.core.rights import DEEDS, Role
from wearline_hmi.core.words import decision_sign

ROOT = Path(wearline_hmi.__file__).parent
OTHERS = [language for language in LANGUAGES.values() if language is not ENGLISH]


@cache
def trees() -> list[ast.Module]:
    return [
        ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted(ROOT.rglob("*.py"))
        if path.name not in ("german.py", "chinese.py")
    ]


def said() -> set[str]:
    """Texts that are given to a language as they are written."""
    found: set[str] = set()
    for tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and "say" in (getattr(node.func, "id", ""), getattr(node.func, "attr", "")):
                words = ast.walk(node.args[0]) if isinstance(node.args[0], ast.Constant | ast.IfExp) else ()
                found |= {w.value for w in words if isinstance(w, ast.Constant) and isinstance(w.value, str)}
    return found


def closed_sets() -> set[str]:
    """Texts that reach a language through a variable."""
    return {
        *CODE_MEANING.values(), *(decision_sign(d.value).word for d in Decision), *(d.name for d in DEEDS),
        *(role.value for role in Role), "starting", "ready", "degraded", "stopping", "info", "warning", "error",
        "auto", "manual", "standard", "measured", "difference",
    }  # fmt: skip


def fields(text: str) -> set[str]:
    return {f"{name}:{form}" for _, name, form, _ in string.Formatter().parse(text) if name is not None}


@pytest.mark.parametrize("language", OTHERS, ids=lambda language: language.code)
def test_nothing_is_left_in_english(language: Language) -> None:
    assert sorted((said() | closed_sets()) - set(language.table)) == []


@pytest.mark.parametrize("language", OTHERS, ids=lambda language: language.code)
def test_values_stand_where_the_english_text_has_them(language: Language) -> None:
    assert [text for text, other in language.table.items() if fields(text) != fields(other)] == []
    assert [text for text, other in language.table.items() if not other.strip()] == []


def test_no_translation_is_kept_for_a_text_that_nobody_says() -> None:
    constants = {n.value for tree in trees() for n in ast.walk(tree) if isinstance(n, ast.Constant)}
    known = {text for language in OTHERS for text in language.table}
    assert sorted(known - constants - closed_sets()) == []


def test_all_tables_have_the_same_texts() -> None:
    assert len({frozenset(language.table) for language in OTHERS}) == 1


def test_numbers_and_values_are_put_in() -> None:
    german = LANGUAGES["de"]
    assert german("{n} s ago", n=3) == "vor 3 s"
    assert german("no such text") == "no such text"
    assert german.number("-0.125") == "−0,125"
    assert ENGLISH.number("-0.125") == "−0.125"
