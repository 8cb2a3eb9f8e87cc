"""What every screen has: the cell at a glance, the way to the other screens, the user, language and theme.

Rights are looked up at every event, not only when the page was loaded: an open tab outlives its login.
"""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from fastapi import Request
from fastapi.responses import Response
from nicegui import ui
from nicegui.element import Element

from wearline.errors import BusError
from wearline.messages import Done, Message
from wearline.topics import SERVICES, Query
from wearline_hmi.core import state as cell_state
from wearline_hmi.core.language import LANGUAGES
from wearline_hmi.core.rights import Deed
from wearline_hmi.core.state import CellState
from wearline_hmi.core.words import Sign, header_words, pass_rate_text, service_sign, verdict_sign, wear_sign
from wearline_hmi.pages.gate import Door, Doorkeeper, Visitor, door_page, visitor_of
from wearline_hmi.pages.parts import Look, SignElement, heading
from wearline_hmi.service import HmiService

REFRESH_S = 0.5
SESSION_LOOK_TURNS = 4
NOT_ALLOWED = "You are not allowed to do this."


@dataclass
class Screen:
    """One entry of the menu."""

    path: str
    title: str
    deed: Deed
    build: Callable[[Frame], None]


@dataclass
class Site:
    """What all pages of one web server share."""

    service: HmiService
    keeper: Doorkeeper
    screens: list[Screen] = field(default_factory=list)
    asking: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(2))
    """However many look, no service is asked more than two things at once by browsers."""

    def add(self, path: str, title: str, deed: Deed, build: Callable[[Frame], None]) -> None:
        """Make a screen; the menu shows it to those who may see it."""
        screen = Screen(path, title, deed, build)
        self.screens.append(screen)

        @ui.page(path)
        def page(request: Request) -> Response | None:
            look, visitor = Look(request), visitor_of(request)
            if not visitor.may(deed):
                door = Door(title, "Your account does not show this screen.", (), "Other account", "/logout")
                return door_page(door, look, self.service.snapshot.cell, 403)
            Frame(self, look, visitor).show(screen)
            return None


@dataclass
class Frame:
    """One open page: its cell, look and visitor, and what is renewed as time goes by."""

    site: Site
    look: Look
    visitor: Visitor
    renewals: list[Callable[[CellState, float], None]] = field(default_factory=list)
    _turn: int = 0
    _timer: ui.timer | None = None

    @property
    def service(self) -> HmiService:
        return self.site.service

    def show(self, screen: Screen) -> None:
        """Build the page."""
        say = self.look.say
        ui.page_title(f"{say(screen.title)} · {self.service.snapshot.cell}")
        ui.add_head_html('<link rel="stylesheet" href="/static/wearline.css">')
        ui.query("html").props(f'lang="{say.code}"')
        ui.dark_mode(self.look.is_dark)
        ui.colors(primary="#0b5cad")
        with Element("header").classes("top"):
            _glance(self)
            _menu(self, screen)
        # The framework's page is the main landmark already.
        with Element("div").classes("screen").props('tabindex="-1"') as content:
            screen.build(self)
        ui.skip_link(say("Skip to content"), target=content)
        self._renew()
        self._timer = ui.timer(REFRESH_S, self._renew)

    def renewed_by(self, renew: Callable[[CellState, float], None]) -> None:
        """Call `renew(snapshot, now_s)` at once and then about twice a second."""
        self.renewals.append(renew)

    def _renew(self) -> None:
        self._turn += 1
        if self._turn % SESSION_LOOK_TURNS == 0:
            now = self.site.keeper.again(self.visitor, is_active=False)
            if now is None or now.role is not self.visitor.role:
                # A tab that nobody may look at any more is told nothing more.
                if self._timer is not None:
                    self._timer.cancel()
                ui.navigate.to("/login" if now is None else ui.context.client.page.path)
                return
        state, now_s = self.service.snapshot, self.service.clock()
        for renew in self.renewals:
            renew(state, now_s)

    def may(self, deed: Deed) -> bool:
        """Whether to offer it; `guarded` decides whether it is done."""
        return self.visitor.may(deed)

    def guarded(self, deed: Deed, handler: Callable[..., Any]) -> Callable[[Any], Awaitable[None]]:
        """An event handler that obeys only who may do this at this very moment."""
        has_argument = bool(inspect.signature(handler).parameters)

        async def check(event: Any) -> None:
            now = self.site.keeper.again(self.visitor, is_active=True)
            if now is None:
                ui.navigate.to("/login")
                return
            if not now.may(deed) or now.must_change:
                await self.note(deed.name, "refused")
                ui.notify(self.look.say(NOT_ALLOWED), type="negative")
                return
            result = handler(event) if has_argument else handler()
            if inspect.isawaitable(result):
                await result

        return check

    async def note(self, deed: str, detail: str) -> None:
        """A line of the audit log."""
        visitor = self.visitor
        await asyncio.to_thread(
            self.site.keeper.accounts.note, visitor.name or visitor.role.value, visitor.address, deed, detail
        )

    async def ask(self, query: Query, question: Message, argument: str = "", timeout_s: float = 2.0) -> Message | None:
        """Another service's answer; None and a notice where there is none."""
        try:
            async with self.site.asking:
                return await asyncio.to_thread(self.service.ask, query, question, argument, timeout_s)
        except BusError as error:
            ui.notify(str(error), type="negative", multi_line=True)
            return None

    async def command(self, deed: Deed, query: Query, question: Message, detail: str, timeout_s: float = 5.0) -> bool:
        """Ask for something to be done, on behalf of this visitor; what came of it is noted and told."""
        named = question.replace(user=self.visitor.name)
        answer = await self.ask(query, named, timeout_s=timeout_s)
        is_done = isinstance(answer, Done) and answer.ok
        text = answer.text if isinstance(answer, Done) else ""
        outcome = "done" if is_done else f"refused: {text}" if answer is not None else "no answer"
        await self.note(deed.name, f"{detail}: {outcome}" if detail else outcome)
        if answer is not None:
            ui.notify(text or self.look.say("Done."), type="positive" if is_done else "negative", multi_line=True)
        return is_done


