"""The measurement screen in a real browser."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import Visit
from tests.browser.feed import Feed
from tests.contract.conftest import until
from wearline import messages as m
from wearline_hmi.core.rights import Role
from wearline_hmi.drivers.accounts import Accounts

pytestmark = pytest.mark.browser


@pytest.fixture(autouse=True)
def automatic(feed: Feed) -> Iterator[None]:
    """Each test begins and ends in automatic mode with object 1."""
    yield
    feed.mode, feed.object_index = "auto", 1


def asked(feed: Feed, kind: type[m.Message]) -> list[m.Message]:
    return [question for question in feed.asked if isinstance(question, kind)]


def manual(page: Page) -> None:
    page.locator('button[data-mode="manual"]').click()
    page.get_by_role("button", name="Manual mode").click()
    expect(page.locator(".fact-mode .word")).to_have_text("manual")


def test_an_operator_measures_by_hand_and_chooses_the_object(
    visit: Callable[..., Visit], feed: Feed, accounts: Accounts
) -> None:
    page = visit("olga").open("/measurement")
    by_hand = page.get_by_role("button", name="Measure", exact=True)
    expect(by_hand).to_be_disabled()
    manual(page)
    expect(by_hand).to_be_enabled()
    by_hand.click()
    until(lambda: bool(asked(feed, m.DoMeasure)))
    (wanted,) = asked(feed, m.DoMeasure)
    assert isinstance(wanted, m.DoMeasure)
    assert wanted.user == "olga"
    page.get_by_label("Object").select_option("2")
    expect(page.locator(".glance .fact", has_text="Object").locator(".fact-text")).to_have_text("2")
    expect(page.get_by_role("button", name="Make template")).to_be_disabled()
    assert [entry.deed for entry in accounts.audit(3)] == ["select an object", "measure by hand", "set the mode"]
    assert accounts.audit(1)[0].detail == "2: done"
    page.locator('button[data-mode="auto"]').click()
    expect(page.locator(".fact-mode .word")).to_have_text("auto")


def test_a_dialog_that_is_cancelled_changes_nothing(visit: Callable[..., Visit], feed: Feed) -> None:
    page = visit("olga").open("/measurement")
    before = len(asked(feed, m.SetMode))
    page.locator('button[data-mode="manual"]').click()
    page.get_by_role("button", name="Cancel").click()
    expect(page.locator('button[data-mode="auto"]')).to_have_attribute("aria-pressed", "true")
    assert len(asked(feed, m.SetMode)) == before


def test_maintenance_makes_a_template_of_the_last_parts(visit: Callable[..., Visit], feed: Feed) -> None:
    page = visit("mats").open("/measurement")
    page.get_by_label("Template").select_option("3")
    page.get_by_role("button", name="Make template").click()
    page.locator(".dialog").get_by_role("button", name="Make template").click()
    expect(page.get_by_role("alert").filter(has_text="taught from 3 parts")).to_be_visible()
    wanted = asked(feed, m.Teach)[-1]
    assert isinstance(wanted, m.Teach)
    assert (wanted.object_index, len(wanted.cycle_ids), wanted.user) == (1, 3, "mats")


def test_who_only_looks_is_offered_nothing_and_is_refused_all_the_same(
    visit: Callable[..., Visit], feed: Feed, accounts: Accounts
) -> None:
    page = visit("").open("/measurement")
    expect(page.locator('button[data-mode="manual"]')).to_be_disabled()
    expect(page.locator(".hint")).to_have_text("Log in with the rights for this.")
    before = len(feed.asked)
    # Whoever takes the lock off in his own browser meets the check on the server.
    page.evaluate("document.querySelector('button[data-mode=\"manual\"]').disabled = false")
    page.locator('button[data-mode="manual"]').click(force=True)
    expect(page.get_by_role("alert").filter(has_text="You are not allowed to do this.")).to_be_visible()
    assert not any(isinstance(question, m.Do) for question in feed.asked[before:])
    assert (accounts.audit(1)[0].deed, accounts.audit(1)[0].detail) == ("set the mode", "refused")


def test_a_role_that_was_taken_away_is_missed_at_the_event(
    visit: Callable[..., Visit], feed: Feed, accounts: Accounts
) -> None:
    page = visit("mats").open("/measurement")
    expect(page.get_by_role("button", name="Make template")).to_be_enabled()
    before = len(asked(feed, m.Teach))
    accounts.set_role("mats", Role.OPERATOR)
    try:
        page.get_by_role("button", name="Make template").click()
        expect(page.get_by_role("alert").filter(has_text="not allowed").or_(page.locator(".hint"))).not_to_have_count(0)
        expect(page.locator(".user .fact-name")).to_have_text("operator")
    finally:
        accounts.set_role("mats", Role.MAINTENANCE)
    assert len(asked(feed, m.Teach)) == before


def test_the_maps_are_drawn_in_three_ways_and_measured_with_the_ruler(visit: Callable[..., Visit], feed: Feed) -> None:
    feed.stroke(46)
    page = visit().open("/measurement")
    surface = page.locator(".surface")
    page.locator('button[data-map="measured"]').click()
    expect(surface).to_have_attribute("data-painted", re.compile(":measured$"))
    for painting in ("mesh", "flat", "surface"):
        drawn = int(surface.get_attribute("data-count") or 0)
        page.locator(f'button[data-painting="{painting}"]').click()
        page.wait_for_function("n => +document.querySelector('.surface').dataset.count > n", arg=drawn)
    page.locator('button[data-painting="flat"]').click()
    page.locator("button.ruler").click()
    box = page.locator(".surface canvas").bounding_box()
    assert box is not None
    for x in (0.40, 0.60):
        page.mouse.click(box["x"] + x * box["width"], box["y"] + 0.5 * box["height"])
    text = page.locator(".surface-length").inner_text()
    found = re.match(r"length ([\d.]+) mm · height difference −?([\d.]+) mm", text)
    assert found is not None, text
    assert 15.0 < float(found[1]) < 80.0
    page.locator(".surface canvas").focus()
    drawn = int(surface.get_attribute("data-count") or 0)
    page.keyboard.press("+")
    page.wait_for_function("n => +document.querySelector('.surface').dataset.count > n", arg=drawn)
