"""The bus against a real router on loopback."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from tests.contract.conftest import DEADLINE_S, Heard, free_port, until
from tests.contract.examples import CYCLE, OUTCOME, REQUEST, VERDICT, measure_request
from wearline import messages as m
from wearline import metrics
from wearline.bus import Bus, open_router
from wearline.config import CellSettings
from wearline.errors import BusError, MessageError, RecordError
from wearline.topics import DO_MEASURE, FRAME, MEASURE, MODE, RECIPE, RECIPE_LIST
from wearline.topics import OUTCOME as OUTCOMES
from wearline.topics import VERDICT as VERDICTS

Join = Callable[[str], Bus]


def frame(counter: int) -> m.Frame:
    return m.Frame(
        **CYCLE, request=REQUEST, camera="sim", pixels=np.full((1224, 1624), counter % 256, np.uint8), exposure_us=1.0,
        frame_counter=counter,
    )  # fmt: skip


def test_a_large_frame_arrives_as_it_was_sent(running_router: CellSettings, join: Join) -> None:
    capture, heard = join("capture"), Heard()
    join("reconstruct").subscribe(FRAME, heard)
    # The subscription is known to the publisher once its first message arrives.
    until(lambda: capture.publish(frame(0)) is FRAME and bool(heard.items))
    capture.publish(frame(77))
    got = heard.wait_for(lambda items: items[-1].frame_counter == 77)[-1]
    assert got.pixels.shape == (1224, 1624)
    assert got.pixels.dtype == np.uint8
    assert (got.pixels == 77).all()


def test_a_late_joiner_gets_what_is_kept(running_router: CellSettings, join: Join) -> None:
    judge, heard = join("judge"), Heard()
    for number in range(5):
        judge.publish(VERDICT.replace(reason=str(number)))
    join("fieldbus").subscribe(VERDICTS, heard)
    got = heard.wait_for(lambda items: len(items) == 5)
    assert [verdict.reason for verdict in got] == ["0", "1", "2", "3", "4"]


def test_a_late_joiner_measures_no_stroke_that_has_gone(running_router: CellSettings, join: Join) -> None:
    fieldbus, heard = join("fieldbus"), Heard()
    fieldbus.publish(measure_request(1))
    assert MEASURE.keep_s is not None
    end_s = time.monotonic() + MEASURE.keep_s + 0.2
    until(lambda: time.monotonic() > end_s)
    fieldbus.publish(measure_request(2))
    join("capture").subscribe(MEASURE, heard)
    assert [request.stroke for request in heard.wait_for(bool)] == [2]


@pytest.fixture
def killable_router(cell: CellSettings) -> Iterator[Callable[[], subprocess.Popen[bytes]]]:
    """Starts the router of the cell as a process of its own."""
    path = cell.data_dir / "cell.yaml"
    path.write_text(f"cell: c1\ndata_dir: .\nrouter: {{endpoint: '{cell.router.endpoint}'}}\n")
    started: list[subprocess.Popen[bytes]] = []

    def start() -> subprocess.Popen[bytes]:
        started.append(
            subprocess.Popen(
                [sys.executable, "-m", "wearline", "router", "--config", str(path)], stderr=subprocess.PIPE
            )
        )
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


def test_nothing_kept_is_lost_when_the_router_is_killed(
    cell: CellSettings, join: Join, killable_router: Callable[[], subprocess.Popen[bytes]]
) -> None:
    """With a topic that has no age: a request for a stroke that has gone is dropped on purpose."""
    router = killable_router()
    fieldbus, capture, heard, alive = join("fieldbus"), join("capture"), Heard(), Heard()
    capture.subscribe(OUTCOMES, heard)
    capture.watch_alive(alive)
    fieldbus.answer(MODE, lambda question: m.Done(ok=True, text=question.mode))
    fieldbus.announce()
    alive.wait_for(lambda items: items == [("fieldbus", frozenset({fieldbus.instance}))])
    fieldbus.publish(OUTCOME)
    heard.wait_for(lambda items: len(items) == 1)

    router.kill()
    router.wait()
    until(lambda: not fieldbus.is_connected and not capture.is_connected)
    for code in (3, 10, 11):
        fieldbus.publish(OUTCOME.replace(code=code))
    killable_router()

    got = heard.wait_for(lambda items: len(items) == 4)
    assert [outcome.code for outcome in got] == [2, 3, 10, 11]
    back = ("fieldbus", frozenset({fieldbus.instance}))
    alive.wait_for(lambda items: items[-1] == back and ("fieldbus", frozenset()) in items)
    assert capture.ask(MODE, m.SetMode(mode="auto"), timeout_s=DEADLINE_S) == m.Done(ok=True, text="auto")


def test_the_router_stops_on_a_signal(join: Join, killable_router: Callable[[], subprocess.Popen[bytes]]) -> None:
    router = killable_router()
    join("hmi")
    router.send_signal(signal.SIGTERM)
    assert router.wait(timeout=3) == 0


ANNOUNCES = """
import sys, threading
from wearline.bus import Bus
bus = Bus("c1", "judge", sys.argv[1])
bus.open(timeout_s=10)
bus.announce()
threading.Event().wait()
"""


def test_a_killed_service_is_missed_at_once(running_router: CellSettings, join: Join) -> None:
    alive = Heard()
    join("hmi").watch_alive(alive)
    process = subprocess.Popen([sys.executable, "-c", ANNOUNCES, running_router.router.endpoint])
    try:
        alive.wait_for(lambda items: len(items) == 1 and len(items[0][1]) == 1)
        killed_s = time.monotonic()
        process.kill()
        alive.wait_for(lambda items: items[-1] == ("judge", frozenset()))
        assert time.monotonic() - killed_s < 1.0
    finally:
        process.kill()
        process.wait()


def test_a_hung_service_is_missed_after_its_lease(running_router: CellSettings, join: Join) -> None:
    """Goes red with Zenoh's own lease of 10 s."""
    alive = Heard()
    join("hmi").watch_alive(alive)
    process = subprocess.Popen([sys.executable, "-c", ANNOUNCES, running_router.router.endpoint])
    try:
        alive.wait_for(lambda items: len(items) == 1 and len(items[0][1]) == 1)
        os.kill(process.pid, signal.SIGSTOP)
        alive.wait_for(lambda items: items[-1] == ("judge", frozenset()), within_s=5.0)
    finally:
        process.kill()
        process.wait()


