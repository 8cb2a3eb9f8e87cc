"""Logging in over HTTP, without any page of NiceGUI."""

from __future__ import annotations

import asyncio
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI, Request
from fastapi.testclient import TestClient

from wearline_hmi.config import HmiSettings
from wearline_hmi.core.passwords import FREE_TRIES
from wearline_hmi.core.rights import Role
from wearline_hmi.drivers.accounts import Accounts, digest
from wearline_hmi.drivers.hashing import WAITING_MAX, Hasher
from wearline_hmi.pages import gate
from wearline_hmi.pages.gate import Doorkeeper, Gate, add_gate, visitor_of
from wearline_hmi.pages.shield import Shield

PASSWORD = "tulip-anvil-94-fog"
ORIGIN = {"origin": "http://127.0.0.1"}


class Clock:
    def __init__(self) -> None:
        self.now_s = 1_800_000_000.0

    def __call__(self) -> float:
        return self.now_s


class House:
    """A gate with one room behind it."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.clock = Clock()
        self.settings = HmiSettings(**settings)
        self.accounts = Accounts(folder / "accounts.db", 600.0, 3600.0, self.clock)
        self.hasher = Hasher()
        self.keeper = Doorkeeper(self.accounts, self.hasher, self.settings, frozenset({"a breached password"}))
        app = FastAPI(openapi_url=None)
        add_gate(app, self.keeper, lambda: "press-7")

        @app.get("/room")
        def room(request: Request) -> dict[str, str]:
            visitor = visitor_of(request)
            return {"role": visitor.role, "name": visitor.name}

        @app.get("/live/x")
        def live() -> str:
            return "data"

        app.add_middleware(Gate, keeper=self.keeper)
        app.add_middleware(Shield, allowed_hosts=frozenset())
        self.app = app

    def add(self, name: str = "Ada", role: Role = Role.ADMINISTRATOR, must_change: bool = False) -> None:
        secret = asyncio.run(self.hasher.hash(PASSWORD))
        self.accounts.add(name, role, secret, must_change)

    def browser(self, address: str = "10.0.0.1", base: str = "http://127.0.0.1") -> TestClient:
        return TestClient(
            self.app, base_url=base, follow_redirects=False, client=(address, 1), headers={"origin": base}
        )


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    house = House(tmp_path)
    yield house
    house.hasher.close()
    house.accounts.close()


def login(browser: TestClient, name: str = "Ada", password: str = PASSWORD, **fields: str) -> Any:
    return browser.post("/login", data={"name": name, "password": password, **fields})


def test_nobody_comes_in_without_a_login(house: House) -> None:
    house.add()
    browser = house.browser()
    answer = browser.get("/room")
    assert (answer.status_code, answer.headers["location"]) == (303, "/login?next=/room")
    assert browser.get("/live/x").status_code == 401
    assert browser.get("/nothing").status_code == 303, "what exists is not told either"


def test_the_right_password_opens_and_logging_out_closes(house: House) -> None:
    house.add()
    browser = house.browser()
    answer = login(browser, next="/room")
    assert (answer.status_code, answer.headers["location"]) == (303, "/room")
    assert browser.get("/room").json() == {"role": "administrator", "name": "Ada"}
    cookie = browser.cookies[gate.COOKIE]
    assert browser.post("/logout").status_code == 303
    browser.cookies.set(gate.COOKIE, cookie)
    assert browser.get("/room").status_code == 303, "the server has forgotten the session"
    assert [entry.deed for entry in house.accounts.audit()] == ["log out", "log in"]


def test_the_cookie_is_out_of_reach_of_scripts_other_sites_and_plain_http(house: House) -> None:
    house.add()
    plain = login(house.browser()).headers["set-cookie"]
    assert re.match(r"wearline_session=[\w-]{43}; HttpOnly; Max-Age=43200; Path=/; SameSite=strict$", plain), plain
    secure = login(house.browser(base="https://127.0.0.1")).headers["set-cookie"]
    assert secure.startswith("__Host-wearline_session=")
    assert "; Secure" in secure


def test_a_login_makes_a_new_session_and_ends_the_one_before(house: House) -> None:
    house.add()
    browser = house.browser()
    login(browser)
    first = browser.cookies[gate.COOKIE]
    login(browser)
    assert browser.cookies[gate.COOKIE] != first
    other = house.browser()
    other.cookies.set(gate.COOKIE, first)
    assert other.get("/room").status_code == 303
    planted = house.browser()
    planted.cookies.set(gate.COOKIE, "planted")
    assert planted.get("/room").status_code == 303


def test_wrong_names_and_wrong_passwords_look_alike(house: House) -> None:
    house.add()
    browser = house.browser()
    wrong = login(browser, "Ada", "wrong password")
    unknown = login(browser, "Bob", "wrong password")
    assert wrong.status_code == unknown.status_code == 401
    assert wrong.text.replace("Ada", "Bob") == unknown.text
    assert gate.WRONG in wrong.text


def test_an_unknown_name_is_hashed_too(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    house.add()
    checked: list[str] = []
    check = house.hasher._argon2.verify

    class Noting:
        def verify(self, known: str, password: str) -> bool:
            checked.append(known)
            return check(known, password)

    monkeypatch.setattr(house.hasher, "_argon2", Noting())
    login(house.browser(), "Bob", "wrong password")
    login(house.browser(), "Ada", "wrong password")
    assert len(checked) == 2
    parameters = {known.rsplit("$", 2)[0] for known in checked}
    assert parameters == {"$argon2id$v=19$m=19456,t=2,p=1"}


def test_wrong_passwords_make_wait_and_the_right_one_does_not_help_before(house: House) -> None:
    house.add()
    browser = house.browser()
    for _ in range(FREE_TRIES + 2):
        assert login(browser, password="wrong password").status_code == 401
        house.clock.now_s += 1.5
    assert login(browser, password="wrong password").status_code == 429
    refused = login(browser)
    assert refused.status_code == 429
    assert refused.headers["retry-after"] == "1"
    assert login(house.browser("10.0.0.2")).status_code == 303, "from another panel it does"
    house.clock.now_s += 2.0
    assert login(browser).status_code == 303


@pytest.mark.parametrize(
    "target", ["//evil.example", "https://evil.example", "/\\evil.example", "javascript:x", "/a\nb"]
)
def test_a_login_leads_nowhere_else(house: House, target: str) -> None:
    house.add()
    assert login(house.browser(), next=target).headers["location"] == "/"


def test_another_site_cannot_log_in_or_out_for_somebody(house: House) -> None:
    house.add()
    browser = house.browser()
    login(browser)
    for headers in ({"origin": "http://evil.example"}, {"origin": "null"}, {"origin": ""}):
        assert browser.post("/logout", headers=headers).status_code == 403
        assert browser.post("/login", headers=headers, data={"name": "Ada"}).status_code == 403
    assert browser.get("/room").status_code == 200


def test_the_pages_run_no_script_and_are_not_kept(house: House) -> None:
    house.add()
    answer = house.browser().get("/login?next=<script>")
    assert "script" not in answer.text
    assert answer.headers["content-security-policy"].startswith("default-src 'none'; style-src 'self'")
    assert answer.headers["cache-control"] == "no-store"
    wrong = login(house.browser(), '"><script>alert(1)</script>', "x")
    assert "<script" not in wrong.text


def test_the_first_administrator_needs_the_code_of_the_log(house: House, caplog: pytest.LogCaptureFixture) -> None:
    browser = house.browser()
    assert browser.get("/login").headers["location"] == "/setup"
    house.keeper.announce("http://127.0.0.1:8080")
    code = re.search(r"code ([A-Z2-9]{4}-[A-Z2-9]{4}-[A-Z2-9]{4})$", caplog.text, re.M)
    assert code is not None
    fields = {"name": "Ada", "password": PASSWORD}
    assert browser.post("/setup", data={**fields, "code": "AAAA-AAAA-AAAA"}).status_code == 401
    assert browser.post("/setup", data={**fields, "code": ""}).status_code == 401
    assert browser.post("/setup", data={**fields, "code": code[1], "password": "password"}).status_code == 422
    assert not house.accounts.has_users()
    assert browser.post("/setup", data={**fields, "code": code[1].lower()}).status_code == 303
    assert browser.get("/room").json()["role"] == "administrator"
    again = house.browser().post("/setup", data={**fields, "name": "Eve", "code": code[1]})
    assert again.headers["location"] == "/login", "the code holds once"
    caplog.clear()
    house.keeper.announce("http://127.0.0.1:8080")
    assert caplog.messages == []


def test_without_a_code_nobody_sets_up(house: House) -> None:
    assert house.browser().post("/setup", data={"name": "Ada", "password": PASSWORD, "code": ""}).status_code == 401


def test_guessing_the_code_makes_wait(house: House) -> None:
    house.keeper.announce("x")
    browser = house.browser()
    fields = {"name": "Ada", "password": PASSWORD, "code": "AAAA-AAAA-AAAA"}
    codes = [browser.post("/setup", data=fields).status_code for _ in range(FREE_TRIES + 2)]
    assert codes == [401] * (FREE_TRIES + 1) + [429]


def test_the_own_password_is_changed_with_the_old_one_and_ends_the_other_sessions(house: House) -> None:
    house.add()
    browser, other = house.browser(), house.browser("10.0.0.2")
    login(browser)
    login(other)

    def change(old: str, new: str) -> int:
        return int(browser.post("/password", data={"old": old, "password": new}).status_code)

    assert change("wrong password", "another-good-one") == 401
    assert change(PASSWORD, "password") == 422
    assert change(PASSWORD, "a breached password") == 422
    assert change(PASSWORD, PASSWORD) == 422
    assert change(PASSWORD, "another-good-one") == 303
    assert browser.get("/room").status_code == 200
    assert other.get("/room").status_code == 303
    assert login(other).status_code == 401
    assert login(other, password="another-good-one").status_code == 303


def test_a_password_that_somebody_else_gave_must_be_changed_first(house: House) -> None:
    house.add(must_change=True)
    browser = house.browser()
    login(browser)
    assert browser.get("/room").headers["location"] == "/password"
    browser.post("/password", data={"old": PASSWORD, "password": "another-good-one"})
    assert browser.get("/room").status_code == 200


def test_looking_without_a_login_is_an_explicit_choice(tmp_path: Path) -> None:
    assert HmiSettings().view_without_login is False
    house = House(tmp_path, view_without_login=True)
    house.add()
    browser = house.browser()
    assert browser.get("/room").json() == {"role": "viewer", "name": ""}
    assert browser.get("/password").headers["location"] == "/login?next=/password"
    login(browser)
    assert browser.get("/room").json()["role"] == "administrator"
    house.hasher.close()
    house.accounts.close()


def test_a_session_that_ended_is_not_mistaken_for_a_viewer(tmp_path: Path) -> None:
    house = House(tmp_path, view_without_login=True)
    house.add()
    browser = house.browser()
    login(browser)
    opened = house.keeper._known(digest(browser.cookies[gate.COOKIE]), "x", False)
    assert opened is not None
    browser.post("/logout")
    assert house.keeper.again(opened, is_active=True) is None
    house.hasher.close()
    house.accounts.close()


def test_an_oversized_form_is_not_read(house: House) -> None:
    house.add()
    assert login(house.browser(), "Ada", PASSWORD + "x" * 10_000).status_code == 401


def test_hashing_happens_one_at_a_time_beside_the_event_loop() -> None:
    hasher = Hasher()

    async def crowd() -> tuple[list[Any], int]:
        known = await hasher.hash(PASSWORD)
        tries = (hasher.is_right(PASSWORD, known) for _ in range(WAITING_MAX + 4))
        checks = asyncio.gather(*tries, return_exceptions=True)
        turns = 0
        while not checks.done():
            await asyncio.sleep(0.001)
            turns += 1
        return await checks, turns

    results, turns = asyncio.run(crowd())
    assert results.count(True) == WAITING_MAX
    assert sum(isinstance(result, TimeoutError) for result in results) == 4
    assert sum(t.name.startswith("argon2") for t in threading.enumerate()) == 1
    assert turns > 2 * WAITING_MAX, "the loop goes on while passwords are hashed"
    hasher.close()


def test_a_damaged_hash_is_a_wrong_password() -> None:
    hasher = Hasher()
    assert asyncio.run(hasher.is_right("x", "no hash")) is False
    assert asyncio.run(hasher.is_right("no password of anybody", None)) is False
    hasher.close()


def test_tls_needs_both_files() -> None:
    with pytest.raises(ValueError, match="go together"):
        HmiSettings(tls_certificate=Path("x"))
