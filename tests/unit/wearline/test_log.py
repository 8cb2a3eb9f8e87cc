"""One record is one line."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator

import pytest

from wearline.log import start_log


@pytest.fixture(autouse=True)
def root_as_it_was() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


def fail() -> None:
    try:
        raise ValueError("no\nluck")
    except ValueError:
        logging.getLogger("probe").exception("it\nfailed")


def test_json_lines(capsys: pytest.CaptureFixture[str]) -> None:
    start_log("c1", "judge", "json")
    fail()
    shown = capsys.readouterr().err
    assert shown.count("\n") == 1
    entry = json.loads(shown)
    assert (entry["cell"], entry["service"], entry["level"], entry["text"]) == ("c1", "judge", "error", "it\nfailed")
    assert "ValueError" in entry["traceback"]


def test_plain_lines(capsys: pytest.CaptureFixture[str]) -> None:
    start_log("c1", "judge", "plain")
    fail()
    shown = capsys.readouterr().err
    assert shown.count("\n") == 1
    assert "ERROR   probe: it failed [ValueError: no luck at " in shown
