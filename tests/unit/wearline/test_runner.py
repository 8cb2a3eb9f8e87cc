"""The loop of a service, on a bus that only notes what is said; and a whole process on a real one."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import pytest

from tests.contract.conftest import DEADLINE_S, Heard, free_port, until
from tests.contract.examples import REQUEST, measure_request
from wearline import messages as m
from wearline import metrics
from wearline.bus import Bus, open_router
from wearline.config import CellSettings, RouterSettings
from wearline.errors import BusError, DeviceError
from wearline.runner import Inbox, Runner, _Arrived
from wearline.service import Asker, Health, Service
from wearline.topics import EVENTS, MEASURE, PREVIEW, STATES, VERDICT, Query, Topic


class NotingBus:
    """A bus without a network; `say` and `ask_it` play the other side."""

    cell, service, instance, is_connected = "c1", "fieldbus", "1-ab", True

    def __init__(self) -> None:
        self.said = Heard()
        self.callbacks: dict[Topic, Callable[[Any], None]] = {}
        self.answerers: dict[Query, Callable[[Any], m.Message]] = {}
        self.alive: Callable[[str, frozenset[str]], None] = lambda name, replicas: None
        self.is_announced = threading.Event()
        self.drops: list[tuple[str, str]] = []

    def publish(self, message: m.Message) -> None:
        self.said(message)

    def subscribe(self, topic: Topic, callback: Callable[[Any], None]) -> None:
        self.callbacks[topic] = callback

    def answer(self, query: Query, fn: Callable[[Any], m.Message]) -> None:
        self.answerers[query] = fn

    def watch_alive(self, callback: Callable[[str, frozenset[str]], None]) -> None:
        self.alive = callback

    def announce(self) -> None:
        self.is_announced.set()

    def count_drop(self, topic: Topic, reason: str) -> None:
        self.drops.append((topic.name, reason))

    def events(self) -> list[str]:
        return [message.text for message in self.said.items if isinstance(message, m.Event)]


def event(text: str) -> m.Event:
    return m.Event(service="fieldbus", level="info", text=text, utc="")


class Probe(Service):
    """Says what it was given."""

    name = "fieldbus"

    def __init__(self) -> None:
        self.threads: set[int] = set()
        self.is_closed = False
        self.ticked = Heard()
        self.at_yield: Callable[[], None] = lambda: None

    def start(self, asker: Asker) -> Iterable[m.Message]:
        self.threads.add(threading.get_ident())
        yield event("started")

    def handlers(self) -> Mapping[Topic, Callable[[Any], Iterable[m.Message]]]:
        return {VERDICT: self.on_verdict, PREVIEW: self.on_verdict}

    def on_verdict(self, message: Any) -> Iterable[m.Message]:
        self.threads.add(threading.get_ident())
        if message == "bad":
            raise DeviceError("does not answer", "PLC", "check the cable")
        yield event(f"first of {message}")
        self.at_yield()
        yield event(f"second of {message}")

    def answers(self) -> Mapping[Query, Callable[[Any], m.Message]]:
        from wearline.topics import MODE

        return {MODE: self.on_mode}

    def on_mode(self, question: m.SetMode) -> m.Message:
        self.threads.add(threading.get_ident())
        if question.mode == "manual":
            raise BusError("not in this state")
        return m.Done(ok=True, text=question.mode)

    def on_alive(self, service: str, is_alive: bool) -> Iterable[m.Message]:
        yield event(f"{service} {is_alive}")

    def on_replicas(self, live: frozenset[str]) -> Iterable[m.Message]:
        yield event(f"replicas {' '.join(sorted(live))}")

    def tick(self, now_s: float) -> Iterable[m.Message]:
        self.threads.add(threading.get_ident())
        self.ticked(now_s)
        return ()

    def health(self) -> Health:
        return Health("ready", "fine", {"plc_link_up": True})

    def close(self) -> None:
        self.is_closed = True


class Running:
    """A probe on its thread."""

    def __init__(self, probe: Probe) -> None:
        self.bus, self.probe = NotingBus(), probe
        self.runner = Runner(probe, cast(Bus, self.bus))
        self.thread = threading.Thread(target=self.runner.run, daemon=True)
        self.thread.start()
        assert self.bus.is_announced.wait(DEADLINE_S)

    def stop(self) -> None:
        self.runner.stop()
        self.thread.join(DEADLINE_S)
        assert not self.thread.is_alive()


@pytest.fixture
def running() -> Iterator[Running]:
    running = Running(Probe())
    yield running
    running.stop()


def test_each_message_is_published_before_the_handler_goes_on(running: Running) -> None:
    seen: list[list[str]] = []
    running.probe.at_yield = lambda: seen.append(running.bus.events())
    running.bus.callbacks[VERDICT]("A")
    running.bus.said.wait_for(lambda items: any("second of A" in str(item) for item in items))
    assert seen[0][-1] == "first of A"


def test_a_failing_handler_is_told_and_the_service_goes_on(running: Running) -> None:
    for message in ("bad", "bad", "good"):
        running.bus.callbacks[VERDICT](message)
    running.bus.said.wait_for(lambda items: any("second of good" in str(item) for item in items))
    errors = [e for e in running.bus.said.items if isinstance(e, m.Event) and e.level == "error"]
    # The second is the same failure within ten seconds.
    assert [error.text for error in errors] == ["verdict: PLC: does not answer; check the cable"]


def test_everything_of_a_service_happens_on_one_thread(running: Running) -> None:
    from wearline.topics import MODE

    running.bus.callbacks[VERDICT]("A")
    assert running.bus.answerers[MODE](m.SetMode(mode="auto")) == m.Done(ok=True, text="auto")
    running.probe.wake()
    running.probe.ticked.wait_for(bool)
    assert running.probe.threads == {running.thread.ident}


def test_a_refused_question_refuses_the_asker_only(running: Running) -> None:
    from wearline.topics import MODE

    with pytest.raises(BusError, match="not in this state"):
        running.bus.answerers[MODE](m.SetMode(mode="manual"))
    assert not [e for e in running.bus.said.items if isinstance(e, m.Event) and e.level == "error"]


def test_a_wake_ticks_at_once() -> None:
    """Without a period, only `wake` makes it tick; then within milliseconds."""
    running = Running(Probe())
    try:
        delays = []
        for count in range(1, 21):
            woken_s = time.monotonic()
            running.probe.wake()
            delays.append(running.probe.ticked.wait_for(lambda items, n=count: len(items) >= n)[-1] - woken_s)  # type: ignore[misc]
        assert sorted(delays)[10] < 0.005
    finally:
        running.stop()


def test_ticks_keep_their_period_while_messages_flow() -> None:
    probe = Probe()
    probe.tick_s = 0.01
    running = Running(probe)
    try:
        for number in range(50):
            running.bus.callbacks[VERDICT](str(number))
        assert len(probe.ticked.wait_for(lambda items: len(items) >= 5)) >= 5
    finally:
        running.stop()


def test_state_and_liveliness_are_told(running: Running) -> None:
    running.bus.alive("judge", frozenset())
    running.bus.said.wait_for(lambda items: any("judge False" in str(item) for item in items))
    running.bus.alive("fieldbus", frozenset({"1-ab", "2-cd"}))
    running.bus.said.wait_for(lambda items: any("replicas 1-ab 2-cd" in str(item) for item in items))
    states = [message for message in running.bus.said.items if isinstance(message, m.ServiceState)]
    assert states[0].status == "ready"
    assert states[0].values == {"plc_link_up": True}
    assert metrics.SERVICE_UP.labels("c1", "judge")._value.get() == 0.0
    assert running.runner.facts()[0]


def test_a_stopped_service_says_so_and_is_closed(running: Running) -> None:
    running.stop()
    assert running.probe.is_closed
    last = running.bus.said.items[-1]
    assert isinstance(last, m.ServiceState)
    assert last.status == "stopping"
    assert not running.runner.facts()[0]


def test_a_service_that_cannot_start_ends() -> None:
    class Broken(Probe):
        def start(self, asker: Asker) -> Iterable[m.Message]:
            raise DeviceError("is not there", "store")

    broken = Broken()
    with pytest.raises(DeviceError):
        Runner(broken, cast(Bus, NotingBus())).run()
    assert broken.is_closed


def test_what_waits_is_bounded_and_the_oldest_goes() -> None:
    inbox = Inbox()
    assert inbox.put(_Arrived(PREVIEW, REQUEST)) is None
    assert inbox.put(_Arrived(PREVIEW, measure_request(8))) is PREVIEW
    inbox.put(_Arrived(MEASURE, measure_request(9)))
    assert [inbox.take(0)[0] for _ in range(3)] == [
        _Arrived(PREVIEW, measure_request(8)),
        _Arrived(MEASURE, measure_request(9)),
        None,
    ]


SERVICE = """
import sys, threading
from wearline.config import Settings
from wearline.runner import main
from wearline.service import Service, Health
from wearline.messages import Done, Event
from wearline.topics import MODE
from wearline.errors import DeviceError

