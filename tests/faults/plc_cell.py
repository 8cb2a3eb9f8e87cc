"""The real fieldbus service, a soft PLC behind the real S7 protocol and a network that fails between them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from tests.faults.tcp_proxy import WRITE, Proxy, function_of
from wearline import messages as m
from wearline.errors import BusError
from wearline.topics import Query
from wearline_fieldbus.core.cycle import HandshakeSettings
from wearline_fieldbus.core.handshake import Handshake
from wearline_fieldbus.core.profiles import BASIC, Direction
from wearline_fieldbus.core.soft_plc import Belief, SoftPlc, SoftPlcSettings
from wearline_fieldbus.drivers.journal import Journal, JournalSettings
from wearline_fieldbus.drivers.plc import PlcLink
from wearline_fieldbus.drivers.s7 import S7Plc, S7Settings
from wearline_fieldbus.drivers.s7_server import S7Server
from wearline_fieldbus.service import Fieldbus

SCAN_S = 0.005
REQUEST_DATA, ANSWER_DATA = 35, 25
"""Where the content begins in an S7 write request and in the answer to a read."""
STEPS = ("idle", "measure", "accepted", "measuring", "result", "result_answer", "told", "release")
"""Of a cycle, as the network sees it; `Watch.seen` tells them apart."""


def is_good(stroke: int) -> bool:
    """The truth about the part of a stroke."""
    return stroke % 3 != 0


class Nobody:
    """Knows every object."""

    def ask(self, query: Query, question: m.Message, argument: str = "", timeout_s: float = 1.0) -> m.Message:
        if isinstance(question, m.AskRecipe):
            return m.Ping()
        raise BusError("nobody answers")


class PressLine(threading.Thread):
    """The soft PLC: scans a data block that an S7 server offers."""

    def __init__(self, settings: SoftPlcSettings) -> None:
        super().__init__(daemon=True)
        self._settings = settings
        self.plc = SoftPlc(settings)
        self.server = S7Server("127.0.0.1", 0, 100, BASIC.size)
        self.port = self.server.port
        self.is_stopped = threading.Event()
        """PLC in STOP: its memory stays as it is."""
        self.believed = threading.Condition()
        self.beliefs: list[tuple[float, Belief]] = []
        self._ended = threading.Event()
        self._lock = threading.Lock()

    def run(self) -> None:
        start, end = BASIC.span(Direction.REQUEST)
        while not self._ended.wait(SCAN_S):
            if self.is_stopped.is_set():
                continue
            with self._lock, self.server.memory() as memory:
                if len(memory) < BASIC.size:
                    continue
                now_s = time.monotonic()
                belief = self.plc.scan(BASIC.decode(bytes(memory), Direction.RESPONSE), now_s)
                memory[start:end] = BASIC.encode(self.plc.request(), Direction.REQUEST)
            if belief is not None:
                with self.believed:
                    self.beliefs.append((now_s, belief))
                    self.believed.notify_all()

    def power_off(self) -> None:
        """No server; memory is forgotten, numbers are retained."""
        self.server.close()
        self.plc = SoftPlc(self._settings, self.plc.stroke, self.plc.measure_number)

    def power_on(self) -> None:
        """A new server on the old port."""
        with self._lock:
            self.server = S7Server("127.0.0.1", self.port, 100, BASIC.size)

    def resize(self, size: int) -> None:
        """Somebody loads a DB of another length."""
        with self._lock, self.server.memory() as memory:
            memory[size:] = b""
            memory.extend(bytes(size - len(memory)))

    def close(self) -> None:
        self._ended.set()
        self.join(timeout=1.0)
        self.server.close()


class Watch:
    """Tells from the bytes on the wire which step of a cycle it is; calls ``act`` at the wanted one, once."""

    def __init__(self, proxy: Proxy) -> None:
        self._lock = threading.Lock()
        self._wanted = ""
        self._act: Callable[[], bool] = lambda: True
        self._last = "release"
        self._accepted_s = 0.0
        self.hit = threading.Event()
        proxy.on_request, proxy.on_answer = self._request, self._answer

    def arm(self, step: str, act: Callable[[], bool]) -> None:
        """At the next such step ``act`` is called; what it returns says whether an answer is forwarded."""
        with self._lock:
            self.hit.clear()
            self._wanted, self._act = step, act

    def _seen(self, step: str) -> bool:
        with self._lock:
            if step != self._wanted:
                return True
            self._wanted, act = "", self._act
        self.hit.set()
        return act()

    def _request(self, request: bytes) -> None:
        if function_of(request) == WRITE:
            block = request[REQUEST_DATA:]
            if len(block) < 10:
                return
            if block[0] & 2:
                self._last = "result"
            elif block[0] & 1:
                self._last = "release"
            elif self._last == "measure":
                self._last, self._accepted_s = "accepted", time.monotonic()
            self._seen(self._last)
        elif self._last == "accepted" and time.monotonic() - self._accepted_s > 0.02:
            self._seen("measuring")
        elif self._last == "release":
            self._seen("idle")
        elif self._last == "result_answer":
            self._seen("told")

    def _answer(self, answer: bytes) -> bool:
        if self._last == "result":
            self._last = "result_answer"
            return self._seen("result_answer")
        image = answer[ANSWER_DATA:]
        if len(image) >= BASIC.size and image[0] & 4 and self._last == "release":
            self._last = "measure"
            return self._seen("measure")
        return True


@dataclass(frozen=True)
class Report:
    """What a run showed."""

    accepted: int
    false_passed: int
    lost: int
    doubled: int
    contradicted: int
    """Strokes of which the PLC believes something else than it was told."""
    longest_ms: float


class PlcCell:
    """Runs the service on a thread, as the runner does, with a chain that answers after ``verdict_s``."""

    def __init__(
        self, folder: Path, handshake: HandshakeSettings, plc: SoftPlcSettings, verdict_s: float = 0.06
    ) -> None:
        self.line = PressLine(plc)
        self.proxy = Proxy(self.line.port)
        self.watch = Watch(self.proxy)
        self._verdict_s = verdict_s
        self._folder = folder
        self.journal = Journal(folder, JournalSettings(min_free_bytes=0))
        machine = Handshake(BASIC, handshake, plc_is_simulated=False, cycle_prefix="faults")
        port = S7Plc(S7Settings(port=self.proxy.port), BASIC.size, handshake.io_timeout_s)
        self.link = PlcLink(port, poll_s=0.005, quiet=BASIC.life_bytes)
        self.service = Fieldbus("faults", BASIC, machine, self.link, self.journal)
        self._changed = threading.Condition()
        self._is_woken, self._is_ended = False, False
        self._verdicts: list[m.Verdict] = []
        self.requests: list[m.MeasureRequest] = []
        self.parts: dict[str, int] = {}
        self.outcomes: list[m.Outcome] = []
        self.events: list[m.Event] = []
        self.judged_s: dict[str, float] = {}
        self.told_s: dict[str, float] = {}
        """When each verdict was handed over, and its outcome published. [s]"""
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        self.line.start()
        self._thread.start()

    def _wake(self) -> None:
        with self._changed:
            self._is_woken = True
            self._changed.notify()

    def _run(self) -> None:
        service = self.service
        service.wake = self._wake
        self._take(service.start(Nobody()))
        for name in ("capture", "reconstruct", "judge"):
            self._take(service.on_alive(name, True))
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_woken or self._verdicts or self._is_ended, 0.05)
                verdicts, self._verdicts, self._is_woken = self._verdicts, [], False
                if self._is_ended:
                    return
            for verdict in verdicts:
                self._take(service.on_verdict(verdict))
            self._take(service.tick(time.monotonic()))

    def _take(self, messages: Iterable[m.Message]) -> None:
        for message in messages:
            if isinstance(message, m.MeasureRequest):
                self.requests.append(message)
                self.parts[message.cycle_id] = self.line.plc.stroke
                timer = threading.Timer(self._verdict_s, self._judge, (message,))
                timer.daemon = True
                timer.start()
            elif isinstance(message, m.Outcome):
                self.outcomes.append(message)
                self.told_s[message.cycle_id] = time.monotonic()
            elif isinstance(message, m.Event):
                self.events.append(message)

    def _judge(self, request: m.MeasureRequest) -> None:
        good = is_good(self.parts[request.cycle_id])
        verdict = m.Verdict(
            cycle_id=request.cycle_id, is_simulated=False, request=request, reason="", mean_error_mm=0.1,
            decision=m.Decision.PASSED if good else m.Decision.FAILED, code=1 if good else 2,
        )  # fmt: skip
        with self._changed:
            self.judged_s[request.cycle_id] = time.monotonic()
            self._verdicts.append(verdict)
            self._changed.notify()

    def wait_believed(self, since_s: float, count: int = 1, within_s: float = 20.0) -> float:
        """Wait until the PLC believed ``count`` results after an instant; when the first one came. [s]"""

        def found() -> list[float]:
            return [at_s for at_s, belief in self.line.beliefs if at_s > since_s and belief.code in (1, 2)]

        with self.line.believed:
            assert self.line.believed.wait_for(lambda: len(found()) >= count, within_s), (
                f"the press stands: {self.service.health().values['not_ready_because']}, {self.link.fault}"
            )
            return found()[0]

    def close(self) -> Report:
        """Stop, and hold what was believed against what was told and what is true."""
        with self._changed:
            self._is_ended = True
            self._changed.notify()
        self._thread.join(timeout=5.0)
        self.line.close()
        self.service.close()
        self.proxy.close()
        again = Journal(self._folder, JournalSettings(min_free_bytes=0))
        again.close()
        ids = [outcome.cycle_id for outcome in self.outcomes]
        # The cycle that was under way when the test ended.
        running = {self.requests[-1].cycle_id} if self.requests else set()
        told = {o.request.measure_number: o.code for o in self.outcomes if o.was_told}
        beliefs = [belief for _, belief in self.line.beliefs]
        unrecorded = {request.cycle_id for request in self.requests} - set(again.entries)
        return Report(
            accepted=len(again.entries),
            false_passed=sum(b.passed and not is_good(b.stroke) for b in beliefs),
            lost=len(set(again.entries) - set(ids) - running) + len(unrecorded),
            doubled=len(ids) - len(set(ids)),
            contradicted=sum(b.code not in (0, told.get(b.measure_number, b.code)) for b in beliefs),
            longest_ms=1000.0 * self.link.longest_s,
        )
