"""The camera screen in a real browser."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import Visit
from tests.browser.feed import Feed
from wearline_hmi.drivers.accounts import Accounts

pytestmark = pytest.mark.browser


def profile_pixels(page: Page) -> str:
    return str(page.evaluate("document.querySelector('.brightness-profiles canvas').toDataURL()"))


def test_two_lines_are_moved_over_the_picture_and_their_brightness_follows(
    visit: Callable[..., Visit], feed: Feed
) -> None:
    feed.show(47)
    page = visit().open("/camera")
    expect(page.locator(".live-line")).to_have_count(2)
    expect(page.locator(".live-roi")).to_be_visible()
    roi, picture = page.locator(".live-roi").bounding_box(), page.locator(".live-over").bounding_box()
    assert roi is not None
    assert picture is not None
    # x 180 of 1624 sensor pixels: the preview is half as large as the sensor.
    assert (roi["x"] - picture["x"]) / picture["width"] == pytest.approx(180 / 1624, abs=0.01)
    assert roi["width"] / picture["width"] == pytest.approx(1280 / 1624, abs=0.01)
    first = page.locator(".live-line.line-0")
    before = profile_pixels(page)
    box = first.bounding_box()
    assert box is not None
    at = int(first.get_attribute("aria-valuenow") or 0)
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 80)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2 - 60, box["y"] + 90, steps=4)
    page.mouse.up()
    moved = int(first.get_attribute("aria-valuenow") or 0)
    assert moved < at - 30
    assert profile_pixels(page) != before
    first.focus()
    page.keyboard.press("ArrowRight")
    expect(first).to_have_attribute("aria-valuenow", str(moved + 1))
    expect(page.locator(".brightness dd").nth(1)).to_contain_text("%")
    assert float(page.locator(".brightness dd").first.inner_text()) == pytest.approx(40, abs=25)


def test_maintenance_sets_exposure_and_gain_and_nonsense_is_refused(
    visit: Callable[..., Visit], feed: Feed, accounts: Accounts
) -> None:
    page = visit("mats").open("/camera")
    expect(page.get_by_label("Exposure")).to_have_value("10000")
    page.get_by_label("Exposure").fill("9500")
    page.get_by_label("Gain").fill("1,5")
    page.get_by_role("button", name="Set", exact=True).click()
    expect(page.get_by_role("alert").filter(has_text="exposure 9500 us, gain 1.5 dB")).to_be_visible()
    assert (feed.exposure_us, feed.gain_db) == (9500.0, 1.5)
    noted = accounts.audit(1)[0]
    assert (noted.user, noted.deed) == ("mats", "set the camera")
    assert noted.detail == "exposure 10000 -> 9500 us, gain 0 -> 1.5 dB: done"
    expect(page.get_by_label("Gain")).to_have_value("1.5")
    page.get_by_label("Exposure").fill("much")
    page.get_by_role("button", name="Set", exact=True).click()
    expect(page.get_by_role("alert").filter(has_text="are numbers")).to_be_visible()
    page.get_by_label("Exposure").fill("60000")
    page.get_by_role("button", name="Set", exact=True).click()
    expect(page.get_by_role("alert").filter(has_text="at most 50000")).to_be_visible()
    assert feed.exposure_us == 9500.0


def test_the_picture_is_saved_by_maintenance_and_not_offered_to_operators(
    visit: Callable[..., Visit], feed: Feed
) -> None:
    feed.show(47)
    page = visit("mats").open("/camera")
    with page.expect_download() as waiting:
        page.get_by_role("link", name="Save the picture").click()
    assert waiting.value.path().read_bytes()[:2] == b"\xff\xd8"
    page = visit("olga").open("/camera")
    expect(page.get_by_role("button", name="Set", exact=True)).to_be_disabled()
    expect(page.get_by_label("Exposure")).to_be_disabled()
    expect(page.get_by_role("link", name="Save the picture")).to_have_count(0)
