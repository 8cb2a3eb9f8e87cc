"""What the screens say, in the reader's language: English is written in the code, the others in one table each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from wearline_hmi.core.chinese import CHINESE
from wearline_hmi.core.german import GERMAN


@dataclass(frozen=True)
class Language:
    """Call it with an English text: `say("{n} s ago", n=3)`."""

    code: str
    name: str
    """Of the language, in itself."""
    table: Mapping[str, str] = field(default_factory=dict, repr=False)
    decimal_point: str = "."

    def __call__(self, text: str, **values: object) -> str:
        found = self.table.get(text, text)
        return found.format(**values) if values else found

    def number(self, text: str) -> str:
        """A number written by Python, with this language's decimal point and a true minus sign."""
        return text.replace(".", self.decimal_point).replace("-", "−")


ENGLISH = Language("en", "English")
LANGUAGES = {
    "en": ENGLISH,
    "de": Language("de", "Deutsch", GERMAN, ","),
    "zh": Language("zh", "中文", CHINESE),
}


def chosen(wanted: str) -> Language:
    """The language of a code such as de or of an Accept-Language header; English where none fits."""
    for part in wanted.split(","):
        code = part.split(";")[0].strip().lower().split("-")[0]
        if code in LANGUAGES:
            return LANGUAGES[code]
    return ENGLISH
