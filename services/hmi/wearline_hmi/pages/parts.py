"""Small elements that several pages are made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from fastapi import Request
from nicegui import ui
from nicegui.element import Element

from wearline_hmi.core.charts import INKS, Ink
from wearline_hmi.core.language import Language, chosen
from wearline_hmi.core.words import Sign

LOOK_COOKIE = "wearline_look"


class Look:
    """How one browser wants to see the pages: language and theme, kept in a cookie of its own."""

    def __init__(self, request: Request) -> None:
        theme, _, code = request.cookies.get(LOOK_COOKIE, "").partition(".")
        self.theme = theme if theme in INKS else ""
        self.say: Language = chosen(code or request.headers.get("accept-language", ""))

    @property
    def is_dark(self) -> bool:
        return self.theme == "dark"

    @property
    def ink(self) -> Ink:
        return INKS[self.theme or "light"]

    def script(self, theme: str | None = None, code: str | None = None) -> str:
        """JavaScript that keeps another choice and loads the page anew."""
        wanted = f"{theme or self.theme}.{code or self.say.code}"
        return f"document.cookie='{LOOK_COOKIE}={wanted}; path=/; max-age=31536000; samesite=strict'; location.reload()"


class SignElement(Element):
    """Colour, shape and word; changes only what differs."""

    def __init__(self, say: Language, classes: str = "") -> None:
        super().__init__("span")
        self.classes(f"sign {classes}")
        self._say = say
        self._shown: tuple[str, str, str] | None = None
        with self:
            self._shape = Element("span").classes("shape").props('aria-hidden="true"')
            self._word = ui.label().classes("word")

    def show(self, sign: Sign) -> None:
        """Show another state."""
        wanted = (sign.colour, sign.icon, sign.word)
        if wanted != self._shown:
            self._shown = wanted
            self.classes(replace=f"{' '.join(c for c in self._classes if c not in COLOURS)} {sign.colour}")
            self._shape.classes(replace=f"shape {sign.icon}")
            self._word.set_text(self._say(sign.word))


COLOURS = ("green", "red", "amber", "grey")


def panel(title: str, classes: str = "") -> Element:
    """A titled region of a page; use it in a with statement."""
    section = Element("section").classes(f"panel {classes}")
    section._props["aria-label"] = title
    with section, Element("div").classes("panel-head"):
        heading(title, 2)
    return section


def heading(text: str, level: int = 2) -> Element:
    """A heading of the document's outline."""
    element = Element(f"h{level}")
    element._text = text
    return element


@dataclass(frozen=True)
class Column:
    """One column of `Rows`."""

    key: str
    label: str
    is_number: bool = False


class Rows(Element, component="rows.js"):
    """A plain table; a cell is a text or a sign, and only a changed table is sent.

    `on_row` gets the key `id` of a row that is chosen by pointer or keyboard.
    """

    def __init__(
        self, columns: Sequence[Column], caption: str, empty: str, on_row: Callable[[str], Any] | None = None
    ) -> None:
        super().__init__()
        self._props["columns"] = [{"key": c.key, "label": c.label, "number": c.is_number} for c in columns]
        self._props["caption"] = caption
        self._props["empty"] = empty
        self._props["rows"] = []
        self._props["chosen"] = ""
        self._props["can-choose"] = on_row is not None
        if on_row is not None:
            self.on("choose", lambda event: on_row(str(event.args)))

    def show(self, rows: list[dict[str, Any]], chosen: str = "") -> None:
        """Show other rows."""
        if rows != self._props["rows"] or chosen != self._props["chosen"]:
            self._props["rows"], self._props["chosen"] = rows, chosen
            self.update()


def sign_cell(sign: Sign, say: Language) -> dict[str, str]:
    """A sign as a cell of `Rows`."""
    return {"colour": sign.colour, "icon": sign.icon, "word": say(sign.word), "title": sign.detail}