class FieldbusSettings(Settings):
    mood: str = "good"

class Fieldbus(Service):
    name = "fieldbus"
    tick_s = 0.05
    def __init__(self, mood): self.mood = mood
    def answers(self): return {MODE: lambda question: Done(ok=True, text=self.mood)}
    def close(self):
        if self.mood == "hung": threading.Event().wait()

def build(cell, settings):
    if settings.mood == "bad": raise DeviceError("is in a bad mood", "PLC", "wait")
    # A thread that a library forgot.
    threading.Thread(target=threading.Event().wait).start()
    return Fieldbus(settings.mood)

main("fieldbus", FieldbusSettings, build)
"""


@pytest.fixture
def cell(tmp_path: Path) -> CellSettings:
    return CellSettings(
        cell="c1", data_dir=tmp_path, router=RouterSettings(endpoint=f"tcp/127.0.0.1:{free_port()}"),
        metrics_ports={"fieldbus": free_port()},
    )  # fmt: skip


@pytest.fixture
def spawn(cell: CellSettings, tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    started: list[subprocess.Popen[str]] = []

    def start(mood: str = "good", *arguments: str) -> subprocess.Popen[str]:
        path = tmp_path / "cell.yaml"
        path.write_text(json.dumps({**json.loads(cell.model_dump_json()), "fieldbus": {"mood": mood}}))
        command = [sys.executable, "-c", SERVICE, *(arguments or ("--config", str(path)))]
        started.append(subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def healthz(port: int) -> int:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=5) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code
    except OSError:
        return 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_service_lives_and_stops(
    cell: CellSettings, spawn: Callable[..., subprocess.Popen[str]], number: signal.Signals
) -> None:
    from wearline.topics import MODE

    router = open_router(cell)
    bus, states, events = Bus("c1", "hmi", cell.router.endpoint), Heard(), Heard()
    try:
        bus.open(timeout_s=DEADLINE_S)
        bus.subscribe(STATES["fieldbus"], states)
        bus.subscribe(EVENTS["fieldbus"], events)
        process = spawn()
        states.wait_for(lambda items: any(state.status == "ready" for state in items))
        assert bus.ask(MODE, m.SetMode(mode="auto"), timeout_s=DEADLINE_S) == m.Done(ok=True, text="good")
        assert healthz(cell.metrics_ports["fieldbus"]) == 200
        asked_s = time.monotonic()
        process.send_signal(number)
        assert process.wait(timeout=5) == 0
        assert time.monotonic() - asked_s < 1.5
        states.wait_for(lambda items: items[-1].status == "stopping")
    finally:
        bus.close()
        router.close()  # type: ignore[no-untyped-call]


def test_a_service_without_a_router_waits_and_still_stops(
    cell: CellSettings, spawn: Callable[..., subprocess.Popen[str]]
) -> None:
    process = spawn()
    until(lambda: healthz(cell.metrics_ports["fieldbus"]) == 503)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=2) == 0


def test_a_service_that_does_not_close_is_left(cell: CellSettings, spawn: Callable[..., subprocess.Popen[str]]) -> None:
    router = open_router(cell)
    try:
        process = spawn("hung")
        until(lambda: healthz(cell.metrics_ports["fieldbus"]) == 200)
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=3) == 1
    finally:
        router.close()  # type: ignore[no-untyped-call]


def test_a_taken_metrics_port_stops_no_measurement(
    cell: CellSettings, spawn: Callable[..., subprocess.Popen[str]]
) -> None:
    router = open_router(cell)
    bus, states = Bus("c1", "hmi", cell.router.endpoint), Heard()
    with socket.create_server(("127.0.0.1", cell.metrics_ports["fieldbus"])):
        try:
            bus.open(timeout_s=DEADLINE_S)
            bus.subscribe(STATES["fieldbus"], states)
            spawn()
            states.wait_for(lambda items: any(state.status == "ready" for state in items))
        finally:
            bus.close()
            router.close()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize(
    ("mood", "arguments", "said"),
    [
        ("bad", (), "PLC: is in a bad mood; wait"),
        (7, (), "fieldbus: mood: Input should be a valid string"),
        ("good", ("--schema", "--bogus"), "unrecognized arguments: --bogus"),
        ("good", ("--check-config",), "--config is missing"),
    ],
)
def test_what_cannot_run_says_why_in_one_line(
    spawn: Callable[..., subprocess.Popen[str]], mood: Any, arguments: tuple[str, ...], said: str
) -> None:
    process = spawn(mood, *arguments)
    out, err = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 2
    lines = [line for line in err.splitlines() if not line.startswith("{")]
    assert len(lines) == 1
    assert lines[0].startswith("wearline: ")
    assert said in lines[0]
    assert out == ""


def test_schema_and_check_need_no_cell_that_runs(spawn: Callable[..., subprocess.Popen[str]], tmp_path: Path) -> None:
    out, err = spawn("good", "--schema").communicate(timeout=DEADLINE_S)
    assert json.loads(out)["title"] == "FieldbusSettings"
    out, err = spawn("good", "--config", str(tmp_path / "cell.yaml"), "--check-config").communicate(timeout=DEADLINE_S)
    assert (out, err) == (f"{tmp_path}/cell.yaml: fieldbus is valid\n", "")
