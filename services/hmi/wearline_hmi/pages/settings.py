"""The settings screen: the process image as it is on the wire, with its history, and how this server is set."""

from __future__ import annotations

from nicegui.element import Element

from wearline_hmi.core import rights
from wearline_hmi.core.state import CellState
from wearline_hmi.core.words import DASH, STATE_LOST_S, age_text
from wearline_hmi.pages.frame import Frame
from wearline_hmi.pages.parts import Column, Rows, panel, set_text, text_element


def build_settings(page: Frame) -> None:
    """The screen ``/settings``."""
    with Element("div").classes("grid-settings"):
        _signals(page)
        with Element("div").classes("stack"):
            _history(page)
            _link(page)
            if page.may(rights.LOOK_AT_USERS):
                _server(page)


def _signals(page: Frame) -> None:
    say = page.look.say
    with panel(say("Inputs and outputs")) as box:
        with box.default_slot.children[0]:
            age = text_element("span", "", "age")
        rows = Rows(
            [
                Column("direction", say("Direction")), Column("address", say("Address")), Column("type", say("Type")),
                Column("name", say("Signal")), Column("value", say("Value"), True), Column("meaning", say("Meaning")),
            ],
            say("Inputs and outputs"), say("fieldbus has told no process image yet"),
        )  # fmt: skip

    def renew(state: CellState, now_s: float) -> None:
        seen = state.services["fieldbus"]
        is_old = seen.at_s is None or now_s - seen.at_s > STATE_LOST_S or seen.is_alive is False
        set_text(age, age_text(None if seen.at_s is None else now_s - seen.at_s, say))
        rows.show(
            [
                {
                    "id": str(row["name"]),
                    "direction": say("from PLC") if row["direction"] == "request" else say("to PLC"),
                    "address": str(row["address"]),
                    "type": str(row["type"]),
                    "name": str(row["name"]),
                    "value": signal_text(row["value"]),
                    "meaning": str(row["meaning"]),
                    "dim": is_old,
                }
                for row in state.signals
            ]
        )

    page.renewed_by(renew)


def signal_text(value: object) -> str:
    """The value of one signal; bits as 0 and 1, as a PLC programmer reads them."""
    if value is None:
        return DASH
    return str(int(value)) if isinstance(value, bool) else str(value)


def _history(page: Frame) -> None:
    say = page.look.say
    with panel(say("Watched changes")):
        rows = Rows(
            [
                Column("age", say("When")), Column("name", say("Signal")), Column("before", say("Before"), True),
                Column("after", say("After"), True),
            ],
            say("Watched changes"), say("Nothing has changed yet"),
        )  # fmt: skip
        text_element("p", say("Seen once a second; shorter pulses are in the journal of fieldbus."), "hint padded")

    def renew(state: CellState, now_s: float) -> None:
        rows.show(
            [
                {
                    "id": f"{number}",
                    "age": age_text(now_s - change.at_s, say),
                    "name": change.name,
                    "before": change.before,
                    "after": change.after,
                }
                for number, change in enumerate(state.signal_changes[:40])
            ]
        )

    page.renewed_by(renew)


def _link(page: Frame) -> None:
    say = page.look.say
    names = (
        ("profile", "Profile"), ("handshake", "Handshake"), ("not_ready_because", "Not ready because"),
        ("longest_exchange_ms", "Longest exchange [ms]"), ("image_age_s", "Age of the image [s]"),
        ("journal_has_room", "Room for the journal"),
    )  # fmt: skip
    with panel(say("Link to the PLC")), Element("dl").classes("figures padded"):
        figures = {}
        for key, name in names:
            text_element("dt", say(name))
            figures[key] = Element("dd")

    def renew(state: CellState, now_s: float) -> None:
        seen = state.services["fieldbus"]
        is_known = seen.state is not None and seen.at_s is not None and now_s - seen.at_s <= STATE_LOST_S
        values = seen.state.values if seen.state is not None and is_known else {}
        for key, element in figures.items():
            value = values.get(key)
            text = say("yes") if value is True else say("no") if value is False else str(value or DASH)
            set_text(element, text)

    page.renewed_by(renew)


def _server(page: Frame) -> None:
    """What cell.yaml says of this server; it is changed there."""
    say, settings = page.look.say, page.service.settings
    rows = (
        ("Looking without a login", say("yes") if settings.view_without_login else say("no")),
        ("Login ends when idle [min]", f"{settings.idle_minutes:g}"),
        ("Login ends after [h]", f"{settings.session_hours:g}"),
        ("Encrypted (TLS)", say("yes") if settings.tls_certificate is not None else say("no")),
        ("A verdict is old after [s]", f"{settings.stale_after_s:g}"),
    )
    with panel(say("This server (set in cell.yaml)")), Element("dl").classes("figures padded"):
        for name, value in rows:
            text_element("dt", say(name))
            text_element("dd", value)
