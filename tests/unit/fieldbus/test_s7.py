"""The S7 driver and its thread against python-snap7's server, through a network that fails."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest

from tests.contract.conftest import free_port, until
from tests.faults.tcp_proxy import READ, WRITE, Proxy, function_of
from wearline.errors import DeviceError
from wearline_fieldbus.drivers.memory import MemoryPlc
from wearline_fieldbus.drivers.plc import (
    ImageRead,
    LinkDown,
    LinkEvent,
    LinkUp,
    PlcLink,
    WriteDone,
    WriteSkipped,
)
from wearline_fieldbus.drivers.s7 import CONNECTION, RACK_SLOT, S7Plc, S7Settings
from wearline_fieldbus.drivers.s7_server import S7Server

TIMEOUT_S = 0.2
LONGEST_S = 1.0
"""No operation may block longer: the time-out, and what a busy machine adds. python-snap7 alone takes 5 s and more;
that the default time-out keeps below 0.5 s is measured by ``make plc-faults``."""


@pytest.fixture
def server() -> Iterator[S7Server]:
    found = S7Server("127.0.0.1", 0, 100, 20)
    yield found
    found.close()


@pytest.fixture
def proxy(server: S7Server) -> Iterator[Proxy]:
    found = Proxy(server.port)
    yield found
    found.close()


def plc(port: int, **settings: int) -> S7Plc:
    return S7Plc(S7Settings(port=port, **settings), 20, TIMEOUT_S)  # type: ignore[arg-type]


def connects(port: S7Plc) -> bool:
    """Whether it connects now; a busy machine may need more than one short time-out."""
    try:
        port.connect()
    except DeviceError:
        return False
    return True


def timed(what: Callable[[], object], error: str) -> float:
    """How long it takes to fail with this sentence. [s]"""
    began = time.monotonic()
    with pytest.raises(DeviceError, match=error):
        what()
    return time.monotonic() - began


def test_reads_and_writes_in_one_piece(server: S7Server) -> None:
    port = plc(server.port)
    port.connect()
    assert port.read() == bytes(20)
    port.write(10, b"\x01\x02")
    with server.memory() as memory:
        assert memory[10:12] == b"\x01\x02"
        memory[0:2] = b"\xaa\x55"
    assert port.read()[:2] == b"\xaa\x55"
    port.close()
    with pytest.raises(DeviceError, match="not connected"):
        port.read()


@pytest.mark.parametrize(
    ("db", "size", "sentence"),
    [(101, 20, "DB100 cannot be read.*Object does not exist.*PUT/GET"), (100, 19, "at least 20 bytes.*optimised")],
)
def test_the_check_at_the_start_names_the_cure(db: int, size: int, sentence: str) -> None:
    wrong = S7Server("127.0.0.1", 0, db, size)
    try:
        assert timed(plc(wrong.port).connect, sentence) < LONGEST_S
    finally:
        wrong.close()


def test_nobody_there_is_a_sentence() -> None:
    assert timed(plc(free_port()).connect, r"PLC 127\.0\.0\.1:\d+: does not connect.*rack 0, slot 1") < LONGEST_S


def test_two_servers_on_one_port_are_refused(server: S7Server) -> None:
    with pytest.raises(DeviceError, match="cannot serve on port"):
        S7Server("127.0.0.1", server.port, 100, 20)


def test_rack_slot_and_resource_follow_the_cpu_family() -> None:
    assert RACK_SLOT["s7-300"] == (0, 2) and RACK_SLOT["s7-1500"] == (0, 1) and CONNECTION["basic"] == 3
    assert S7Plc(S7Settings(family="s7-300"), 20, 0.3)._remote_tsap == 0x0302
    assert S7Plc(S7Settings(family="s7-400", slot=4, rack=1, connection="op"), 20, 0.3)._remote_tsap == 0x0224


@pytest.mark.parametrize("fault", ["swallow", "hold", "hold_answers", "drip", "refuse"])
def test_no_operation_blocks_longer_than_its_time_out(proxy: Proxy, fault: str) -> None:
    port = plc(proxy.port)
    proxy.fault(fault)
    assert timed(port.connect, "does not connect") < LONGEST_S
    proxy.fault("pass")
    for operation in (port.read, lambda: port.write(10, bytes(10))):
        until(lambda: connects(port))
        proxy.fault(fault)
        if fault == "refuse":
            proxy.cut()
        assert timed(operation, "DB100 cannot be") < LONGEST_S
        proxy.fault("pass")
        assert timed(operation, "not connected") < TIMEOUT_S, "after any fault the connection is another one"


def test_a_write_is_never_repeated(server: S7Server, proxy: Proxy) -> None:
    writes: list[bytes] = []

    def cut_after_write(request: bytes) -> None:
        if function_of(request) == WRITE:
            writes.append(request)
            proxy.fault("hold_answers")

    proxy.on_request = cut_after_write
    port = plc(proxy.port)
    until(lambda: connects(port))
    assert timed(lambda: port.write(10, b"\x07"), "cannot be written") < LONGEST_S
    proxy.fault("pass")
    until(lambda: connects(port))
    assert port.read()[10] == 7, "it had arrived"
    assert len(writes) == 1


class Told:
    """Collects the events of a link and waits for one."""

    def __init__(self, link: PlcLink) -> None:
        self.link = link
        self.events: list[LinkEvent] = []
        self._woken = threading.Event()
        link.wake = self._woken.set

    def wait(self, kind: type[LinkEvent], count: int = 1, within_s: float = 5.0) -> list[LinkEvent]:
        """All events of a kind, once there are so many."""
        end = time.monotonic() + within_s
        while True:
            self.events += [e for e in self.link.take() if not isinstance(e, ImageRead) or kind is ImageRead]
            found: list[LinkEvent] = [e for e in self.events if isinstance(e, kind)]
            if len(found) >= count:
                return found
            assert self._woken.wait(max(0.0, end - time.monotonic())), f"only {self.events}"
            self._woken.clear()


@pytest.fixture
def link(proxy: Proxy) -> Iterator[PlcLink]:
    # Patient: a busy machine must not cut the connection that a test is about.
    patient = S7Plc(S7Settings(port=proxy.port), 20, 5.0)
    found = PlcLink(patient, poll_s=0.005, quiet=frozenset((8, 9, 11)))
    yield found
    found.close()


def linked(told: Told, count: int = 1) -> int:
    """The number of the connection, once it stands."""
    event = told.wait(LinkUp, count)[-1]
    assert isinstance(event, LinkUp)
    return event.connection


def test_the_link_polls_writes_and_comes_back_after_a_cut(server: S7Server, proxy: Proxy, link: PlcLink) -> None:
    told = Told(link)
    link.start()
    connection = linked(told)
    link.write(connection, 10, b"\x01", token=1)
    assert told.wait(WriteDone) == [told.events[-1]]
    with server.memory() as memory:
        assert memory[10] == 1
        memory[0] = 4
    images = told.wait(ImageRead)
    assert isinstance(images[-1], ImageRead)
    until(lambda: any(isinstance(e, ImageRead) and e.content[0] == 4 and e.writes == 1 for e in told.wait(ImageRead)))
    proxy.cut()
    assert "connected anew" in told.wait(LinkDown)[0].reason  # type: ignore[union-attr]
    link.write(connection, 10, b"\x63", token=2)
    again = linked(told, 2)
    assert again != connection
    link.write(again, 11, b"\x02", token=3)
    told.wait(WriteDone, 2)
    with server.memory() as memory:
        assert memory[10:12] == b"\x01\x02", "what was meant for the lost connection was not written"
    assert not [e for e in told.events if isinstance(e, WriteSkipped)] and link.fault == ""


def test_a_write_whose_time_has_gone_is_skipped(link: PlcLink) -> None:
    told = Told(link)
    link.start()
    link.write(linked(told), 10, b"\x05", token=9, not_after_s=time.monotonic() - 0.001)
    assert told.wait(WriteSkipped) == [WriteSkipped(9)]


def test_a_hung_plc_is_noticed_and_found_again(proxy: Proxy) -> None:
    link = PlcLink(plc(proxy.port), poll_s=0.005, quiet=frozenset((8, 9, 11)))
    told = Told(link)
    link.start()
    count = len(told.wait(LinkUp))
    proxy.fault("swallow")
    told.wait(LinkDown)
    proxy.fault("pass")
    linked(told, count + 1)
    link.close()
    assert link.longest_s < LONGEST_S


def test_only_life_counters_that_move_wake_nobody() -> None:
    port = MemoryPlc(20)
    link = PlcLink(port, poll_s=0.001, quiet=frozenset((8, 9, 11)))
    wakes: list[float] = []
    link.wake = lambda: wakes.append(time.monotonic())
    link.start()
    until(lambda: len(wakes) == 1)
    port.put(8, b"\x12\x34")
    until(lambda: any(isinstance(e, ImageRead) and e.content[8:10] == b"\x12\x34" for e in link.take()))
    assert len(wakes) == 1
    port.put(7, b"\x01")
    until(lambda: len(wakes) == 2)
    link.close()


class Buggy(MemoryPlc):
    """A driver with a fault of its own."""

    def read(self) -> bytes:
        raise KeyError("a bug")


def test_a_fault_of_the_driver_itself_does_not_end_the_polling() -> None:
    link = PlcLink(Buggy(20), poll_s=0.001, quiet=frozenset())
    link.start()
    until(lambda: "KeyError" in link.fault)
    assert link._thread.is_alive()
    link.close()
    assert not link._thread.is_alive()


def test_the_proxy_sees_reads_and_writes(proxy: Proxy) -> None:
    seen: set[int] = set()
    proxy.on_request = lambda request: seen.add(function_of(request))
    port = plc(proxy.port)
    port.connect()
    port.write(10, b"\x00")
    assert {READ, WRITE} <= seen
