"""What every screen has: the cell at a glance, the way to the other screens, language and theme."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from fastapi import Request
from nicegui import ui
from nicegui.element import Element

from wearline.topics import SERVICES
from wearline_hmi.core import state as cell_state
from wearline_hmi.core.language import LANGUAGES
from wearline_hmi.core.state import CellState
from wearline_hmi.core.words import Sign, header_words, pass_rate_text, service_sign, verdict_sign
from wearline_hmi.pages.parts import Look, SignElement, heading
from wearline_hmi.service import HmiService

REFRESH_S = 0.5
SCREENS = (("/", "Overview"),)


@dataclass
class Frame:
    """One open page: its cell, its look, and what is renewed as time goes by."""

    service: HmiService
    look: Look
    renewals: list[Callable[[CellState, float], None]]

    def renewed_by(self, renew: Callable[[CellState, float], None]) -> None:
        """Call `renew(snapshot, now_s)` at once and then about twice a second."""
        self.renewals.append(renew)

    def renew(self) -> None:
        """One turn."""
        state, now_s = self.service.snapshot, self.service.clock()
        for renew in self.renewals:
            renew(state, now_s)


@contextmanager
def frame(service: HmiService, request: Request, path: str) -> Iterator[Frame]:
    """Build a page inside the frame."""
    look = Look(request)
    say = look.say
    name = dict(SCREENS)[path]
    ui.page_title(f"{say(name)} · {service.snapshot.cell}")
    ui.add_head_html('<link rel="stylesheet" href="/static/wearline.css">')
    ui.dark_mode(look.is_dark if look.theme else None)
    built = Frame(service, look, [])
    with Element("header").classes("top"):
        _glance(built)
        _menu(built, path)
    with Element("main").classes("screen").props('id="content" tabindex="-1"') as main:
        yield built
    ui.skip_link(say("Skip to content"), target=main)
    built.renew()
    ui.timer(REFRESH_S, built.renew)


def _glance(built: Frame) -> None:
    """The line at the top: is the cell well, and how sure is that."""
    say = built.look.say
    with Element("div").classes("glance"):
        cell = heading(built.service.snapshot.cell, 1)
        simulated = ui.label(say("SIMULATED")).classes("simulated")
        facts = {}
        for key, title in (("ready", "Cell"), ("mode", "Mode"), ("plc", "PLC"), ("verdict", "Last verdict")):
            with Element("div").classes(f"fact fact-{key}"):
                ui.label(say(title)).classes("fact-name")
                facts[key] = SignElement(say)
        texts = {}
        for key, title in (("object", "Object"), ("rate", "Pass rate")):
            with Element("div").classes("fact"):
                ui.label(say(title)).classes("fact-name")
                texts[key] = ui.label().classes("fact-text")
        with Element("div").classes("fact fact-services"):
            ui.label(say("Services")).classes("fact-name")
            services = SignElement(say)
    del cell

    def renew(state: CellState, now_s: float) -> None:
        header = header_words(state, now_s)
        facts["ready"].show(header.ready)
        facts["mode"].show(header.mode)
        facts["plc"].show(header.plc)
        facts["verdict"].show(verdict_sign(state, now_s, built.service.settings.stale_after_s).sign)
        texts["object"].set_text(header.object_text)
        texts["rate"].set_text(pass_rate_text(state, say))
        services.show(services_sign(state, now_s))
        simulated.set_visibility(cell_state.is_simulated(state))

    built.renewed_by(renew)


def services_sign(state: CellState, now_s: float) -> Sign:
    """All services in one word: the worst of them rules."""
    signs = {name: service_sign(state.services[name], now_s) for name in SERVICES}
    for colour, icon in (("red", "cross"), ("amber", "warn"), ("grey", "dash")):
        names = [name for name, sign in signs.items() if sign.colour == colour]
        if names:
            return Sign(colour, icon, ", ".join(names))
    return Sign("green", "check", "all well")


def _menu(built: Frame, path: str) -> None:
    say, look = built.look.say, built.look
    with Element("nav").classes("menu") as nav:
        nav._props["aria-label"] = say("Screens")
        for target, name in SCREENS:
            link = Element("a").props(f'href="{target}"')
            link._text = say(name)
            if target == path:
                link.props('aria-current="page"')
        ui.space()
        with ui.element("div").classes("look"):
            for code, language in LANGUAGES.items():
                button = Element("button").props(f'type="button" lang="{code}"').classes("quiet")
                button._text = language.name
                button._props["aria-pressed"] = str(code == say.code).lower()
                button.on("click", lambda code=code: ui.run_javascript(look.script(code=code)))
            theme = "light" if look.is_dark else "dark"
            button = Element("button").props('type="button"').classes("quiet")
            button._text = say("Light") if look.is_dark else say("Dark")
            button.on("click", lambda: ui.run_javascript(look.script(theme=theme)))
