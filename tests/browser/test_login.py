"""Coming in and going out in a real browser."""

from __future__ import annotations

import http.client
import re
import shutil
import ssl
import subprocess
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlencode, urlsplit

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import PASSWORD, Hmi, Visit, add_users, start_hmi, write_cell
from tests.browser.feed import Feed
from wearline.config import load_cell
from wearline_hmi.core.rights import Role
from wearline_hmi.drivers.accounts import Accounts

pytestmark = pytest.mark.browser


def test_from_the_first_start_to_the_first_screen(tmp_path: Path, browser: Browser) -> None:
    path = write_cell(tmp_path, view_without_login=False)
    feed = Feed(load_cell(path))
    running = start_hmi(path)
    context = browser.new_context()
    try:
        code = re.search(r"enter the code ([A-Z2-9-]{14})", running.log.read_text())
        assert code is not None
        page = context.new_page()
        page.goto(running.url + "/")
        expect(page).to_have_title(re.compile("First administrator"))
        page.get_by_label("Code").fill(code[1])
        page.get_by_label("Name").fill("Ada")
        page.get_by_label("Password").fill(PASSWORD)
        page.get_by_role("button").click()
        expect(page.locator(".user a.user-name")).to_have_text("Ada")
        page.get_by_role("button", name="Log out").click()
        expect(page).to_have_title(re.compile("Log in"))
        page.goto(running.url + "/")
        expect(page).to_have_title(re.compile("Log in"))
        page.get_by_label("Name").fill("ada")
        page.get_by_label("Password").fill("wrong password")
        page.get_by_role("button").click()
        expect(page.get_by_role("alert")).to_have_text("Name or password is wrong.")
        page.get_by_label("Password").fill(PASSWORD)
        page.keyboard.press("Enter")
        expect(page.locator(".user a.user-name")).to_have_text("Ada")
        assert PASSWORD not in running.log.read_text()
    finally:
        context.close()
        running.stop()
        feed.close()


def test_a_tab_that_is_left_open_is_told_nothing_more_after_the_logout(
    visit: Callable[..., Visit], accounts: Accounts
) -> None:
    guest = visit("olga")
    one, other = guest.open("/"), guest.open("/")
    expect(other.locator(".user .fact-name")).to_have_text("operator")
    one.get_by_role("button", name="Log out").click()
    expect(one.locator(".user-name")).to_have_text("Looking only")
    expect(other).to_have_title(re.compile("Log in"))


def test_another_role_rules_an_open_tab(visit: Callable[..., Visit], accounts: Accounts) -> None:
    page = visit("olga").open("/")
    accounts.set_role("olga", Role.MAINTENANCE)
    try:
        expect(page.locator(".user .fact-name")).to_have_text("maintenance")
    finally:
        accounts.set_role("olga", Role.OPERATOR)


def test_look_and_language_are_chosen_by_keyboard_and_kept(visit: Callable[..., Visit], hmi: Hmi) -> None:
    page = visit().open("/")
    page.get_by_role("button", name="Deutsch").focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="Deutsch")).to_have_attribute("aria-pressed", "true")
    page.locator("button.theme").focus()
    page.keyboard.press("Space")
    expect(page.locator("body.body--dark")).to_be_attached()
    page.goto(hmi.url + "/")
    expect(page.locator("body.body--dark")).to_be_attached()
    assert page.evaluate("document.documentElement.lang") == "de"


@pytest.mark.slow
def test_with_a_certificate_it_speaks_tls_alone_and_keeps_the_cookie_to_it(tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl to make a certificate")
    certificate, key = tmp_path / "hmi.pem", tmp_path / "hmi.key"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2",
         "-subj", "/CN=press7", "-addext", "subjectAltName=IP:127.0.0.1", "-out", str(certificate),
         "-keyout", str(key)],
        check=True, capture_output=True,
    )  # fmt: skip
    path = write_cell(
        tmp_path, view_without_login=False, tls_certificate=str(certificate), tls_key=str(key), host="127.0.0.1"
    )
    add_users(path)
    feed = Feed(load_cell(path))
    trusting = ssl.create_default_context(cafile=str(certificate))
    running = start_hmi(path, trusting)
    try:
        assert running.url.startswith("https://")
        place = urlsplit(running.url)
        connection = http.client.HTTPSConnection(place.hostname or "", place.port, context=trusting, timeout=5)
        body = urlencode({"name": "ada", "password": PASSWORD})
        headers = {"Origin": running.url, "Content-Type": "application/x-www-form-urlencoded"}
        connection.request("POST", "/login", body, headers)
        answer = connection.getresponse()
        assert answer.status == 303
        cookie = answer.headers["Set-Cookie"]
        assert cookie.startswith("__Host-wearline_session=")
        assert "; Secure" in cookie
        connection.close()
        plain = http.client.HTTPConnection(place.hostname or "", place.port, timeout=5)
        with pytest.raises((http.client.HTTPException, OSError)):
            plain.request("GET", "/login")
            plain.getresponse()
    finally:
        running.stop()
        feed.close()
