"""The users screen, for administrators: accounts, and read-only tokens of the HTTP API."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import Any

from nicegui import ui
from nicegui.element import Element

from wearline.errors import WearlineError
from wearline_hmi.core import rights
from wearline_hmi.core.passwords import fault_of
from wearline_hmi.core.rights import ACCOUNT_ROLES, Role
from wearline_hmi.pages.frame import Frame
from wearline_hmi.pages.parts import Button, Column, Field, Rows, Select, confirmed, panel, text_element


def build_users(page: Frame) -> None:
    """The screen ``/users``."""
    with Element("div").classes("grid-users"):
        _accounts(page)
        _tokens(page)


async def _is_really(page: Frame, own: Field) -> bool:
    """Whether the administrator's own password is there: an unattended panel must not make users."""
    say, keeper = page.look.say, page.site.keeper
    user = keeper.accounts.user(page.visitor.name)
    given, name, address = own.value, page.visitor.name, page.visitor.address
    own.set("")
    wait_s = keeper.accounts.must_wait_s(name, address)
    if wait_s > 0:
        ui.notify(say("Too many wrong ones. Try again in {n} s.", n=round(wait_s + 0.5)), type="negative")
        return False
    try:
        is_right = await keeper.hasher.is_right(given[:1000], None if user is None else user.secret)
    except TimeoutError:
        ui.notify(say("Too many log in at once. Try again in a moment."), type="negative")
        return False
    if not is_right:
        await asyncio.to_thread(keeper.accounts.note_failure, name, address)
        await page.note(rights.MANAGE_USERS.name, "own password wrong")
        ui.notify(say("Your own password is wrong."), type="negative")
    return is_right


async def _change(page: Frame, change: Callable[[], Any], detail: str) -> bool:
    """Do it, note it, and say what came of it."""
    try:
        await asyncio.to_thread(change)
    except WearlineError as error:
        await page.note(rights.MANAGE_USERS.name, f"{detail}: refused: {error}")
        ui.notify(page.look.say(str(error)), type="negative")
        return False
    await page.note(rights.MANAGE_USERS.name, f"{detail}: done")
    ui.notify(page.look.say("Done."), type="positive")
    return True


def _accounts(page: Frame) -> None:
    say, keeper = page.look.say, page.site.keeper
    accounts = keeper.accounts
    roles = [(role.value, say(role.value)) for role in ACCOUNT_ROLES]

    def show(chosen: str = "") -> None:
        rows.show(
            [
                {
                    "id": user.name,
                    "name": user.name,
                    "role": say(user.role.value),
                    "since": user.created_utc[:10],
                    "note": say("must change the password") if user.must_change else "",
                }
                for user in accounts.users()
            ],
            chosen,
        )

    def choose(wanted: str) -> None:
        user = accounts.user(wanted)
        if user is not None:
            name.set(user.name)
            role.show(roles, user.role.value)
            show(user.name)

    async def secret_of() -> str | None:
        fault = fault_of(password.value, name.value, keeper.forbidden)
        if fault is not None:
            ui.notify(say(fault), type="negative")
            return None
        given = password.value
        password.set("")
        return await keeper.hasher.hash(given)

    async def add() -> None:
        if await _is_really(page, own) and (secret := await secret_of()) is not None:
            wanted = Role(role.value)
            if await _change(
                page, partial(accounts.add, name.value, wanted, secret, True), f"add {name.value} as {wanted}"
            ):
                show()

    async def set_role() -> None:
        user = accounts.user(name.value)
        before = "" if user is None else user.role.value
        if await _is_really(page, own):
            change = partial(accounts.set_role, name.value, Role(role.value))
            if await _change(page, change, f"role of {name.value}: {before} -> {role.value}"):
                show()

    async def reset() -> None:
        if accounts.user(name.value) is None:
            ui.notify(say("There is no such user."), type="negative")
        elif await _is_really(page, own) and (secret := await secret_of()) is not None:
            await _change(
                page, partial(accounts.set_secret, name.value, secret, True), f"new password for {name.value}"
            )
            show()

    async def remove() -> None:
        question = say("Delete the account {name}?", name=name.value)
        if not await _is_really(page, own) or not await confirmed(say, question, say("Delete")):
            return
        if await _change(page, partial(accounts.remove, name.value), f"delete {name.value}"):
            show()

    with panel(say("Users")):
        rows = Rows(
            [
                Column("name", say("Name")), Column("role", say("Role")), Column("since", say("Since")),
                Column("note", say("Note")),
            ],
            say("Users"), say("No user"), choose,
        )  # fmt: skip
        with Element("div").classes("form"):
            with Element("div").classes("filters flat"):
                name = Field(say("Name"))
                role = Select(say("Role"), roles, Role.OPERATOR.value)
                password = Field(say("First password for it"), kind="password", complete="new-password")
            own = Field(say("Your own password"), kind="password", complete="current-password")
            with Element("div").classes("buttons left"):
                for text, handler in (
                    ("Add", add), ("Change the role", set_role), ("Give a new password", reset), ("Delete", remove),
                ):  # fmt: skip
                    Button(say(text), page.guarded(rights.MANAGE_USERS, handler))
            text_element("p", say("A password that you give must be changed at the first login."), "hint")
    show()


def _tokens(page: Frame) -> None:
    say, accounts = page.look.say, page.site.keeper.accounts

    def show() -> None:
        rows.show(
            [
                {"id": t.name, "name": t.name, "since": t.created_utc[:10], "by": t.created_by}
                for t in accounts.tokens()
            ]
        )  # fmt: skip

    async def add() -> None:
        if await _is_really(page, own):
            made: list[str] = []
            wanted = name.value
            if await _change(
                page, lambda: made.append(accounts.add_token(wanted, page.visitor.name)), f"token {wanted}"
            ):
                show()
                with ui.dialog() as dialog, Element("div").classes("panel dialog"):
                    text_element("p", say("This token is shown once. Keep it where only its program reads it."))
                    text_element("code", made[0], "token")
                    with Element("div").classes("buttons"):
                        Button(say("Close"), dialog.close, "main")
                dialog.on("hide", dialog.delete)
                dialog.open()

    async def remove() -> None:
        if await _is_really(page, own) and await _change(
            page, partial(accounts.remove_token, name.value), f"delete token {name.value}"
        ):
            show()

    with panel(say("Tokens for programs")):
        rows = Rows(
            [Column("name", say("Name")), Column("since", say("Since")), Column("by", say("Made by"))],
            say("Tokens for programs"), say("No token"), lambda wanted: name.set(wanted),
        )  # fmt: skip
        with Element("div").classes("form"):
            name = Field(say("Name of the token"))
            own = Field(say("Your own password"), kind="password", complete="current-password")
            with Element("div").classes("buttons left"):
                Button(say("Make a token"), page.guarded(rights.MANAGE_USERS, add))
                Button(say("Delete the token"), page.guarded(rights.MANAGE_USERS, remove))
            text_element("p", say("Tokens read through /api and change nothing."), "hint")
    show()
