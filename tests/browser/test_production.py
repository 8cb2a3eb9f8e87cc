"""Production, log and settings in a real browser."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable

import pytest
from playwright.sync_api import expect

from tests.browser.conftest import Hmi, Visit
from tests.browser.feed import Feed
from wearline import messages as m
from wearline_hmi.drivers.accounts import Accounts

pytestmark = pytest.mark.browser


def test_products_are_searched_on_the_server_and_one_click_shows_why(visit: Callable[..., Visit], feed: Feed) -> None:
    feed.stroke(51, m.Decision.FAILED, quick=True)
    feed.stroke(52, m.Decision.NOT_MEASURED, quick=True)
    page = visit().open("/production")
    products = page.locator(".area-products tbody tr")
    expect(products.first).to_contain_text("A4052")
    page.get_by_label("Verdict").select_option("NOT_MEASURED")
    expect(products.first).to_contain_text("A4052")
    expect(products.locator(".sign.green")).to_have_count(0)
    page.get_by_label("Verdict").select_option("")
    page.get_by_label("Part or stroke").fill("a4051")
    page.keyboard.press("Enter")
    expect(products).to_have_count(1)
    asked = [q for q in feed.asked if isinstance(q, m.AskRecords) and q.search]
    assert {(q.search, q.with_trends) for q in asked} == {("a4051", False)}
    page.get_by_role("button", name="51", exact=True).focus()
    page.keyboard.press("Enter")
    detail = page.locator(".detail")
    expect(detail.locator(".sign.big .word")).to_have_text("FAILED")
    expect(detail.locator(".reason")).to_contain_text("exceeds 0.100 mm")
    expect(detail).to_contain_text("2 (part failed)")
    expect(detail).to_contain_text("20260302-000051")
    detail.get_by_role("button", name="Close").click()
    expect(detail).to_have_count(0)


def test_older_products_come_page_by_page(visit: Callable[..., Visit], feed: Feed) -> None:
    for stroke in range(100, 115):
        feed.stroke(stroke, quick=True)
    page = visit().open("/production")
    products = page.locator(".area-products tbody tr")
    expect(products).to_have_count(50)
    first = products.first.get_attribute("data-id") or ""
    page.get_by_role("button", name="Older").click()
    expect(products.first).not_to_have_attribute("data-id", first)
    assert (products.first.get_attribute("data-id") or "") < first
    expect(page.get_by_role("button", name="Older")).to_be_disabled()
    page.get_by_role("button", name="Newer").click()
    expect(products.first).to_have_attribute("data-id", first)


def test_a_die_service_is_logged_by_maintenance_and_shows_in_the_trend(
    visit: Callable[..., Visit], feed: Feed, accounts: Accounts
) -> None:
    page = visit("mats").open("/production")
    page.get_by_label("Kind").select_option("polish")
    page.get_by_label("Note").fill("radius R3")
    page.get_by_role("button", name="Log the service").click()
    page.locator(".dialog").get_by_role("button", name="Log the service").click()
    expect(page.locator(".area-die tbody tr").first).to_contain_text("polish: radius R3")
    wanted = [q for q in feed.asked if isinstance(q, m.DieEvent)][-1]
    assert (wanted.kind, wanted.note, wanted.user, wanted.object_index) == ("polish", "radius R3", "mats", 1)
    assert accounts.audit(1)[0].deed == "log a die service"
    page = visit("olga").open("/production")
    expect(page.get_by_role("button", name="Log the service")).to_be_disabled()


def test_a_wear_alarm_is_seen_on_every_screen_and_acknowledged_with_a_reason(
    visit: Callable[..., Visit], feed: Feed, accounts: Accounts
) -> None:
    feed.alarm_level = 3
    try:
        page = visit("mats").open("/production")
        expect(page.locator(".fact-wear .sign.red")).to_have_text("action")
        alarm = page.locator(".area-alarms tbody tr").first
        expect(alarm).to_contain_text("limit in fewer than 20 strokes")
        button = page.get_by_role("button", name="Acknowledge")
        button.click()
        expect(page.get_by_role("alert").filter(has_text="says why")).to_be_visible()
        page.get_by_label("Reason").fill("die is ordered")
        button.click()
        expect(alarm).to_contain_text("mats: die is ordered")
        assert accounts.audit(1)[0].detail == "object 1, zone -: die is ordered: done"
        expect(visit("olga").open("/production").get_by_role("button", name="Acknowledge")).to_be_disabled()
    finally:
        feed.alarm_level, feed.acknowledged = 0, ("", "")


def test_where_parts_deviate_is_drawn_as_judge_knows_it(visit: Callable[..., Visit], feed: Feed) -> None:
    page = visit().open("/production")
    surface = page.locator(".area-frequency .surface")
    expect(surface).to_have_attribute("data-painted", re.compile(r"^1-\d+:frequency$"))
    page.locator('button[data-wear-map="growth"]').click()
    expect(surface).to_have_attribute("data-painted", re.compile(":growth$"))
    expect(page.locator(".area-frequency .surface-legend")).to_contain_text("mm/1000")
    expect(page.locator(".area-frequency .age")).to_contain_text("parts since the last service")


def test_administrators_export_all_records_and_nobody_else_does(
    visit: Callable[..., Visit], feed: Feed, accounts: Accounts, hmi: Hmi
) -> None:
    feed.stroke(54, quick=True)
    guest = visit("ada")
    page = guest.open("/production")
    with page.expect_download() as waiting:
        page.get_by_role("link", name="Export as CSV").click()
    rows = list(csv.DictReader(waiting.value.path().read_text(encoding="utf-8-sig").splitlines()))
    assert len(rows) == len(feed._verdicts)
    assert (rows[0]["stroke"], rows[0]["part_id"], rows[0]["told_code"]) == ("54", "A4054", "1")
    assert accounts.audit(1)[0].deed == "export production records"
    for name in ("", "olga", "mats"):
        other = visit(name)
        assert other.context.request.get(hmi.url + "/export/production.csv").status == 403
        expect(other.open("/production").get_by_role("link", name="Export as CSV")).to_have_count(0)


def test_the_log_is_searched_and_exported_by_maintenance(visit: Callable[..., Visit], feed: Feed, hmi: Hmi) -> None:
    feed.event("capture", "warning", "exposure lowered to 9500 us")
    feed.event("judge", "error", "=the disk is full", cycle_id="20260302-000007")
    page = visit("mats").open("/log")
    events = page.locator(".panel", has_text="Events").locator("tbody tr")
    expect(events.filter(has_text="the disk is full").locator(".sign.red")).to_have_text("error")
    page.get_by_label("Text or cycle").fill("000007")
    page.keyboard.press("Enter")
    expect(events).to_have_count(1)
    page.get_by_label("Text or cycle").fill("")
    page.keyboard.press("Enter")
    page.get_by_label("Service").select_option("capture")
    expect(events.filter(has_text="judge")).to_have_count(0)
    expect(events.first).to_contain_text("capture")
    with page.expect_download() as waiting:
        page.get_by_role("link", name="Export as CSV").click()
    text = waiting.value.path().read_text(encoding="utf-8-sig")
    assert ",'=the disk is full," in text, "no spreadsheet may take it for a formula"
    assert visit("olga").context.request.get(hmi.url + "/export/log.csv").status == 403
    expect(page.locator(".panel", has_text="Who did what")).to_have_count(0)


def test_the_process_image_is_watched_by_maintenance_alone(visit: Callable[..., Visit], feed: Feed, hmi: Hmi) -> None:
    page = visit("mats").open("/settings")
    signals = page.locator(".panel", has_text="Inputs and outputs").locator("tbody tr")
    expect(signals.filter(has_text="link_ok").locator("td").nth(4)).to_have_text("1")
    feed.is_link_up = False
    try:
        expect(signals.filter(has_text="link_ok").locator("td").nth(4)).to_have_text("0")
        change = page.locator(".panel", has_text="Watched changes").locator("tbody tr", has_text="link_ok").first
        expect(change.locator("td").nth(2)).to_have_text("True")
        expect(page.locator(".fact-plc .sign.red")).to_have_text("DOWN")
    finally:
        feed.is_link_up = True
    for name in ("", "olga"):
        other = visit(name)
        assert other.context.request.get(hmi.url + "/settings").status == 403
        expect(other.open("/").get_by_role("link", name="Settings")).to_have_count(0)
