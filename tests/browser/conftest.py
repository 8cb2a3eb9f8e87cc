"""A cell with a fake feed, the hmi in a process of its own, and a browser that knows no other machine."""

from __future__ import annotations

import os
import signal
import ssl
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from argon2 import PasswordHasher
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

from tests.browser.feed import Feed
from tests.contract.conftest import free_port, until
from wearline.config import load_cell
from wearline_hmi.core.rights import Role
from wearline_hmi.drivers.accounts import Accounts
from wearline_hmi.pages.gate import COOKIE
from wearline_hmi.service import HISTORY_S

CHROMIUM = Path("/usr/bin/chromium")
NO_DNS = "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1"


@dataclass
class Hmi:
    """A running web interface."""

    process: subprocess.Popen[bytes]
    url: str
    log: Path

    def stop(self) -> float:
        """Send SIGTERM and return how long it took to end. [s]"""
        start_s = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(timeout=5)
        return time.monotonic() - start_s


def answers(url: str, trusting: ssl.SSLContext | None = None) -> bool:
    """Whether something serves there."""
    try:
        with urllib.request.urlopen(url, timeout=1, context=trusting):
            return True
    except OSError:
        return False


def write_cell(folder: Path, **hmi: object) -> Path:
    """A cell.yaml with ports of its own."""
    path = folder / "cell.yaml"
    content = {
        "cell": "press-7",
        "data_dir": "data",
        "router": {"endpoint": f"tcp/127.0.0.1:{free_port()}"},
        "hmi": {
            "port": free_port(),
            "stale_after_s": 5.0,
            "records_period_s": 1.0,
            "view_without_login": True,
            **hmi,
        },
    }
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


PASSWORD = "tulip-anvil-94-fog"
USERS = {"olga": Role.OPERATOR, "mats": Role.MAINTENANCE, "ada": Role.ADMINISTRATOR}


def accounts_of(path: Path) -> Accounts:
    """The users of a cell, as its hmi keeps them."""
    return Accounts(load_cell(path).data_folder("hmi") / "accounts.db", 3600.0, 43200.0)


def add_users(path: Path) -> None:
    """One user of each group."""
    accounts, secret = accounts_of(path), PasswordHasher().hash(PASSWORD)
    for name, role in USERS.items():
        accounts.add(name, role, secret, must_change=False)
    accounts.close()


def start_hmi(path: Path, trusting: ssl.SSLContext | None = None) -> Hmi:
    """Run the service and wait until it serves; with a context by https."""
    log = path.parent / "hmi.log"
    with log.open("wb") as stream:
        process = subprocess.Popen(
            [sys.executable, "-m", "wearline_hmi", "--config", str(path)],
            stdout=stream, stderr=stream, cwd=path.parent, env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )  # fmt: skip
    url = f"http{'s' if trusting else ''}://127.0.0.1:{load_cell(path).hmi['port']}"
    until(lambda: process.poll() is not None or answers(url + "/static/wearline.svg", trusting), 30)
    assert process.poll() is None, log.read_text()
    return Hmi(process, url, log)


@pytest.fixture(scope="package")
def cell_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = write_cell(tmp_path_factory.mktemp("cell"))
    add_users(path)
    return path


@pytest.fixture(scope="package")
def accounts(cell_path: Path) -> Iterator[Accounts]:
    """The users of the running hmi, reached past it."""
    found = accounts_of(cell_path)
    yield found
    found.close()


@pytest.fixture(scope="package")
def feed(cell_path: Path) -> Iterator[Feed]:
    """Forty strokes of a wearing die are recorded."""
    feed = Feed(load_cell(cell_path))
    for stroke in range(1, 41):
        feed.stroke(stroke, quick=True)
    yield feed
    feed.close()


@pytest.fixture(scope="package")
def hmi(cell_path: Path, feed: Feed) -> Iterator[Hmi]:
    running = start_hmi(cell_path)
    # What it hears in its first moments may be history of unknown age, and is shown as such.
    history_ends_s = time.monotonic() + HISTORY_S + 0.3
    until(lambda: time.monotonic() > history_ends_s)
    yield running
    running.stop()


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Chromium, or a skip where there is none."""
    if not CHROMIUM.exists():
        pytest.skip("needs Debian's chromium")
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox", NO_DNS])
        yield running
        running.close()


@dataclass
class Visit:
    """One browser context with its own cookies; notes what it asked for and what went wrong."""

    context: BrowserContext
    base: str
    requests: list[str]
    faults: list[str]

    def open(self, path: str = "/") -> Page:
        """Load a page and wait until its socket is there."""
        page = self.context.new_page()
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        page.on("console", lambda said: self.faults.append(said.text) if said.type == "error" else None)
        page.goto(self.base + path)
        page.wait_for_function("() => window.socket?.connected", timeout=10000)
        return page


@pytest.fixture
def visit(browser: Browser, hmi: Hmi, accounts: Accounts) -> Iterator[Callable[..., Visit]]:
    """`visit("mats", theme="dark", language="de", size=(1920, 1080))` opens a fresh browser context; "" looks only."""
    opened: list[BrowserContext] = []

    def make(name: str = "", theme: str = "light", language: str = "en", size: tuple[int, int] = (1280, 800)) -> Visit:
        context = browser.new_context(viewport={"width": size[0], "height": size[1]})
        if name:
            user = accounts.user(name)
            assert user is not None
            token = accounts.open_session(user, "127.0.0.1")
            context.add_cookies([{"name": COOKIE, "value": token, "url": hmi.url}])
        context.set_default_timeout(10000)
        context.add_cookies([{"name": "wearline_look", "value": f"{theme}.{language}", "url": hmi.url}])
        opened.append(context)
        return Visit(context, hmi.url, [], [])

    yield make
    for context in opened:
        context.close()
