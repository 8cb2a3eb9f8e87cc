"""Each screen is open to everybody: WCAG 2.2 AA by axe, keyboard, languages."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, expect

from tests.browser.conftest import Visit
from tests.browser.feed import Feed
from wearline import messages as m

pytestmark = pytest.mark.browser

SCREENS = ("/", "/camera", "/measurement", "/production", "/log", "/settings", "/users", "/help", "/password")
RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]}


def violations(page: Page) -> list[str]:
    """What axe finds, one line each."""
    found = Axe().run(page, options=RULES).response["violations"]
    return [f"{v['id']}: {n['target']} {n.get('failureSummary', '')[:300]}" for v in found for n in v["nodes"]]


@pytest.mark.parametrize(
    ("theme", "screens"),
    [
        ("light", ("/", "/production", "/password")),
        pytest.param("light", SCREENS, marks=pytest.mark.slow),
        pytest.param("dark", SCREENS, marks=pytest.mark.slow),
    ],
)
def test_axe_finds_nothing(theme: str, screens: tuple[str, ...], visit: Callable[..., Visit], feed: Feed) -> None:
    feed.stroke(71, m.Decision.FAILED)
    feed.event("judge", "error", "something")
    guest = visit("ada", theme=theme)
    found: list[str] = []
    page = guest.context.new_page()
    for path in screens:
        page.goto(guest.base + path)
        if path != "/password":
            expect(page.locator(".fact-services .word")).not_to_be_empty()
            expect(page.locator(".screen > *").first).to_be_visible()
        if path in ("/", "/measurement"):
            expect(page.locator(".surface")).not_to_have_attribute("data-painted", "")
        found += [f"{path} {line}" for line in violations(page)]
    assert not found, "\n".join(found)


def test_the_keyboard_reaches_the_content_first_and_every_screen(visit: Callable[..., Visit]) -> None:
    page = visit("ada").open("/")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.textContent") == "Skip to content"
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.className").split()[0] == "screen"
    page.get_by_role("link", name="Camera").focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("link", name="Camera")).to_have_attribute("aria-current", "page")


def test_the_screens_speak_german_and_chinese(visit: Callable[..., Visit], feed: Feed) -> None:
    feed.stroke(72, m.Decision.FAILED)
    for language, word, title in (("de", "SCHLECHT", "Letztes Teil"), ("zh", "不 合 格", "最近零件")):
        page = visit(language=language).open("/")
        expect(page.locator(".verdict .word")).to_have_text(word)
        expect(page.get_by_role("heading", name=title)).to_be_visible()
        assert page.evaluate("document.documentElement.lang") == language


@pytest.mark.slow
def test_a_phone_sees_everything_without_scrolling_sideways(visit: Callable[..., Visit]) -> None:
    guest = visit("ada", size=(390, 800))
    page = guest.context.new_page()
    for path in ("/", "/measurement", "/production"):
        page.goto(guest.base + path)
        expect(page.locator(".screen > *").first).to_be_visible()
        assert page.evaluate("document.documentElement.scrollWidth") <= 390, path
