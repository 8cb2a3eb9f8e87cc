"""The first screen in a real browser."""

from __future__ import annotations

import http.client
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import expect

from tests.browser.conftest import Hmi, Visit, start_hmi, write_cell
from tests.browser.feed import Feed
from wearline import messages as m
from wearline.config import load_cell

pytestmark = pytest.mark.browser

PAINTED = '.surface[data-painted$=":{name}"]'


def test_it_shows_the_cell_and_asks_no_other_machine(visit: Callable[..., Visit], feed: Feed) -> None:
    guest = visit()
    page = guest.open("/")
    feed.stroke(41, m.Decision.FAILED)
    expect(page.locator(".verdict .sign.red .word")).to_have_text("FAILED")
    expect(page.locator(".verdict .shape.cross")).to_be_visible()
    expect(page.locator(".figures dd").first).to_have_text("41")
    expect(page.locator(".area-strokes tbody tr").first).to_contain_text("A4041")
    expect(page.locator(".area-strokes tbody tr").first.locator(".shape.cross")).to_be_visible()
    expect(page.locator('.surface[data-painted="20260302-000041:difference"]')).to_be_attached()
    expect(page.locator(".live")).not_to_have_attribute("data-serial", "-1")
    expect(page.locator(".area-services tr", has_text="judge").locator(".sign.green")).to_have_text("ready")
    expect(page.locator(".area-trend canvas")).to_be_visible()
    expect(page.locator(".chart-words")).to_contain_text("strokes since the last service")
    expect(page.locator(".simulated")).to_be_visible()
    for name in ("standard", "measured", "error"):
        page.locator(f'button[data-map="{name}"]').click()
        expect(page.locator(PAINTED.format(name=name))).to_be_attached()
    feed.stroke(42, m.Decision.PASSED)
    expect(page.locator(".verdict .sign.green .word")).to_have_text("PASSED")
    expect(page.locator(".surface")).to_have_attribute("data-painted", re.compile("^20260302-000042:error$"))
    assert {urlsplit(url).hostname for url in guest.requests if not url.startswith(("data:", "blob:"))} == {"127.0.0.1"}
    assert guest.faults == []


def test_the_surface_is_really_drawn_and_names_the_value_under_the_pointer(
    visit: Callable[..., Visit], feed: Feed
) -> None:
    page = visit().open("/")
    feed.stroke(43)
    page.locator('button[data-map="standard"]').click()
    expect(page.locator('.surface[data-painted="20260302-000043:standard"]')).to_be_attached()
    colours = page.evaluate(
        """() => { const c = document.querySelector('.surface canvas'); const d = document.createElement('canvas');
        [d.width, d.height] = [64, 40]; const g = d.getContext('2d'); g.drawImage(c, 0, 0, 64, 40);
        const p = g.getImageData(0, 0, 64, 40).data; const s = new Set();
        for (let i = 0; i < p.length; i += 4)
          if (p[i + 3] > 200) s.add((p[i] >> 4) * 256 + (p[i + 1] >> 4) * 16 + (p[i + 2] >> 4));
        return s.size; }"""
    )
    assert colours > 20, "a surface that is drawn has many shades"
    box = page.locator(".surface canvas").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 0.45 * box["width"], box["y"] + 0.5 * box["height"])
    tip = page.locator(".surface-tip").inner_text()
    found = re.search(r"([−\d.]+) mm$", tip)
    assert found is not None, tip
    assert 6.0 < float(found[1]) < 8.0, "the plateau of the part"


def test_what_grows_old_is_shown_old(visit: Callable[..., Visit], feed: Feed) -> None:
    page = visit().open("/")
    feed.stroke(44, m.Decision.PASSED)
    expect(page.locator(".verdict .sign.green")).to_be_visible()
    feed.silent.add("judge")
    try:
        # stale_after_s is 5, a silent service is late after 3 and lost after 6.
        expect(page.locator(".old-mark")).to_be_visible(timeout=9000)
        expect(page.locator(".verdict .sign")).to_have_class(re.compile("grey"))
        expect(page.locator(".verdict .sign .word")).to_have_text("PASSED")
        expect(page.locator(".live-age.old")).to_be_visible()
        expect(page.locator(".area-services tr", has_text="judge").locator(".sign.red")).to_have_text("lost")
        expect(page.locator(".fact-services .sign.red")).to_have_text("judge")
    finally:
        feed.silent.discard("judge")
    expect(page.locator(".fact-services .sign.green")).to_be_visible()


def status_of(url: str, **headers: str) -> int:
    place = urlsplit(url)
    connection = http.client.HTTPConnection(place.hostname or "", place.port, timeout=5)
    connection.request("GET", place.path + (f"?{place.query}" if place.query else ""), headers=headers)
    status = connection.getresponse().status
    connection.close()
    return status


def test_strangers_and_unknown_places_are_refused(hmi: Hmi) -> None:
    assert status_of(hmi.url + "/") == 200
    assert status_of(hmi.url + "/nothing") == 404
    assert status_of(hmi.url + "/live/maps/unknown.bin") == 404
    assert status_of(hmi.url + "/static/../web.py") == 404
    assert status_of(hmi.url + "/", Host="evil.example") == 403
    place = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"
    assert status_of(hmi.url + place) == 200
    assert status_of(hmi.url + place, Origin="http://evil.example") == 403


def test_it_stops_at_once_with_a_browser_attached_and_leaves_nothing_behind(
    tmp_path: Path, visit: Callable[..., Visit]
) -> None:
    path = write_cell(tmp_path)
    feed = Feed(load_cell(path))
    try:
        running = start_hmi(path)
        guest = visit()
        guest.base = running.url
        guest.open("/")
        took_s = running.stop()
        assert took_s < 3.0
        assert running.process.returncode == 0, running.log.read_text()
        left = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
        assert {name for name in left if not name.startswith("data/hmi/")} == {"cell.yaml", "hmi.log"}
    finally:
        feed.close()
        shutil.rmtree(tmp_path / "data", ignore_errors=True)


def test_a_taken_port_is_said_in_one_line(tmp_path: Path, hmi: Hmi, feed: Feed) -> None:
    port = urlsplit(hmi.url).port
    path = write_cell(tmp_path, port=port)
    other = Feed(load_cell(path))
    try:
        done = subprocess.run(
            [sys.executable, "-m", "wearline_hmi", "--config", str(path)], capture_output=True, timeout=20, check=False
        )
    finally:
        other.close()
    last = done.stderr.decode().strip().splitlines()[-1]
    assert done.returncode == 2
    assert "cannot listen there" in last
    assert "hmi.port in cell.yaml" in last
