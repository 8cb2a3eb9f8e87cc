"""The first screen: everything about the cell at a glance."""

from __future__ import annotations

from typing import Any

from nicegui import ui
from nicegui.element import Element

from wearline.topics import SERVICES
from wearline_hmi.core.charts import trend_chart, trend_sentence
from wearline_hmi.core.language import Language
from wearline_hmi.core.maps import view_header
from wearline_hmi.core.state import CellState, trend_of
from wearline_hmi.core.words import (
    DASH,
    PREVIEW_STALE_S,
    age_text,
    mm_text,
    ms_text,
    service_sign,
    stroke_sign,
    time_text,
    verdict_sign,
)
from wearline_hmi.pages.frame import Frame
from wearline_hmi.pages.live import LivePicture, Surface
from wearline_hmi.pages.parts import Column, Rows, SignElement, panel, sign_cell

MAPS = ("standard", "measured", "difference", "error")
STROKE_COLUMNS = (
    ("stroke", "Stroke", True),
    ("time", "Time (UTC)", False),
    ("part", "Part", False),
    ("verdict", "Verdict", False),
    ("mean", "Mean [mm]", True),
    ("max", "Max [mm]", True),
    ("cycle", "Cycle [ms]", True),
)


def build_overview(page: Frame) -> None:
    """The screen ``/``."""
    with Element("div").classes("grid-overview"):
        _verdict(page)
        _maps(page)
        _picture(page)
        _strokes(page)
        _trend(page)
        _services(page)


def _verdict(page: Frame) -> None:
    say, service = page.look.say, page.service
    with panel(say("Last part"), "area-verdict"), Element("div").classes("verdict") as box:
        sign = SignElement(say, "big")
        detail = ui.label().classes("verdict-detail").props('role="status"')
        with Element("dl").classes("figures"):
            figures = {}
            for key, name in (
                ("stroke", "Stroke"), ("part", "Part"), ("mean", "Mean error"), ("max", "Largest error"),
                ("wear", "Wear"), ("coverage", "Coverage"),
            ):  # fmt: skip
                term = Element("dt")
                term._text = say(name)
                figures[key] = Element("dd")
        with Element("div").classes("verdict-foot"):
            old = ui.label(say("OLD")).classes("old-mark")
            age = ui.label()
            told = ui.label()

    def renew(state: CellState, now_s: float) -> None:
        shown = verdict_sign(state, now_s, service.settings.stale_after_s, say)
        sign.show(shown.sign)
        detail.set_text(shown.sign.detail)
        age.set_text(shown.age)
        old.set_visibility(shown.is_stale and state.verdict is not None)
        box.classes(add="old" if shown.is_stale else "", remove="" if shown.is_stale else "old")
        verdict = state.verdict
        told.set_text(
            "" if verdict is None else say("told to the PLC") if shown.is_told else say("not yet told to the PLC")
        )
        texts = dict.fromkeys(figures, DASH)
        if verdict is not None:
            texts = {
                "stroke": str(verdict.request.stroke),
                "part": verdict.request.part_id or DASH,
                "mean": f"{mm_text(verdict.mean_error_mm, say=say)} mm",
                "max": f"{mm_text(verdict.max_error_mm, sign=True, say=say)} mm",
                "wear": f"{mm_text(verdict.wear_mm, say=say)} mm",
                "coverage": say.number(f"{100 * verdict.coverage:.1f} %"),
            }
        for key, text in texts.items():
            set_text(figures[key], text)

    page.renewed_by(renew)


def set_text(element: Element, text: str) -> None:
    """Change a plain element's text, if it differs."""
    if element._text != text:
        element._text = text
        element.update()


def surface_words(say: Language) -> dict[str, str]:
    """What the picture of a map says."""
    return {
        "waiting": say("The maps come with the next stroke"),
        "no_webgl": say("This browser cannot draw in three dimensions (WebGL 2 is missing)"),
        "not_loaded": say("The maps could not be loaded"),
        "stroke": say("stroke"),
        "relief": say("heights"),
        "length": say("length"),
        "rise": say("height difference"),
        "keys": say("Arrow keys turn, plus and minus zoom, Home resets."),
        "point": say.decimal_point,
        **{name: say(name) for name in MAPS},
    }


