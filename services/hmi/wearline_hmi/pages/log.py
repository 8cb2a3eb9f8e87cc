"""The log screen: what happened in the cell, and for administrators who did what."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime

from fastapi import FastAPI, HTTPException, Request
from fastapi.responses import Response
from nicegui import ui
from nicegui.element import Element

from wearline.messages import Event
from wearline.topics import SERVICES
from wearline_hmi.core import rights
from wearline_hmi.core.state import CellState
from wearline_hmi.core.table import BOM, csv_lines
from wearline_hmi.core.words import DASH, time_text
from wearline_hmi.pages.frame import Frame, Site
from wearline_hmi.pages.gate import visitor_of
from wearline_hmi.pages.parts import Column, Field, Rows, Select, panel, text_element
from wearline_hmi.pages.production import level_cell

SHOWN = 300
EXPORTED = 50_000
LEVELS = {"": (), "warning": ("warning", "error"), "error": ("error",)}


def build_log(page: Frame) -> None:
    """The screen ``/log``."""
    say, event_log = page.look.say, page.service.event_log

    async def load() -> None:
        found: list[Event] = []
        if event_log is not None:
            found = await asyncio.to_thread(
                event_log.find, search.value.strip()[:100], LEVELS[level.value], service.value, SHOWN
            )
        rows.show(
            [
                {
                    "id": f"{event.utc} {event.service} {event.text}",
                    "time": f"{event.utc[:10]} {time_text(event.utc)}",
                    "level": level_cell(event.level, say),
                    "service": event.service,
                    "text": event.text,
                    "cycle": event.cycle_id or DASH,
                }
                for event in found
            ]
        )

    with Element("div").classes("grid-log"):
        with panel(say("Events")):
            with Element("div").classes("filters"):
                look = page.guarded(rights.LOOK_AT_LOG, load)
                search = Field(say("Text or cycle"), kind="search", on_change=look)
                level = Select(
                    say("Level"),
                    [("", say("all")), ("warning", say("warnings and errors")), ("error", say("errors"))], "", look,
                )  # fmt: skip
                service = Select(say("Service"), [("", say("all")), *((name, name) for name in SERVICES)], "", look)
                if page.may(rights.EXPORT_LOG):
                    link = text_element("a", say("Export as CSV"), "button")
                    link.props["href"] = "/export/log.csv"
                    link.props["download"] = "log.csv"
            rows = Rows(
                [
                    Column("time", say("Time (UTC)")), Column("level", say("Level")), Column("service", say("Service")),
                    Column("text", say("Text")), Column("cycle", say("Cycle id")),
                ],
                say("Events"), say("No event is found"),
            )  # fmt: skip
        if page.may(rights.MANAGE_USERS):
            _audit(page)
    newest: list[object] = [None]

    def renew(state: CellState, now_s: float) -> None:
        top = state.events[0] if state.events else None
        if top is not newest[0]:
            newest[0] = top
            ui.timer(0.05, load, once=True)

    page.renewed_by(renew)
    ui.timer(0.05, load, once=True)


def _audit(page: Frame) -> None:
    say, accounts = page.look.say, page.site.keeper.accounts

    async def load() -> None:
        found = await asyncio.to_thread(accounts.audit, SHOWN, search.value.strip()[:100])
        rows.show(
            [
                {
                    "id": str(entry.number),
                    "time": f"{entry.utc[:10]} {time_text(entry.utc)}",
                    "user": entry.user,
                    "address": entry.address,
                    "deed": say(entry.deed),
                    "detail": entry.detail or DASH,
                }
                for entry in found
            ]
        )

    with panel(say("Who did what")):
        with Element("div").classes("filters"):
            search = Field(say("User or deed"), kind="search", on_change=page.guarded(rights.MANAGE_USERS, load))
        rows = Rows(
            [
                Column("time", say("Time (UTC)")), Column("user", say("User")), Column("address", say("From")),
                Column("deed", say("Deed")), Column("detail", say("Detail")),
            ],
            say("Who did what"), say("Nothing is found"),
        )  # fmt: skip
    ui.timer(0.05, load, once=True)


def add_log_export(app: FastAPI, site: Site) -> None:
    """The route ``/export/log.csv``."""

    @app.get("/export/log.csv", include_in_schema=False)
    async def export(request: Request) -> Response:
        visitor = visitor_of(request)
        if not visitor.may(rights.EXPORT_LOG):
            raise HTTPException(403, "only maintenance and administrators export the log")
        accounts, event_log = site.keeper.accounts, site.service.event_log
        await asyncio.to_thread(accounts.note, visitor.name, visitor.address, rights.EXPORT_LOG.name, "")
        found = [] if event_log is None else await asyncio.to_thread(event_log.find, last=EXPORTED)
        lines = csv_lines([(e.utc, e.service, e.level, e.text, e.cycle_id) for e in found])
        name = f"wearline-{site.service.cell.cell}-log-{datetime.now(UTC):%Y%m%d-%H%M}.csv"
        return Response(
            BOM + csv_lines([("utc", "service", "level", "text", "cycle_id")]) + lines,
            media_type="text/csv; charset=utf-8",
            headers={"Content-Disposition": f'attachment; filename="{name}"', "Cache-Control": "no-store"},
        )