def test_replicas_of_one_service_are_told_apart(running_router: CellSettings, join: Join) -> None:
    alive, first, second = Heard(), join("reconstruct"), join("reconstruct")
    join("hmi").watch_alive(alive)
    first.announce()
    alive.wait_for(lambda items: items[-1:] == [("reconstruct", frozenset({first.instance}))])
    second.announce()
    alive.wait_for(lambda items: items[-1] == ("reconstruct", frozenset({first.instance, second.instance})))
    first.close()
    alive.wait_for(lambda items: items[-1] == ("reconstruct", frozenset({second.instance})))


LISTENS = """
import sys, threading
from wearline.bus import Bus
from wearline.topics import FRAME
bus = Bus("c1", "hmi", sys.argv[1])
bus.open(timeout_s=10)
bus.subscribe(FRAME, lambda frame: None)
bus.announce()
threading.Event().wait()
"""


def test_a_hung_subscriber_holds_nobody_up(running_router: CellSettings, join: Join) -> None:
    """Goes red with Zenoh's own `wait_before_close` of 5 s."""
    capture, heard, alive = join("capture"), Heard(), Heard()
    arrived_s: list[float] = []

    def take(got: m.Frame) -> None:
        arrived_s.append(time.monotonic())
        heard(got.frame_counter)

    join("reconstruct").subscribe(FRAME, take)
    capture.watch_alive(alive)
    process = subprocess.Popen([sys.executable, "-c", LISTENS, running_router.router.endpoint])
    try:
        alive.wait_for(lambda items: any(name == "hmi" for name, _ in items))
        capture.publish(frame(0))
        heard.wait_for(lambda items: items == [0])
        os.kill(process.pid, signal.SIGSTOP)
        for counter in range(1, 31):
            capture.publish(frame(counter))
        heard.wait_for(lambda items: len(items) == 31, within_s=20.0)
    finally:
        process.kill()
        process.wait()
    gaps = np.diff(arrived_s)
    assert gaps.max() < 3.5, f"a healthy subscriber waited {gaps.max():.1f} s"


def test_a_stop_is_heard_while_a_server_never_answers() -> None:
    """Goes red with Zenoh's own `open_timeout` of 10 s."""
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        bus, stop = Bus("c1", "hmi", f"tcp/127.0.0.1:{silent.getsockname()[1]}"), threading.Event()
        thread = threading.Thread(target=lambda: bus.open(stop), daemon=True)
        thread.start()
        connection, _ = silent.accept()
        stop.set()
        thread.join(timeout=3.0)
        connection.close()
        assert not thread.is_alive()


