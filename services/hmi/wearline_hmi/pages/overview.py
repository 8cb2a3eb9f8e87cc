"""The first screen: everything about the cell at a glance."""

from __future__ import annotations

from nicegui import ui
from nicegui.element import Element

from wearline.topics import SERVICES
from wearline_hmi.core.charts import trend_chart
from wearline_hmi.core.state import CellState
from wearline_hmi.core.words import (
    DASH,
    PREVIEW_STALE_S,
    age_text,
    mm_text,
    ms_text,
    service_sign,
    stroke_sign,
    time_text,
)
from wearline_hmi.pages.frame import Frame
from wearline_hmi.pages.live import LivePicture, Surface
from wearline_hmi.pages.parts import Column, Rows, panel, sign_cell
from wearline_hmi.pages.views import follow_trend, last_part, map_choice, picture_words, renew_surface, surface_words

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
        last_part(page, "area-verdict")
        _maps(page)
        _picture(page)
        _strokes(page)
        _trend(page)
        _services(page)


def _maps(page: Frame) -> None:
    say = page.look.say
    with panel(say("Maps"), "area-maps") as box:
        with box.default_slot.children[0]:
            note = ui.label().classes("age")
        surface = Surface(surface_words(say))
        map_choice(page, surface)
    renew_surface(page, surface, note)


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
