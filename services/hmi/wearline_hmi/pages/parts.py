"""Small elements that several pages are made of."""

from __future__ import annotations

import itertools
import json
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
        if self._props.get("title", "") != sign.detail:
            self._props["title"] = sign.detail
            self.update()


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


def set_text(element: Element, text: str) -> None:
    """Change a plain element's text, if it differs."""
    if element._text != text:
        element._text = text
        element.update()


def text_element(tag: str, text: str, classes: str = "") -> Element:
    """A plain element with a text."""
    element = Element(tag).classes(classes)
    element._text = text
    return element


class Button(Element):
    """A plain button."""

    def __init__(self, text: str, on_click: Callable[..., Any] | None = None, classes: str = "") -> None:
        super().__init__("button")
        self._props["type"] = "button"
        self.classes(classes)
        self._text = text
        if on_click is not None:
            self.on("click", on_click)

    def enable(self, is_enabled: bool, why_not: str = "") -> None:
        """Whether it can be pressed, and why not."""
        if self._props.get("disabled", False) is is_enabled or self._props.get("title", "") != why_not:
            self._props["disabled"] = not is_enabled
            self._props["title"] = why_not
            self.update()

    def press(self, is_pressed: bool) -> None:
        """Show it as one of several that is chosen."""
        wanted = str(is_pressed).lower()
        if self._props.get("aria-pressed") != wanted:
            self._props["aria-pressed"] = wanted
            self.update()


class Choice:
    """A row of buttons of which one is chosen."""

    def __init__(
        self, label: str, options: Sequence[tuple[str, str]], chosen: str, on_choose: Callable[[str], Any], data: str
    ) -> None:
        self._on_choose = on_choose
        self.chosen = chosen
        self.buttons: dict[str, Button] = {}
        with Element("div").classes("choice").props('role="group"') as group:
            group._props["aria-label"] = label
            for key, text in options:
                self.buttons[key] = button = Button(text, lambda key=key: self.choose(key))
                button._props[f"data-{data}"] = key
                button.press(key == chosen)

    def choose(self, key: str) -> Any:
        """Choose one and say so."""
        self.show(key)
        return self._on_choose(key)

    def show(self, key: str) -> None:
        """Choose one in silence."""
        self.chosen = key
        for name, button in self.buttons.items():
            button.press(name == key)


_numbers = itertools.count(1)


class Field(Element):
    """A labelled input; `value` follows what is typed."""

    def __init__(
        self,
        label: str,
        kind: str = "text",
        on_change: Callable[..., Any] | None = None,
        complete: str = "off",
        **props: Any,
    ) -> None:
        super().__init__("div")
        self.classes("field")
        self.value = ""
        self._name = name = f"field-{next(_numbers)}"
        with self:
            text_element("label", label)._props["for"] = name
            self.box = Element("input")
            # Without a `value`: Vue would write it over what somebody types, whenever anything is drawn anew.
            self.box._props.update({"id": name, "type": kind, "autocomplete": complete, "maxlength": 300, **props})
            self.box.on("input", self._take, js_handler="(event) => emit({value: event.target.value})")
            if on_change is not None:
                self.box.on("change", on_change)
                # Emptying it by its own button, or Enter without another text, is no change.
                self.box.on("search", on_change)

    def _take(self, event: Any) -> None:
        self.value = str(event.args["value"])

    def set(self, value: str) -> None:
        """Write something into it."""
        self.value = value
        self.client.run_javascript(f"document.getElementById('{self._name}').value = {json.dumps(value)}")


class Select(Element):
    """A labelled choice from a list; `value` is the key of what is chosen."""

    def __init__(
        self,
        label: str,
        options: Sequence[tuple[str, str]],
        value: str = "",
        on_change: Callable[..., Any] | None = None,
    ) -> None:
        super().__init__("div")
        self.classes("field")
        self._on_change = on_change
        self.value = value
        self._options: list[tuple[str, str]] = []
        name = f"field-{next(_numbers)}"
        with self:
            text_element("label", label)._props["for"] = name
            self.box = Element("select")
            self.box._props["id"] = name
            self.box.on("change", self._take, js_handler="(event) => emit({value: event.target.value})")
        self.show(options, value)

    def _take(self, event: Any) -> Any:
        self.value = str(event.args["value"])
        self.box._props["value"] = self.value
        self.box.update()
        return None if self._on_change is None else self._on_change(self.value)

    def show(self, options: Sequence[tuple[str, str]], value: str) -> None:
        """Other options, or another one chosen."""
        if list(options) != self._options or value != self.box._props.get("value"):
            self._options, self.value = list(options), value
            self.box.clear()
            with self.box:
                for key, text in options:
                    option = text_element("option", text)
                    option._props["value"] = key
                    option._props["selected"] = key == value
            self.box._props["value"] = value
            self.box.update()


async def confirmed(say: Language, question: str, yes: str) -> bool:
    """Whether a person says yes."""
    with ui.dialog() as dialog, Element("div").classes("panel dialog"):
        text_element("p", question)
        with Element("div").classes("buttons"):
            Button(say("Cancel"), lambda: dialog.submit(False))
            Button(yes, lambda: dialog.submit(True), "main")
    try:
        return await dialog is True
    finally:
        dialog.delete()