def test_questions_are_answered_and_refused(running_router: CellSettings, join: Join) -> None:
    judge, hmi = join("judge"), join("hmi")

    def recipe(question: m.AskRecipe) -> m.Message:
        if question.object_index == 9:
            raise RecordError("object 9 is not in the object list", "records", "teach it")
        if question.object_index == 8:
            raise ZeroDivisionError("division by zero")
        return m.ObjectRecipe(
            object_index=question.object_index, object_name="", recipe_yaml="", recipe_hash="", calibration_hash="",
            template_hash="", version=1,
        )  # fmt: skip

    judge.answer(RECIPE, recipe)
    answer = hmi.ask(RECIPE, m.AskRecipe(object_index=3), "3", timeout_s=DEADLINE_S)
    assert isinstance(answer, m.ObjectRecipe)
    assert answer.object_index == 3
    with pytest.raises(BusError, match="records: object 9 is not in the object list; teach it"):
        hmi.ask(RECIPE, m.AskRecipe(object_index=9), "9", timeout_s=DEADLINE_S)
    with pytest.raises(BusError, match=r"judge failed .ZeroDivisionError"):
        hmi.ask(RECIPE, m.AskRecipe(object_index=8), "8", timeout_s=DEADLINE_S)
    with pytest.raises(MessageError, match="asks AskRecipe"):
        hmi.ask(RECIPE, m.Ping(), "3")


def test_an_empty_answer_is_a_failure(running_router: CellSettings, join: Join) -> None:
    with pytest.raises(BusError, match="nobody answers; is judge running"):
        join("hmi").ask(RECIPE_LIST, m.Ping())


def test_a_slow_answer_is_a_failure_in_time(running_router: CellSettings, join: Join) -> None:
    release = threading.Event()

    def never(question: m.DoMeasure) -> m.Message:
        release.wait(DEADLINE_S)
        return m.Done(ok=True)

    join("fieldbus").answer(DO_MEASURE, never)
    hmi, asked_s = join("hmi"), time.monotonic()
    try:
        with pytest.raises(BusError, match=r"no answer within 0\.3 s"):
            hmi.ask(DO_MEASURE, m.DoMeasure(), timeout_s=0.3)
        assert time.monotonic() - asked_s < 2.0
    finally:
        release.set()


def test_a_message_of_another_version_is_counted_and_left_out(
    running_router: CellSettings, join: Join, monkeypatch: pytest.MonkeyPatch
) -> None:
    fieldbus, heard = join("fieldbus"), Heard()
    join("capture").subscribe(MEASURE, heard)
    dropped = metrics.DROPPED.labels("c1", "capture", "measure", "bad_message")
    before = dropped._value.get()
    with monkeypatch.context() as patch:
        patch.setattr("wearline.bus.encode", lambda message: (b'{"message":"Verdict","shape":null,"fields":{}}', b""))
        fieldbus.publish(measure_request(1))
    fieldbus.publish(measure_request(2))
    assert [request.stroke for request in heard.wait_for(bool)] == [2]
    assert dropped._value.get() == before + 1


def test_a_stop_is_heard_while_there_is_no_router() -> None:
    bus, stop = Bus("c1", "hmi", f"tcp/127.0.0.1:{free_port()}"), threading.Event()
    opened: list[bool] = []
    thread = threading.Thread(target=lambda: opened.append(bus.open(stop)))
    thread.start()
    stop.set()
    thread.join(timeout=2.0)
    assert opened == [False]
    with pytest.raises(BusError, match="no router answers"):
        bus.open(timeout_s=0.2)


def test_a_router_whose_port_is_taken_says_so(running_router: CellSettings) -> None:
    with pytest.raises(BusError, match=r"router cannot listen there; free the port or change router.endpoint"):
        open_router(running_router)


def test_shared_memory_and_scouting_are_off() -> None:
    from wearline.bus import _settings

    for mode in ("client", "router"):
        config = _settings(mode)
        for key in ("scouting/multicast/enabled", "scouting/gossip/enabled", "transport/shared_memory/enabled"):
            assert str(config.get_json(key)) == "false", key
        assert str(config.get_json("transport/link/tx/lease")) == "1000"
        block = "transport/link/tx/queue/congestion_control/block/wait_before_close"
        assert str(config.get_json(block)) == ("200000" if mode == "router" else "800000")
