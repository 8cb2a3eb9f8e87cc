"""What several screens show alike: the last part, its maps, the camera picture, the trend."""

from __future__ import annotations

from typing import Any

from nicegui import ui
from nicegui.element import Element

from wearline_hmi.core.charts import trend_chart, trend_sentence
from wearline_hmi.core.language import Language
from wearline_hmi.core.maps import view_header
from wearline_hmi.core.state import CellState, trend_of
from wearline_hmi.core.words import DASH, age_text, mm_text, verdict_sign
from wearline_hmi.pages.frame import Frame
from wearline_hmi.pages.live import Surface
from wearline_hmi.pages.parts import Choice, SignElement, panel, set_text

MAPS = ("standard", "measured", "difference", "error")


def last_part(page: Frame, area: str) -> None:
    """The big panel: what was decided of the last part, and how old that is."""
    say, service = page.look.say, page.service
    with panel(say("Last part"), area), Element("div").classes("verdict") as box:
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


def map_choice(page: Frame, surface: Surface, chosen: str = "difference") -> None:
    """Buttons that choose the map."""
    say = page.look.say
    surface.choose(chosen)
    Choice(say("Map"), [(name, say(name)) for name in MAPS], chosen, surface.choose, "map")


def renew_surface(page: Frame, surface: Surface, note: ui.label) -> None:
    """Follow the newest view."""
    say = page.look.say

    def renew(state: CellState, now_s: float) -> None:
        if state.view is None or state.view_at_s is None:
            return
        surface.show(view_header(state.view))
        note.set_text(age_text(now_s - state.view_at_s, say))

    page.renewed_by(renew)


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
        "line": say("Line"),
    }


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