def _glance(page: Frame) -> None:
    """The line at the top: is the cell well, and how sure is that."""
    say = page.look.say
    with Element("div").classes("glance"):
        heading(page.service.snapshot.cell, 1)
        simulated = ui.label(say("SIMULATED")).classes("simulated")
        facts = {}
        titles = (
            ("ready", "Cell"), ("mode", "Mode"), ("plc", "PLC"), ("verdict", "Last verdict"), ("wear", "Wear alarm"),
        )  # fmt: skip
        for key, title in titles:
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
        ui.space()
        _user(page)

    def renew(state: CellState, now_s: float) -> None:
        header = header_words(state, now_s)
        facts["ready"].show(header.ready)
        facts["mode"].show(header.mode)
        facts["plc"].show(header.plc)
        facts["verdict"].show(verdict_sign(state, now_s, page.service.settings.stale_after_s).sign)
        facts["wear"].show(wear_sign(state, now_s))
        texts["object"].set_text(header.object_text)
        texts["rate"].set_text(pass_rate_text(state, say))
        services.show(services_sign(state, now_s))
        simulated.set_visibility(cell_state.is_simulated(state))

    page.renewed_by(renew)


def _user(page: Frame) -> None:
    say, visitor = page.look.say, page.visitor
    with Element("div").classes("user"):
        if not visitor.session:
            ui.label(say("Looking only")).classes("user-name")
            link(say("Log in"), "/login", "button")
            return
        with Element("div").classes("fact"):
            ui.label(say(visitor.role.value)).classes("fact-name")
            link(visitor.name, "/password", "user-name").props["title"] = say("Change the password")
        with Element("form").props('method="post" action="/logout"'):
            button = Element("button").props('type="submit"')
            button._text = say("Log out")


def link(text: str, target: str, classes: str = "") -> Element:
    """A plain link."""
    element = Element("a").classes(classes)
    element._props["href"] = target
    element._text = text
    return element


def services_sign(state: CellState, now_s: float) -> Sign:
    """All services in one word: the worst of them rules."""
    signs = {name: service_sign(state.services[name], now_s) for name in SERVICES}
    for colour, icon in (("red", "cross"), ("amber", "warn"), ("grey", "dash")):
        names = [name for name, sign in signs.items() if sign.colour == colour]
        if names:
            return Sign(colour, icon, ", ".join(names))
    return Sign("green", "check", "all well")


def _menu(page: Frame, shown: Screen) -> None:
    say, look = page.look.say, page.look
    with Element("nav").classes("menu") as nav:
        nav._props["aria-label"] = say("Screens")
        for screen in page.site.screens:
            if page.may(screen.deed):
                entry = link(say(screen.title), screen.path)
                if screen is shown:
                    entry.props('aria-current="page"')
        ui.space()
        with Element("div").classes("look"):
            for code, language in LANGUAGES.items():
                button = Element("button").props(f'type="button" lang="{code}"').classes("quiet")
                button._text = language.name
                button._props["aria-pressed"] = str(code == say.code).lower()
                button.on("click", lambda code=code: ui.run_javascript(look.script(code=code)))
            theme = "light" if look.is_dark else "dark"
            button = Element("button").props('type="button"').classes("quiet theme")
            button._text = say("Light") if look.is_dark else say("Dark")
            button.on("click", lambda: ui.run_javascript(look.script(theme=theme)))