def map_choice(page: Frame, surface: Surface, chosen: str = "difference") -> dict[str, Element]:
    """Buttons that choose the map."""
    buttons: dict[str, Element] = {}

    def choose(name: str) -> None:
        surface.choose(name)
        for key, button in buttons.items():
            button._props["aria-pressed"] = str(key == name).lower()
            button.update()

    with Element("div").classes("choice").props('role="group"') as group:
        group._props["aria-label"] = page.look.say("Map")
        for name in MAPS:
            button = Element("button").props('type="button"')
            button._text = page.look.say(name)
            button._props["data-map"] = name
            button._props["aria-pressed"] = str(name == chosen).lower()
            button.on("click", lambda name=name: choose(name))
            buttons[name] = button
    surface.choose(chosen)
    return buttons


def renew_surface(page: Frame, surface: Surface, note: ui.label) -> None:
    """Follow the newest view."""
    say = page.look.say

    def renew(state: CellState, now_s: float) -> None:
        if state.view is None or state.view_at_s is None:
            return
        surface.show(view_header(state.view), state.view)
        note.set_text(age_text(now_s - state.view_at_s, say))

    page.renewed_by(renew)


def _maps(page: Frame) -> None:
    say = page.look.say
    with panel(say("Maps"), "area-maps") as box:
        with box.default_slot.children[0]:
            note = ui.label().classes("age")
        surface = Surface(surface_words(say))
        map_choice(page, surface)
    renew_surface(page, surface, note)


def picture_words(say: Language) -> dict[str, str]:
    """What the camera picture says."""
    return {
        "waiting": say("No picture yet"),
        "lost": say("connection lost"),
        "silent": say("camera silent"),
        "now": say("just now"),
        "seconds": say("{n} s ago"),
        "minutes": say("{n} min ago"),
        "picture": say("Camera picture"),
    }


def _picture(page: Frame) -> None:
    say = page.look.say
    with panel(say("Camera"), "area-picture"):
        LivePicture(picture_words(say), PREVIEW_STALE_S)


def _strokes(page: Frame) -> None:
    say, service = page.look.say, page.service
    with panel(say("Last strokes"), "area-strokes"):
        rows = Rows(
            [Column(key, say(label), is_number) for key, label, is_number in STROKE_COLUMNS],
            say("Last strokes"),
            say("No stroke yet"),
        )

    def renew(state: CellState, now_s: float) -> None:
        rows.show(
            [
                {
                    "id": row.cycle_id,
                    "stroke": str(row.stroke),
                    "time": time_text(row.utc),
                    "part": row.part_id or DASH,
                    "verdict": sign_cell(stroke_sign(row, say), say),
                    "mean": mm_text(row.mean_mm, say=say),
                    "max": mm_text(row.max_mm, sign=True, say=say),
                    "cycle": ms_text(row.cycle_ms),
                }
                for row in state.strokes[: service.settings.strokes_shown]
            ]
        )

    page.renewed_by(renew)


def _trend(page: Frame) -> None:
    say, ink = page.look.say, page.look.ink
    with panel(say("Wear trend"), "area-trend"):
        chart = ui.echart(trend_chart(None, ink, say)).classes("chart")
        chart._props["role"] = "img"
        sentence = ui.label().classes("chart-words")
    follow_trend(page, chart, sentence)


def follow_trend(page: Frame, chart: ui.echart, sentence: ui.label, can_zoom: bool = False) -> None:
    """Renew a trend chart when judge says something else."""
    say, ink = page.look.say, page.look.ink
    shown: list[Any] = [None]

    def renew(state: CellState, now_s: float) -> None:
        trend = trend_of(state)
        if trend == shown[0] and sentence.text:
            return
        shown[0] = trend
        words = trend_sentence(trend, say)
        chart._props["aria-label"] = words
        chart.options.clear()
        chart.options.update(trend_chart(trend, ink, say, can_zoom))
        sentence.set_text(words)

    page.renewed_by(renew)


def _services(page: Frame) -> None:
    say = page.look.say
    with panel(say("Services"), "area-services"):
        rows = Rows(
            [Column("name", say("Service")), Column("state", say("State")), Column("age", say("Heard"))],
            say("Services"),
            DASH,
        )
        with Element("div").classes("service-foot"):
            records = ui.label()

    def renew(state: CellState, now_s: float) -> None:
        table = []
        for name in SERVICES:
            seen = state.services[name]
            sign = service_sign(seen, now_s, say)
            detail = "" if seen.state is None else seen.state.detail
            table.append(
                {"id": name, "name": name, "state": {**sign_cell(sign, say), "title": detail}, "age": sign.detail}
            )
        rows.show(table)
        age_s = None if state.records_at_s is None else now_s - state.records_at_s
        records.set_text(say("Records and trend: {age}", age=age_text(age_s, say)))

    page.renewed_by(renew)
