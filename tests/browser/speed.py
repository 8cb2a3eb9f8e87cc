"""How long the screens take: ``python -m tests.browser.speed`` prints medians, the browser drawing in software."""

from __future__ import annotations

import statistics
import tempfile
import threading
import time
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

from tests.browser.conftest import CHROMIUM, NO_DNS, PASSWORD, add_users, start_hmi, write_cell
from tests.browser.feed import MAP_COLS, MAP_ROWS, Feed
from wearline.config import load_cell

ROUNDS = 5
IS_PAINTED = "document.querySelector('.surface')?.dataset.painted"
SWITCH = """async (name) => {
  const surface = document.querySelector('.surface'), start = performance.now();
  document.querySelector(`button[data-map="${name}"]`).click();
  while (!surface.dataset.painted.endsWith(':' + name)) await new Promise((done) => requestAnimationFrame(done));
  return performance.now() - start;
}"""


def measure(browser: Browser, url: str) -> dict[str, list[float]]:
    """What is measured, by name. [ms]"""
    found: dict[str, list[float]] = {"log in to painted part": [], "page to painted part": [], "another map": []}
    for _ in range(ROUNDS):
        context = browser.new_context(viewport={"width": 1280, "height": 800})
        page = context.new_page()
        page.goto(f"{url}/login?next=/measurement")
        page.get_by_label("Name").fill("mats")
        page.get_by_label("Password").fill(PASSWORD)
        start_s = time.perf_counter()
        page.get_by_role("button").click()
        page.wait_for_function(IS_PAINTED, polling="raf")
        found["log in to painted part"].append(1000 * (time.perf_counter() - start_s))
        start_s = time.perf_counter()
        page.goto(f"{url}/measurement")
        page.wait_for_function(IS_PAINTED, polling="raf")
        found["page to painted part"].append(1000 * (time.perf_counter() - start_s))
        for name in ("standard", "measured", "error", "difference"):
            found["another map"].append(page.evaluate(SWITCH, name))
        context.close()
    return found


def main() -> None:
    """A cell with a stroke a second."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        path = write_cell(Path(folder))
        add_users(path)
        feed = Feed(load_cell(path))
        running = start_hmi(path)
        stop = threading.Event()

        def work() -> None:
            stroke = 0
            while not stop.wait(1.0):
                stroke += 1
                feed.stroke(stroke)

        worker = threading.Thread(target=work, daemon=True)
        worker.start()
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox", NO_DNS])
        try:
            for name, times in measure(browser, running.url).items():
                middle, low, high = statistics.median(times), min(times), max(times)
                print(f"{name:<24} median {middle:5.0f} ms ({low:.0f} to {high:.0f}, n = {len(times)})")
            print(f"maps of {MAP_ROWS} x {MAP_COLS} elements, 1280 x 800 pixels, software rendering")
        finally:
            browser.close()
            stop.set()
            worker.join()
            running.stop()
            feed.close()


if __name__ == "__main__":
    main()
