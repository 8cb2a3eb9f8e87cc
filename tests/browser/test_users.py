"""Users and tokens in a real browser."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import PASSWORD, Hmi, Visit
from wearline_hmi.core.rights import Role
from wearline_hmi.drivers.accounts import Accounts

pytestmark = pytest.mark.browser


def own_password(page: Page, password: str = PASSWORD) -> None:
    page.locator(".panel", has_text="Change the role").get_by_label("Your own password").fill(password)


def test_an_administrator_adds_changes_and_deletes_a_user(visit: Callable[..., Visit], accounts: Accounts) -> None:
    page = visit("ada").open("/users")
    rows = page.locator(".panel", has_text="Change the role").locator("tbody tr")
    page.get_by_label("Name", exact=True).fill("Nina")
    page.get_by_label("Role").select_option("operator")
    page.get_by_label("First password").fill("short")
    own_password(page)
    page.get_by_role("button", name="Add").click()
    expect(page.get_by_role("alert").filter(has_text="12 characters at least")).to_be_visible()
    page.get_by_label("First password").fill("a first password of nina")
    own_password(page, "not my password")
    page.get_by_role("button", name="Add").click()
    expect(page.get_by_role("alert").filter(has_text="Your own password is wrong.")).to_be_visible()
    assert accounts.user("Nina") is None
    own_password(page)
    page.get_by_role("button", name="Add").click()
    expect(rows.filter(has_text="Nina")).to_contain_text("must change the password")
    page.get_by_role("button", name="Nina").click()
    page.get_by_label("Role").select_option("maintenance")
    own_password(page)
    page.get_by_role("button", name="Change the role").click()
    expect(rows.filter(has_text="Nina")).to_contain_text("maintenance")
    own_password(page)
    page.get_by_role("button", name="Delete", exact=True).click()
    page.locator(".dialog").get_by_role("button", name="Delete").click()
    expect(rows.filter(has_text="Nina")).to_have_count(0)
    noted = [(entry.user, entry.detail) for entry in accounts.audit(4)]
    assert noted == [
        ("ada", "delete Nina: done"), ("ada", "role of Nina: operator -> maintenance: done"),
        ("ada", "add Nina as operator: done"), ("ada", "own password wrong"),
    ]  # fmt: skip


def test_the_last_administrator_cannot_be_deleted(visit: Callable[..., Visit], accounts: Accounts) -> None:
    page = visit("ada").open("/users")
    page.get_by_role("button", name="ada", exact=True).click()
    own_password(page)
    page.get_by_role("button", name="Delete", exact=True).click()
    page.locator(".dialog").get_by_role("button", name="Delete").click()
    expect(page.get_by_role("alert").filter(has_text="The last administrator stays.")).to_be_visible()
    assert accounts.user("ada") is not None


@pytest.mark.slow
def test_nobody_else_comes_to_other_accounts(visit: Callable[..., Visit], accounts: Accounts, hmi: Hmi) -> None:
    for name in ("", "olga", "mats"):
        other = visit(name)
        assert other.context.request.get(hmi.url + "/users").status == 403
        expect(other.open("/").get_by_role("link", name="Users")).to_have_count(0)


def test_an_open_tab_of_a_former_administrator_makes_no_users(visit: Callable[..., Visit], accounts: Accounts) -> None:
    user = accounts.user("ada")
    assert user is not None
    accounts.add("Eve", Role.ADMINISTRATOR, user.secret, must_change=False)
    try:
        page = visit("Eve").open("/users")
        page.get_by_label("Name", exact=True).fill("Mallory")
        page.get_by_label("First password").fill("a first password of hers")
        own_password(page)
        accounts.set_role("Eve", Role.OPERATOR)
        page.evaluate("document.querySelectorAll('button').forEach(b => b.textContent === 'Add' && b.click())")
        expect(page.get_by_text("Your account does not show this screen.")).to_be_visible()
        assert accounts.user("Mallory") is None
    finally:
        accounts.remove("Eve")


def test_a_token_is_shown_once(visit: Callable[..., Visit], accounts: Accounts) -> None:
    page = visit("ada").open("/users")
    panel = page.locator(".panel", has_text="Make a token")
    panel.get_by_label("Name of the token").fill("grafana")
    panel.get_by_label("Your own password").fill(PASSWORD)
    panel.get_by_role("button", name="Make a token").click()
    token = page.locator(".token").inner_text()
    assert accounts.token_name(token) == "grafana"
    page.get_by_role("button", name="Close").click()
    expect(panel.locator("tbody tr")).to_contain_text("grafana")
    expect(page.locator(".token")).to_have_count(0)
    assert token not in page.content()
    panel.get_by_label("Your own password").fill(PASSWORD)
    panel.get_by_role("button", name="Delete the token").click()
    expect(panel.locator("tbody tr")).to_contain_text("No token")
    assert accounts.token_name(token) is None
