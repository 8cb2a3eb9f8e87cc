"""A real router and buses on loopback, for the tests that talk."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from wearline.bus import Bus, open_router
from wearline.config import CellSettings, RouterSettings

DEADLINE_S = 10.0


class Heard:
    """What arrived, and a way to wait for it that fails instead of hanging."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.items: list[Any] = []

    def __call__(self, *item: Any) -> None:
        with self._changed:
            self.items.append(item[0] if len(item) == 1 else item)
            self._changed.notify_all()

    def wait_for(self, condition: Callable[[list[Any]], bool], within_s: float = DEADLINE_S) -> list[Any]:
        """All that arrived, once the condition holds."""
        with self._changed:
            assert self._changed.wait_for(lambda: condition(self.items), within_s), f"only {self.items}"
            return list(self.items)


def until(condition: Callable[[], bool], within_s: float = DEADLINE_S) -> None:
    """Wait for a condition of the outside world that tells nobody when it changes."""
    pause, end_s = threading.Event(), time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s, "the deadline has gone"
        pause.wait(0.01)


def free_port() -> int:
    """A port that nobody had a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def cell(tmp_path: Path) -> CellSettings:
    """A cell with a port of its own."""
    return CellSettings(cell="c1", data_dir=tmp_path, router=RouterSettings(endpoint=f"tcp/127.0.0.1:{free_port()}"))


@pytest.fixture
def running_router(cell: CellSettings) -> Iterator[CellSettings]:
    """The cell, with its router in this process."""
    session = open_router(cell)
    yield cell
    session.close()  # type: ignore[no-untyped-call]


@pytest.fixture
def join(cell: CellSettings) -> Iterator[Callable[[str], Bus]]:
    """Open buses that are closed at the end."""
    opened: list[Bus] = []

    def open_bus(service: str) -> Bus:
        bus = Bus(cell.cell, service, cell.router.endpoint)
        opened.append(bus)
        bus.open(timeout_s=DEADLINE_S)
        return bus

    yield open_bus
    for bus in opened:
        bus.close()
