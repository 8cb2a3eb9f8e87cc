"""The production screen: every product and why it was decided so, the trend of wear, die services, alarms, export."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from typing import Any

from fastapi import FastAPI, HTTPException, Request
from fastapi.responses import StreamingResponse
from nicegui import ui
from nicegui.element import Element

from wearline.errors import BusError
from wearline.messages import Acknowledge, AskRecords, Decision, DieEvent, RecordRow, Records, Verdict
from wearline.topics import ACKNOWLEDGE, DIE_EVENT, RECORDS
from wearline_hmi.core import rights
from wearline_hmi.core.charts import trend_chart
from wearline_hmi.core.language import Language
from wearline_hmi.core.maps import WEAR_MAPS, wear_map_header
from wearline_hmi.core.state import CellState, current_object, trend_of, trends_of
from wearline_hmi.core.table import BOM, csv_lines
from wearline_hmi.core.words import DASH, alarm_sign, code_text, decision_sign, mm_text, ms_text, time_text
from wearline_hmi.pages.frame import Frame, Site
from wearline_hmi.pages.gate import visitor_of
from wearline_hmi.pages.live import Surface
from wearline_hmi.pages.measurement import why_not
from wearline_hmi.pages.parts import (
    Button,
    Choice,
    Column,
    Field,
    Rows,
    Select,
    confirmed,
    panel,
    set_text,
    sign_cell,
    text_element,
)
from wearline_hmi.pages.views import follow_trend, surface_words

PAGE_ROWS = 50
EXPORT_PAGE = 1000
EXPORT_MAX = 1_000_000
DECISIONS = (
    ("", "all"),
    ("PASSED", "PASSED"),
    ("FAILED", "FAILED"),
    ("UNSURE", "UNSURE"),
    ("NOT_MEASURED", "NOT MEASURED"),
)
DIE_KINDS = ("regrind", "polish", "insert", "die_change", "coil_change")
EXPORT_COLUMNS = (
    "record_id", "cycle_id", "utc", "object_index", "part_id", "stroke", "measure_number", "decision", "code", "reason",
    "mean_error_mm", "max_error_mm", "wear_mm", "told_code", "cycle_seconds", "is_simulated",
)  # fmt: skip


def build_production(page: Frame) -> None:
    """The screen ``/production``."""
    with Element("div").classes("grid-production"):
        _products(page)
        with Element("div").classes("area-side stack"):
            _trend(page)
            _wear_map(page)
            _die_service(page)
            _alarms(page)


def record_cells(row: RecordRow, say: Language) -> dict[str, Any]:
    """One product as a row of the table."""
    sign = decision_sign(row.decision.value, row.reason)
    told = row.told_code
    return {
        "id": row.cycle_id,
        "part": row.part_id or DASH,
        "stroke": str(row.stroke),
        "time": f"{row.utc[:10]} {time_text(row.utc)}" if row.utc else DASH,
        "object": str(row.object_index),
        "verdict": sign_cell(sign, say),
        "mean": mm_text(row.mean_error_mm, say=say),
        "max": mm_text(row.max_error_mm, sign=True, say=say),
        "told": DASH if told is None else str(told),
        "cycle": ms_text(None if row.cycle_seconds is None else 1000.0 * row.cycle_seconds),
    }


def _products(page: Frame) -> None:
    say = page.look.say
    pages: list[int | None] = [None]
    """`before` of each page that was turned to; the last one is shown."""

    async def load() -> None:
        wanted = AskRecords(
            last=PAGE_ROWS, search=search.value.strip()[:100], before=pages[-1], with_trends=False,
            decisions=(Decision(decision.value),) if decision.value else (),
        )  # fmt: skip
        answer = await page.ask(RECORDS, wanted)
        if not isinstance(answer, Records):
            return
        rows.show([record_cells(row, say) for row in answer.rows])
        newer.enable(len(pages) > 1)
        older.enable(len(answer.rows) == PAGE_ROWS)
        older.props["data-before"] = answer.rows[-1].record_id if answer.rows else 0
        set_text(count, say("{n} records in all", n=answer.total))

    async def first() -> None:
        pages[:] = [None]
        await load()

    async def turn(is_older: bool) -> None:
        if is_older:
            pages.append(int(older.props["data-before"]))
        elif len(pages) > 1:
            pages.pop()
        await load()

    with panel(say("Products"), "area-products") as box:
        with box.default_slot.children[0]:
            count = text_element("span", "", "age")
        with Element("div").classes("filters"):
            search = Field(
                say("Part or stroke"), kind="search", on_change=page.guarded(rights.LOOK_AT_PRODUCTION, first)
            )
            decision = Select(
                say("Verdict"), [(key, say(text)) for key, text in DECISIONS], "",
                page.guarded(rights.LOOK_AT_PRODUCTION, first),
            )  # fmt: skip
            newer = Button(say("Newer"), page.guarded(rights.LOOK_AT_PRODUCTION, lambda: turn(False)))
            older = Button(say("Older"), page.guarded(rights.LOOK_AT_PRODUCTION, lambda: turn(True)))
            if page.may(rights.EXPORT_PRODUCTION):
                link = text_element("a", say("Export as CSV"), "button")
                link.props["href"] = "/export/production.csv"
                link.props["download"] = "production.csv"
        rows = Rows(
            [
                Column("stroke", say("Stroke"), True), Column("part", say("Part")), Column("time", say("Time (UTC)")),
                Column("object", say("Object"), True), Column("verdict", say("Verdict")),
                Column("mean", say("Mean [mm]"), True), Column("max", say("Max [mm]"), True),
                Column("told", say("Told"), True), Column("cycle", say("Cycle [ms]"), True),
            ],
            say("Products"), say("No product is found"), lambda cycle_id: _show_verdict(page, cycle_id),
        )  # fmt: skip
    newest: list[str] = [""]

    def renew(state: CellState, now_s: float) -> None:
        top = state.strokes[0].cycle_id if state.strokes else ""
        told = str(state.strokes[0].told_code) if state.strokes else ""
        if f"{top} {told}" != newest[0] and len(pages) == 1:
            newest[0] = f"{top} {told}"
            # A moment later judge has recorded what the PLC was told.
            ui.timer(0.7, load, once=True)

    page.renewed_by(renew)
    ui.timer(0.05, load, once=True)


async def _show_verdict(page: Frame, cycle_id: str) -> None:
    """One product in full: the verdict with its reason, figures and references."""
    say = page.look.say
    answer = await page.ask(RECORDS, AskRecords(last=1, cycle_id=cycle_id, with_verdict=True, with_trends=False))
    if not isinstance(answer, Records) or not answer.rows:
        return
    row = answer.rows[0]
    verdict = Verdict.model_validate_json(row.verdict_json) if row.verdict_json else None
    with ui.dialog() as dialog, Element("div").classes("panel dialog detail"):
        text_element("h2", say("Part {part}, stroke {stroke}", part=row.part_id or DASH, stroke=row.stroke))
        sign = decision_sign(row.decision.value)
        with Element("span").classes(f"sign big {sign.colour}"):
            Element("span").classes(f"shape {sign.icon}").props('aria-hidden="true"')
            text_element("span", say(sign.word), "word")
        text_element("p", row.reason or say(code_text(row.code)), "reason")
        with Element("dl").classes("figures"):
            for name, value in verdict_facts(row, verdict, say):
                text_element("dt", say(name))
                text_element("dd", value)
        with Element("div").classes("buttons"):
            Button(say("Close"), dialog.close, "main")
    dialog.on("hide", dialog.delete)
    dialog.open()


def verdict_facts(row: RecordRow, verdict: Verdict | None, say: Language) -> list[tuple[str, str]]:
    """What is known of one product, as names and texts."""
    told = DASH if row.told_code is None else f"{row.told_code} ({say(code_text(row.told_code))})"
    facts = [
        ("Time (UTC)", row.utc or DASH),
        ("Told to the PLC", told),
        ("Mean error", f"{mm_text(row.mean_error_mm, say=say)} mm"),
        ("Largest error", f"{mm_text(row.max_error_mm, sign=True, say=say)} mm"),
        ("Wear", f"{mm_text(row.wear_mm, say=say)} mm"),
        ("Cycle", f"{ms_text(None if row.cycle_seconds is None else 1000 * row.cycle_seconds)} ms"),
    ]
    if verdict is not None:
        pose = verdict.registration
        facts += [
            ("Coverage", say.number(f"{100 * verdict.coverage:.1f} %")),
            ("Position dx, dy, dz", say.number(f"{pose.dx_mm:+.3f}, {pose.dy_mm:+.3f}, {pose.dz_mm:+.3f} mm")),
            ("Tilt x, y", say.number(f"{pose.tilt_x_mrad:+.2f}, {pose.tilt_y_mrad:+.2f} mrad")),
            ("Lines seen", str(verdict.quality.lines_seen)),
            ("Frame", verdict.frame_hash[:16] or DASH),
            ("Calibration", verdict.calibration_hash[:16] or DASH),
            ("Template", verdict.template_hash[:16] or DASH),
            ("Recipe", verdict.recipe_hash[:16] or DASH),
            ("Program", verdict.code_version or DASH),
        ]
    facts.append(("Cycle id", row.cycle_id))
    return facts


def _trend(page: Frame) -> None:
    say, ink = page.look.say, page.look.ink
    with panel(say("Wear trend"), "area-trend"):
        chart = ui.echart(trend_chart(None, ink, say, True)).classes("chart tall")
        chart._props["role"] = "img"
        sentence = ui.label().classes("chart-words")
    follow_trend(page, chart, sentence, can_zoom=True)


def _wear_map(page: Frame) -> None:
    say = page.look.say
    with panel(say("Where parts deviate, and how often"), "area-frequency") as box:
        with box.default_slot.children[0]:
            note = ui.label().classes("age")
        words = {"frequency": say("how often"), "growth": say("growth of wear"), "stroke": say("parts:")}
        surface = Surface({**surface_words(say), **words})
        surface.paint("flat")
        surface.choose("frequency")
        Choice(say("Map"), [(name, words[name]) for name in WEAR_MAPS], "frequency", surface.choose, "wear-map")

    def renew(state: CellState, now_s: float) -> None:
        if state.wear_map is not None and state.wear_map.maps.size:
            scale = None if state.view is None else state.view.mm_per_pixel
            surface.show(wear_map_header(state.wear_map, scale), "wear")
            note.set_text(say("{n} parts since the last service", n=state.wear_map.parts))

    page.renewed_by(renew)


def _die_service(page: Frame) -> None:
    say = page.look.say

    async def log() -> None:
        index = current_object(page.service.snapshot)
        if index is None:
            ui.notify(say("No object is selected."), type="negative")
            return
        question = say("The trend of object {n} begins anew with this service. Log it?", n=index)
        if await confirmed(say, question, say("Log the service")):
            wanted = DieEvent(object_index=index, kind=kind.value, note=note.value.strip()[:200])
            detail = f"object {index}, {kind.value}, {wanted.note}"
            if await page.command(rights.LOG_DIE_SERVICE, DIE_EVENT, wanted, detail):
                note.set("")

    with panel(say("Die services"), "area-die"):
        rows = Rows([Column("stroke", say("Stroke"), True), Column("what", say("What was done"))], say("Die services"),
                    say("No service yet"))  # fmt: skip
        with Element("div").classes("filters"):
            kind = Select(say("Kind"), [(key, say(key)) for key in DIE_KINDS], DIE_KINDS[0])
            note = Field(say("Note"))
            button = Button(say("Log the service"), page.guarded(rights.LOG_DIE_SERVICE, log), "main")
            reason = why_not(page, rights.LOG_DIE_SERVICE)
            button.enable(not reason, reason)

    def renew(state: CellState, now_s: float) -> None:
        trend = trend_of(state)
        events = () if trend is None else trend.die_events
        rows.show(
            [
                {"id": f"{stroke} {what}", "stroke": str(stroke), "what": _die_words(what, say)}
                for stroke, what in reversed(events)
            ]
        )

    page.renewed_by(renew)


def _die_words(what: str, say: Language) -> str:
    kind, _, note = what.partition(":")
    return f"{say(kind)}: {note.strip()}" if note.strip() else say(kind)


def _alarms(page: Frame) -> None:
    say = page.look.say

    async def acknowledge() -> None:
        index = current_object(page.service.snapshot)
        text = reason.value.strip()[:500]
        if index is None or not text:
            ui.notify(say("An acknowledgement says why."), type="negative")
            return
        wanted = Acknowledge(object_index=index, zone=zone.value, reason=text)
        detail = f"object {index}, zone {zone.value or '-'}: {text}"
        if await page.command(rights.ACKNOWLEDGE_ALARM, ACKNOWLEDGE, wanted, detail):
            reason.set("")

    with panel(say("Alarms"), "area-alarms"):
        wear = Rows(
            [
                Column("zone", say("Zone")), Column("level", say("Level")), Column("reason", say("Reason")),
                Column("stroke", say("Stroke"), True), Column("by", say("Acknowledged by")),
            ],
            say("Wear alarms"), say("No alarm"),
        )  # fmt: skip
        with Element("div").classes("filters"):
            zone = Select(say("Zone"), [("", say("whole part"))], "")
            reason = Field(say("Reason"))
            button = Button(say("Acknowledge"), page.guarded(rights.ACKNOWLEDGE_ALARM, acknowledge), "main")
            lack = why_not(page, rights.ACKNOWLEDGE_ALARM)
            button.enable(not lack, lack)
        rows = Rows(
            [Column("time", say("Time (UTC)")), Column("level", say("Level")), Column("text", say("Text"))],
            say("Warnings and errors of the services"), say("No alarm"),
        )  # fmt: skip

    def renew(state: CellState, now_s: float) -> None:
        trends = trends_of(state)
        zone.show([(t.zone, t.zone or say("whole part")) for t in trends] or [("", say("whole part"))], zone.value)
        wear.show(
            [
                {
                    "id": t.zone or "-",
                    "zone": t.zone or say("whole part"),
                    "level": sign_cell(alarm_sign(t), say),
                    "reason": t.alarm_reason,
                    "stroke": str(t.alarm_stroke),
                    "by": f"{t.acknowledged_by}: {t.acknowledged_reason}" if t.acknowledged_by else DASH,
                }
                for t in trends
                if t.alarm_level
            ]
        )
        rows.show(
            [
                {
                    "id": f"{event.utc} {event.service} {event.text}",
                    "time": time_text(event.utc),
                    "level": level_cell(event.level, say),
                    "text": f"{event.service}: {event.text}",
                }
                for event in state.events
                if event.level != "info"
            ][:20]
        )

    page.renewed_by(renew)


def level_cell(level: str, say: Language) -> dict[str, str]:
    """The level of an event as a sign."""
    colour, icon = {"error": ("red", "cross"), "warning": ("amber", "warn")}.get(level, ("grey", "dash"))
    return {"colour": colour, "icon": icon, "word": say(level), "title": ""}


def add_export(app: FastAPI, site: Site) -> None:
    """The route ``/export/production.csv``."""

    @app.get("/export/production.csv", include_in_schema=False)
    async def export(request: Request) -> StreamingResponse:
        """All records, newest first, page by page, so that judge and this process stay free for others."""
        visitor = visitor_of(request)
        if not visitor.may(rights.EXPORT_PRODUCTION):
            raise HTTPException(403, "only administrators export production records")
        accounts = site.keeper.accounts
        await asyncio.to_thread(accounts.note, visitor.name, visitor.address, rights.EXPORT_PRODUCTION.name, "")
        try:
            page = await _records_page(site, None)
        except BusError as error:
            raise HTTPException(503, str(error)) from error

        async def lines(page: Records) -> AsyncIterator[str]:
            yield BOM + csv_lines([EXPORT_COLUMNS])
            written = 0
            while page.rows and written < EXPORT_MAX:
                yield csv_lines([[getattr(row, name) for name in EXPORT_COLUMNS] for row in page.rows])
                written += len(page.rows)
                page = await _records_page(site, page.rows[-1].record_id)

        name = f"wearline-{site.service.cell.cell}-{datetime.now(UTC):%Y%m%d-%H%M}.csv"
        return StreamingResponse(
            lines(page),
            media_type="text/csv; charset=utf-8",
            headers={"Content-Disposition": f'attachment; filename="{name}"', "Cache-Control": "no-store"},
        )


async def _records_page(site: Site, before: int | None) -> Records:
    wanted = AskRecords(last=EXPORT_PAGE, before=before, with_trends=False)
    answer = await asyncio.to_thread(site.service.ask, RECORDS, wanted, "", 5.0)
    if not isinstance(answer, Records):
        raise BusError("answered with something else", "judge/records")
    return answer
