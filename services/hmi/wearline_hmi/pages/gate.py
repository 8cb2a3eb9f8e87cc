"""Who comes in: sessions, logging in and out, the first administrator, the own password.

These few pages are plain HTML without any script, so that logging in works before everything else.
"""

from __future__ import annotations

import asyncio
import html
import logging
import secrets
from collections.abc import Callable
from dataclasses import dataclass, replace
from urllib.parse import parse_qs, quote

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from starlette.datastructures import URL
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from wearline.errors import UsageError
from wearline_hmi.config import HmiSettings
from wearline_hmi.core.passwords import fault_of
from wearline_hmi.core.rights import Deed, Role, may
from wearline_hmi.drivers.accounts import Accounts, User, digest
from wearline_hmi.drivers.hashing import Hasher
from wearline_hmi.pages.parts import Look

LOG = logging.getLogger(__name__)
COOKIE = "wearline_session"
# The prefix makes browsers refuse the cookie when it does not come over TLS from this very host.
SECURE_COOKIE = "__Host-wearline_session"
FORM_MAX_BYTES = 4096
DOOR_POLICY = (
    "default-src 'none'; style-src 'self'; img-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
OPEN = ("/login", "/setup", "/static/", "/_nicegui/", "/favicon.ico")
"""What everybody may ask for: how to come in, and code that says nothing of the cell."""
WRONG = "Name or password is wrong."


@dataclass(frozen=True)
class Visitor:
    """Who sent a request."""

    role: Role
    name: str
    """Of the account; empty for a viewer."""
    session: str
    """Digest of the session's token; empty for a viewer."""
    address: str
    must_change: bool = False

    def may(self, deed: Deed) -> bool:
        return may(self.role, deed)


class Doorkeeper:
    """Knows who may come in."""

    def __init__(self, accounts: Accounts, hasher: Hasher, settings: HmiSettings, forbidden: frozenset[str]) -> None:
        self.accounts, self.hasher, self.settings, self.forbidden = accounts, hasher, settings, forbidden
        self._setup_code = ""

    def announce(self, address: str) -> None:
        """Without any user, tell the log how to make the first one; the code holds until then or the next start."""
        if not self.accounts.has_users():
            letters = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789"
            self._setup_code = "-".join("".join(secrets.choice(letters) for _ in range(4)) for _ in range(3))
            LOG.warning("there is no user yet: open %s/setup and enter the code %s", address, self._setup_code)

    def is_setup_code(self, code: str) -> bool:
        given = code.strip().upper().encode()
        return bool(self._setup_code) and secrets.compare_digest(given, self._setup_code.encode())

    def visitor(self, connection: HTTPConnection, is_active: bool) -> Visitor | None:
        """Who sent it; None where nobody unknown may come in."""
        address = connection.client.host if connection.client is not None else ""
        name = SECURE_COOKIE if is_tls(connection) else COOKIE
        token = connection.cookies.get(name, "")
        return self._known(digest(token) if token else "", address, is_active)

    def again(self, visitor: Visitor, is_active: bool) -> Visitor | None:
        """The same visitor as the table of rights sees him now; None when his session has ended."""
        found = self._known(visitor.session, visitor.address, is_active)
        return None if found is None or found.session != visitor.session else found

    def _known(self, session: str, address: str, is_active: bool) -> Visitor | None:
        user = self.accounts.session_user(session, is_active) if session else None
        if user is not None:
            return Visitor(user.role, user.name, session, address, user.must_change)
        return Visitor(Role.VIEWER, "", "", address) if self.settings.view_without_login else None


def is_tls(connection: HTTPConnection) -> bool:
    """Whether the browser speaks https."""
    return connection.scope.get("scheme") in ("https", "wss")


class Gate:
    """Lets in who is known, and hands on who it is as ``scope["visitor"]``."""

    def __init__(self, app: ASGIApp, keeper: Doorkeeper) -> None:
        self._app, self._keeper = app, keeper

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        path: str = scope["path"]
        if path.startswith("/api/") and scope["type"] == "http":
            # Programs bring a token; who they are is asked where they are answered.
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        is_data = path.startswith(("/live/", "/_nicegui_ws/"))
        visitor = self._keeper.visitor(connection, is_active=scope["type"] == "http" and not is_data)
        scope["visitor"] = visitor
        if path.startswith(OPEN):
            await self._app(scope, receive, send)
        elif visitor is None and scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        elif visitor is None and is_data:
            await JSONResponse({"detail": "log in first"}, 401)(scope, receive, send)
        elif visitor is None:
            wanted = quote(str(URL(scope=scope).path), safe="/")
            await RedirectResponse(f"/login?next={wanted}", 303)(scope, receive, send)
        elif visitor.must_change and not is_data and path not in ("/password", "/logout"):
            await RedirectResponse("/password", 303)(scope, receive, send)
        else:
            await self._app(scope, receive, send)


def visitor_of(request: Request) -> Visitor:
    """Who sent a request that the gate let in."""
    visitor = request.scope["visitor"]
    assert isinstance(visitor, Visitor)
    return visitor


def _own_path(text: str) -> str:
    """A path of this server, whatever the request named."""
    return text if text.startswith("/") and not text.startswith(("//", "/\\")) and text.isprintable() else "/"


@dataclass(frozen=True)
class Door:
    """One of the plain pages: title, sentence, fields and button, in English."""

    title: str
    sentence: str
    fields: tuple[tuple[str, str, str, str], ...]
    """name, label, type, autocomplete."""
    button: str
    action: str
    fault: str = ""
    fault_values: tuple[tuple[str, object], ...] = ()
    hidden: tuple[tuple[str, str], ...] = ()
    known: tuple[tuple[str, str], ...] = ()
    """Values that fields keep after a fault."""


def door_page(door: Door, look: Look, cell: str, status: int = 200) -> Response:
    """As HTML."""
    say, text = look.say, html.escape
    known = dict(door.known)
    fields = "".join(
        f'<label for="{name}">{text(say(label))}</label><input id="{name}" name="{name}" type="{kind}" '
        f'autocomplete="{complete}" value="{text(known.get(name, ""))}" maxlength="300" required'
        f"{' autofocus' if index == 0 else ''}>"
        for index, (name, label, kind, complete) in enumerate(door.fields)
    )
    hidden = "".join(f'<input type="hidden" name="{name}" value="{text(value)}">' for name, value in door.hidden)
    fault = (
        f'<p class="fault" role="alert">{text(say(door.fault, **dict(door.fault_values)))}</p>' if door.fault else ""
    )
    body = (
        f'<!doctype html><html lang="{say.code}"><head><meta charset="utf-8"><title>{text(say(door.title))} · '
        f'{text(cell)}</title><meta name="viewport" content="width=device-width, initial-scale=1">'
        '<link rel="icon" href="/static/wearline.svg"><link rel="stylesheet" href="/static/wearline.css"></head>'
        f'<body class="door {"body--dark" if look.is_dark else ""}"><main><img src="/static/wearline.svg" alt="">'
        f"<h1>{text(say(door.title))}</h1><p>{text(say(door.sentence, cell=cell))}</p>{fault}"
        f'<form method="post" action="{door.action}">{hidden}{fields}<button class="main" type="submit">'
        f"{text(say(door.button))}</button></form></main></body></html>"
    )
    headers = {"Content-Security-Policy": DOOR_POLICY, "Cache-Control": "no-store"}
    return HTMLResponse(body, status, headers=headers)


LOGIN = Door(
    "Log in", "Cell {cell}",
    (("name", "Name", "text", "username"), ("password", "Password", "password", "current-password")),
    "Log in", "/login",
)  # fmt: skip
SETUP = Door(
    "First administrator", "The log of the hmi service shows a code once, when it starts without any user.",
    (("code", "Code from the log", "text", "off"), ("name", "Name", "text", "username"),
     ("password", "Password, 12 characters at least", "password", "new-password")),
    "Make the account", "/setup",
)  # fmt: skip
PASSWORD = Door(
    "Change the password", "All other sessions of this account end.",
    (("old", "Password until now", "password", "current-password"),
     ("password", "New password, 12 characters at least", "password", "new-password")),
    "Change the password", "/password",
)  # fmt: skip


async def _form(request: Request) -> dict[str, str]:
    """The fields of a small form; an oversized body is cut, and then some are missing."""
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > FORM_MAX_BYTES:
            return {}
    fields = parse_qs(body.decode(errors="replace"), keep_blank_values=True, max_num_fields=10)
    return {name: values[0] for name, values in fields.items()}


def add_gate(app: FastAPI, keeper: Doorkeeper, cell: Callable[[], str]) -> None:
    """The routes ``/login``, ``/logout``, ``/setup`` and ``/password``."""
    accounts, hasher = keeper.accounts, keeper.hasher

    def show(request: Request, door: Door, fault: str = "", status: int = 200, **values: object) -> Response:
        shown = replace(door, fault=fault, fault_values=tuple(values.items()))
        return door_page(shown, Look(request), cell(), status)

    def address_of(request: Request) -> str:
        return request.client.host if request.client is not None else ""

    async def enter(request: Request, user: User, target: str) -> Response:
        # A session that was there before ends: nobody can plant one.
        visitor = request.scope["visitor"]
        if isinstance(visitor, Visitor) and visitor.session:
            accounts.close_session(visitor.session)
        address = address_of(request)
        token = await asyncio.to_thread(accounts.open_session, user, address)
        await asyncio.to_thread(accounts.note, user.name, address, "log in")
        answer = RedirectResponse(target, 303)
        answer.set_cookie(
            SECURE_COOKIE if is_tls(request) else COOKIE, token, path="/", httponly=True, samesite="strict",
            secure=is_tls(request), max_age=round(keeper.settings.session_hours * 3600),
        )  # fmt: skip
        return answer

    async def wait_fault(request: Request, door: Door, name: str) -> Response | None:
        wait_s = accounts.must_wait_s(name, address_of(request))
        if wait_s <= 0:
            return None
        answer = show(request, door, "Too many wrong ones. Try again in {n} s.", 429, n=round(wait_s + 0.5))
        answer.headers["Retry-After"] = str(round(wait_s + 0.5))
        return answer

    @app.get("/login", include_in_schema=False)
    async def login_page(request: Request, next: str = "/") -> Response:
        if not accounts.has_users():
            return RedirectResponse("/setup", 303)
        return show(request, replace(LOGIN, hidden=(("next", _own_path(next)),)))

    @app.post("/login", include_in_schema=False)
    async def login(request: Request) -> Response:
        fields = await _form(request)
        name, password = fields.get("name", ""), fields.get("password", "")
        target = _own_path(fields.get("next", "/"))
        door = replace(LOGIN, hidden=(("next", target),), known=(("name", name[:40]),))
        if (wait := await wait_fault(request, door, name)) is not None:
            return wait
        user = accounts.user(name)
        try:
            is_right = await hasher.is_right(password[:1000], None if user is None else user.secret)
        except TimeoutError:
            return show(request, door, "Too many log in at once. Try again in a moment.", 503)
        if user is None or not is_right:
            await asyncio.to_thread(accounts.note_failure, name, address_of(request))
            await asyncio.to_thread(accounts.note, name[:40], address_of(request), "log in refused")
            return show(request, door, WRONG, 401)
        await asyncio.to_thread(accounts.note_success, name, address_of(request))
        return await enter(request, user, target)

    @app.post("/logout", include_in_schema=False)
    async def logout(request: Request) -> Response:
        visitor = visitor_of(request)
        if visitor.session:
            accounts.close_session(visitor.session)
            await asyncio.to_thread(accounts.note, visitor.name, visitor.address, "log out")
        answer = RedirectResponse("/" if keeper.settings.view_without_login else "/login", 303)
        answer.delete_cookie(
            SECURE_COOKIE if is_tls(request) else COOKIE,
            path="/",
            httponly=True,
            samesite="strict",
            secure=is_tls(request),
        )
        return answer

    @app.get("/setup", include_in_schema=False)
    async def setup_page(request: Request) -> Response:
        if accounts.has_users():
            return RedirectResponse("/login", 303)
        return show(request, SETUP)

    @app.post("/setup", include_in_schema=False)
    async def setup(request: Request) -> Response:
        if accounts.has_users():
            return RedirectResponse("/login", 303)
        fields = await _form(request)
        name, password = fields.get("name", ""), fields.get("password", "")
        door = replace(SETUP, known=(("name", name[:40]), ("code", fields.get("code", "")[:40])))
        if (wait := await wait_fault(request, door, "setup")) is not None:
            return wait
        if not keeper.is_setup_code(fields.get("code", "")):
            await asyncio.to_thread(accounts.note_failure, "setup", address_of(request))
            return show(request, door, "This is not the code in the log.", 401)
        if (fault := fault_of(password, name, keeper.forbidden)) is not None:
            return show(request, door, fault, 422)
        secret = await hasher.hash(password)
        try:
            user = accounts.add(name, Role.ADMINISTRATOR, secret, must_change=False, only_first=True)
        except UsageError as error:
            return show(request, door, str(error), 422)
        await asyncio.to_thread(accounts.note, user.name, address_of(request), "first administrator")
        return await enter(request, user, "/")

    @app.get("/password", include_in_schema=False)
    async def password_page(request: Request) -> Response:
        if not visitor_of(request).session:
            return RedirectResponse("/login?next=/password", 303)
        return show(request, PASSWORD)

    @app.post("/password", include_in_schema=False)
    async def change_password(request: Request) -> Response:
        visitor = visitor_of(request)
        user = accounts.user(visitor.name)
        if not visitor.session or user is None:
            return RedirectResponse("/login?next=/password", 303)
        fields = await _form(request)
        if (wait := await wait_fault(request, PASSWORD, user.name)) is not None:
            return wait
        try:
            is_right = await hasher.is_right(fields.get("old", "")[:1000], user.secret)
        except TimeoutError:
            return show(request, PASSWORD, "Too many log in at once. Try again in a moment.", 503)
        if not is_right:
            await asyncio.to_thread(accounts.note_failure, user.name, visitor.address)
            return show(request, PASSWORD, "The password until now is wrong.", 401)
        password = fields.get("password", "")
        fault = fault_of(password, user.name, keeper.forbidden)
        if fault is None and password == fields.get("old"):
            fault = "The new password is the old one."
        if fault is not None:
            return show(request, PASSWORD, fault, 422)
        secret = await hasher.hash(password)
        await asyncio.to_thread(accounts.set_secret, user.name, secret, False, visitor.session)
        await asyncio.to_thread(accounts.note, user.name, visitor.address, "change the own password")
        return RedirectResponse("/", 303)
