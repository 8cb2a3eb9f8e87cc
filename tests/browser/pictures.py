"""The pictures of the screens in docs/pictures: ``python -m tests.browser.pictures`` makes them anew."""

from __future__ import annotations

import io
import tempfile
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, sync_playwright

from tests.browser.conftest import CHROMIUM, NO_DNS, accounts_of, add_users, start_hmi, write_cell
from tests.browser.feed import Feed
from wearline.config import load_cell
from wearline_hmi.pages.gate import COOKIE

FOLDER = Path(__file__).resolve().parent.parent.parent / "docs" / "pictures"
SCREENS = ("overview", "camera", "measurement", "production", "log", "settings", "users", "help", "login")
LOOKS = (("light", "en"), ("dark", "de"))
SIZES = ((1280, 800), (1920, 1080))
MAX_BYTES = 195_000


def small_png(picture: bytes) -> bytes:
    """The picture with as many colours as its size allows; grain that packs badly is made smaller in the end."""
    full = Image.open(io.BytesIO(picture)).convert("RGB")
    smaller = full.resize((full.width * 3 // 4, full.height * 3 // 4), Image.Resampling.LANCZOS)
    for colours, shown in ((256, full), (128, full), (64, full), (32, full), (128, smaller), (32, smaller)):
        stream = io.BytesIO()
        shown.quantize(colours, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
        if stream.tell() <= MAX_BYTES:
            break
    return stream.getvalue()


def take(browser: Browser, url: str, token: str) -> None:
    """Every screen in both looks and sizes."""
    for theme, language in LOOKS:
        for width, height in SIZES:
            context = browser.new_context(viewport={"width": width, "height": height})
            context.add_cookies(
                [
                    {"name": "wearline_look", "value": f"{theme}.{language}", "url": url},
                    {"name": COOKIE, "value": token, "url": url},
                ]
            )
            for name in SCREENS:
                if name == "login":
                    context.clear_cookies(name=COOKIE)
                page = context.new_page()
                page.goto(f"{url}/{'' if name == 'overview' else name}")
                if name in ("overview", "measurement", "production"):
                    page.wait_for_function("document.querySelector('.surface')?.dataset.painted", timeout=30000)
                if name in ("overview", "camera"):
                    page.wait_for_function("+document.querySelector('.live')?.dataset.serial >= 0", timeout=30000)
                # Tables and charts that are filled by the first answers.
                page.wait_for_timeout(2500)
                (FOLDER / f"{name}-{theme}-{width}.png").write_bytes(small_png(page.screenshot()))
                page.close()
            context.close()


def main() -> None:
    """A cell with a worn die, a failed part, events and two watched signals."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        path = write_cell(Path(folder), stale_after_s=3600.0)
        add_users(path)
        accounts = accounts_of(path)
        user = accounts.user("ada")
        assert user is not None
        token = accounts.open_session(user, "127.0.0.1")
        feed = Feed(load_cell(path))
        for stroke in range(1, 58):
            feed.stroke(stroke, quick=True)
        running = start_hmi(path)
        time.sleep(3)
        for stroke in range(58, 64):
            feed.stroke(stroke)
            time.sleep(0.7)
        feed.event("capture", "warning", "exposure lowered to 9500 us")
        feed.event("judge", "info", "object 1: version 3, taught from 3 parts")
        accounts.note("ada", "10.0.0.4", "log in")
        accounts.note("mats", "10.0.0.7", "set the camera", "exposure 10000 -> 9500 us, gain 0 -> 0 dB: done")
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox", NO_DNS])
        try:
            take(browser, running.url, token)
        finally:
            browser.close()
            running.stop()
            feed.close()
            accounts.close()


if __name__ == "__main__":
    main()
