"""The one imperative shell: cell.yaml -> log -> metrics -> bus -> loop -> clean stop.

Everything that belongs to a service happens on one thread of its own: it is built, started,
given messages, questions and ticks, and closed there. The main thread only waits for a signal.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from argparse import ArgumentParser
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, InvalidStateError
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from wearline import __version__, metrics
from wearline.bus import Bus
from wearline.config import CellSettings, Settings, load_cell, schema, validated
from wearline.errors import BusError, ConfigError, UsageError, WearlineError
from wearline.log import start_log
from wearline.messages import Event, Message, ServiceState
from wearline.service import Health, Service
from wearline.stop import StopSignal
from wearline.topics import SERVICES, Delivery, Query, Topic

LOG = logging.getLogger(__name__)
S = TypeVar("S", bound=Settings)

STATE_S = 1.0
STOP_S = 1.2
"""A service that is not closed by then is left; the process ends all the same. [s]"""
HUNG_S = 5.0
"""A loop that has not turned for so long is not alive. [s]"""
ANSWER_S = 10.0
"""A question waits so long for the service's thread. [s]"""
REPEAT_S = 10.0
"""The same failure is told once in that time. [s]"""
WAITING = {Delivery.EVERY: 4, Delivery.KEPT: 256, Delivery.LATEST: 1}
"""How many messages of a topic may wait; EVERY carries arrays of megabytes."""


@dataclass(frozen=True)
class _Arrived:
    topic: Topic
    message: Message


@dataclass(frozen=True)
class _Asked:
    query: Query
    question: Message
    answer: Future[Message]


@dataclass(frozen=True)
class _Alive:
    service: str
    is_alive: bool


@dataclass(frozen=True)
class _Replicas:
    live: frozenset[str]


_Item = _Arrived | _Asked | _Alive | _Replicas


class Inbox:
    """What waits for the service's thread: in order, bounded for each topic."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._items: deque[_Item] = deque()
        self._waiting: dict[Topic, int] = {}
        self._is_woken = False
        self._is_closed = False

    def put(self, item: _Item) -> Topic | None:
        """Add one; returns the topic whose oldest message had to go for it, if any."""
        dropped = None
        with self._changed:
            if isinstance(item, _Arrived):
                count = self._waiting.get(item.topic, 0) + 1
                if count > WAITING[item.topic.delivery]:
                    self._items.remove(
                        next(i for i in self._items if isinstance(i, _Arrived) and i.topic is item.topic)
                    )
                    dropped, count = item.topic, count - 1
                self._waiting[item.topic] = count
            self._items.append(item)
            self._changed.notify()
        return dropped

    def wake(self) -> None:
        """Make `take` return at once."""
        with self._changed:
            self._is_woken = True
            self._changed.notify()

    def close(self) -> None:
        """`take` returns nothing from now on."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    @property
    def is_closed(self) -> bool:
        return self._is_closed

    def take(self, timeout_s: float) -> tuple[_Item | None, bool]:
        """The oldest item (None: there is none) and whether somebody called `wake`."""
        with self._changed:
            if not (self._items or self._is_woken or self._is_closed) and timeout_s > 0:
                self._changed.wait(timeout_s)
            woken, self._is_woken = self._is_woken, False
            if self._is_closed or not self._items:
                return None, woken
            item = self._items.popleft()
            if isinstance(item, _Arrived):
                self._waiting[item.topic] -= 1
            return item, woken


class Runner:
    """Runs one service on a bus that is open, on the thread that calls `run`."""

    def __init__(self, service: Service, bus: Bus, clock: Callable[[], float] = time.monotonic) -> None:
        self._service, self._bus, self._clock = service, bus, clock
        self._place = (bus.cell, bus.service)
        self._inbox = Inbox()
        self._started_s = self._turned_s = clock()
        self._arrived_s: dict[Topic, float] = {}
        self._told_s: dict[str, float] = {}
        self._there: dict[str, bool] = {}
        self._health = Health("starting")

    def stop(self) -> None:
        """Make `run` end after the message in hand, from any thread."""
        self._inbox.close()

    def facts(self) -> tuple[bool, Mapping[str, object]]:
        """For /healthz: well = the loop turns, the router is there, the service is neither starting nor stopping.

        A degraded service is well: to start it anew would not bring back its camera.
        """
        age_s = self._clock() - self._turned_s
        health, is_connected = self._health, self._bus.is_connected
        is_alive = age_s < HUNG_S
        is_well = is_alive and is_connected and health.status in ("ready", "degraded")
        return is_well, {
            "alive": is_alive,
            "service": self._bus.service,
            "cell": self._bus.cell,
            "status": health.status,
            "detail": health.detail,
            "router": is_connected,
            "loop_age_s": round(age_s, 3),
            "version": __version__,
        }

    def run(self) -> None:
        """Start, serve until `stop`, close."""
        service, bus = self._service, self._bus
        service.wake, service.instance = self._inbox.wake, bus.instance
        for name in SERVICES:
            metrics.SERVICE_UP.labels(bus.cell, name).set(0.0)
        try:
            # A service that cannot start must not seem to run; whoever supervises it starts it anew.
            for message in service.start(bus):
                bus.publish(message)
            handlers = service.handlers()
            for topic in handlers:
                bus.subscribe(topic, partial(self._put, topic))
            for query in service.answers():
                bus.answer(query, partial(self._answer, query))
            bus.watch_alive(self._put_alive)
            bus.announce()
            self._loop(handlers, service.answers())
        finally:
            self._stop_state()
            service.close()

    def _put(self, topic: Topic, message: Message) -> None:
        self._arrived_s[topic] = self._clock()
        if (dropped := self._inbox.put(_Arrived(topic, message))) is not None and topic.delivery is not Delivery.LATEST:
            self._bus.count_drop(dropped, "overrun")

    def _put_alive(self, name: str, replicas: frozenset[str]) -> None:
        is_alive = bool(replicas)
        if self._there.get(name) is not is_alive:
            self._there[name] = is_alive
            metrics.SERVICE_UP.labels(self._bus.cell, name).set(float(is_alive))
            self._inbox.put(_Alive(name, is_alive))
        if name == self._bus.service:
            self._inbox.put(_Replicas(replicas))

    def _answer(self, query: Query, question: Message) -> Message:
        """On the query's thread: wait until the service's thread has answered."""
        answer: Future[Message] = Future()
        self._inbox.put(_Asked(query, question, answer))
        try:
            return answer.result(timeout=ANSWER_S)
        except FutureTimeoutError:
            answer.cancel()
            raise BusError(f"{self._bus.service} was too busy to answer {query.name}") from None

    def _loop(
        self,
        handlers: Mapping[Topic, Callable[[Any], Iterable[Message]]],
        answers: Mapping[Query, Callable[[Any], Message]],
    ) -> None:
        period_s = self._service.tick_s
        now_s = self._clock()
        next_state_s, next_tick_s = now_s, now_s
        while not self._inbox.is_closed:
            due_s = next_state_s if period_s is None else min(next_state_s, next_tick_s)
            item, is_woken = self._inbox.take(max(0.0, due_s - self._clock()))
            now_s = self._turned_s = self._clock()
            if isinstance(item, _Arrived):
                self._do(item.topic.name, partial(handlers[item.topic], item.message))
            elif isinstance(item, _Asked):
                self._reply(item, answers[item.query])
            elif isinstance(item, _Alive):
                self._do("alive", partial(self._service.on_alive, item.service, item.is_alive))
            elif isinstance(item, _Replicas):
                self._do("replicas", partial(self._service.on_replicas, item.live))
            now_s = self._clock()
            if is_woken or (period_s is not None and now_s >= next_tick_s):
                self._do("tick", partial(self._service.tick, now_s))
                # After a long handler the ticks that were missed are not made up for.
                next_tick_s = (
                    max(next_tick_s + (period_s or 0.0), self._clock()) if now_s >= next_tick_s else next_tick_s
                )
            if now_s >= next_state_s:
                next_state_s = max(next_state_s + STATE_S, now_s)
                self._tell_state()

    def _do(self, what: str, handler: Callable[[], Iterable[Message]]) -> None:
        """Publish what a handler yields, each message at once; a failure ends the handler, not the service."""
        with metrics.HANDLING.labels(*self._place, what).time():
            try:
                for message in handler():
                    self._bus.publish(message)
            except Exception as error:
                self._tell_failure(what, error)

    def _reply(self, item: _Asked, fn: Callable[[Any], Message]) -> None:
        with metrics.HANDLING.labels(*self._place, item.query.name).time():
            try:
                if not item.answer.set_running_or_notify_cancel():
                    return
                item.answer.set_result(fn(item.question))
            except InvalidStateError:
                return
            except Exception as error:
                # The asker is told; it is no failure of the service when it refuses.
                item.answer.set_exception(error)

    def _tell_failure(self, what: str, error: Exception) -> None:
        text = f"{what}: {error}" if isinstance(error, WearlineError) else f"{what}: {type(error).__name__}: {error}"
        now_s = self._clock()
        if now_s - self._told_s.get(text, -REPEAT_S) < REPEAT_S:
            return
        if len(self._told_s) > 100:
            self._told_s.clear()
        self._told_s[text] = now_s
        LOG.error("%s failed", what, exc_info=error)
        event = Event(
            service=self._bus.service,
            level="error",
            text=text,
            utc=datetime.now(UTC).isoformat(timespec="milliseconds"),
        )
        try:
            self._bus.publish(event)
        except WearlineError:
            LOG.warning("the event could not be published")

    def _tell_state(self) -> None:
        try:
            self._health = self._service.health()
        except Exception as error:
            self._health = Health("degraded", f"{type(error).__name__}: {error}")
            self._tell_failure("health", error)
        now_s = self._clock()
        for topic, arrived_s in tuple(self._arrived_s.items()):
            metrics.TOPIC_AGE.labels(*self._place, topic.name).set(now_s - arrived_s)
        metrics.SERVICE_UP.labels(*self._place).set(float(self._health.status in ("ready", "degraded")))
        self._publish_state(self._health)

    def _stop_state(self) -> None:
        self._health = Health("stopping")
        self._publish_state(self._health)

    def _publish_state(self, health: Health) -> None:
        try:
            self._bus.publish(
                ServiceState(
                    service=self._bus.service,
                    status=health.status,
                    detail=health.detail,
                    pid=os.getpid(),
                    uptime_s=self._clock() - self._started_s,
                    version=__version__,
                    values=dict(health.values),
                )
            )
        except Exception as error:
            LOG.warning("the state could not be published: %s", error)


class _Life:
    """One service from build to close, on its thread; the exit code is kept for the main thread."""

    def __init__(self, name: str, cell: CellSettings, build: Callable[[], Service]) -> None:
        self._name, self._cell, self._build = name, cell, build
        self._halt = threading.Event()
        self._runner: Runner | None = None
        self.code = 1
        self.error = ""

    def stop(self) -> None:
        self._halt.set()
        if self._runner is not None:
            self._runner.stop()

    def live(self) -> None:
        try:
            self._live()
            self.code = 0
        except WearlineError as error:
            self.code, self.error = 2, str(error)
        except Exception as error:
            LOG.exception("%s ended", self._name)
            self.error = f"{self._name} ended: {type(error).__name__}: {error}; its log says more"

    def _live(self) -> None:
        service = self._build()
        server = None
        bus = Bus(self._cell.cell, self._name, self._cell.router.endpoint, self._cell.router.tls)
        runner = Runner(service, bus)
        metrics.watch_disk(self._cell.cell, self._name, self._cell.data_dir / self._name)
        try:
            try:
                server = metrics.serve(
                    self._cell.metrics_host, self._cell.metrics_ports.get(self._name, 0), runner.facts
                )
                LOG.info("metrics on port %d", server.port)
            except ConfigError as error:
                # To measure without being watched is better than not to measure.
                LOG.error("%s", error)
            if not bus.open(self._halt):
                service.close()
                return
            self._runner = runner
            if self._halt.is_set():
                runner.stop()
            LOG.info("%s is up, pid %d", self._name, os.getpid())
            runner.run()
        finally:
            bus.close()
            if server is not None:
                server.close()


class _Parser(ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(message, self.prog, "see --help")


def _end_soon(code: int) -> None:
    """A thread that a library left behind must not keep the process for ever."""

    def end() -> None:
        time.sleep(0.3)
        os._exit(code)

    threading.Thread(target=end, name="end", daemon=True).start()


def main(
    name: str,
    settings_type: type[S],
    build: Callable[[CellSettings, S], Service],
    argv: Sequence[str] | None = None,
) -> NoReturn:
    """Run one service until SIGTERM or SIGINT, then exit 0; 2 with one line where cell.yaml cannot be obeyed."""
    if name not in SERVICES:
        raise ValueError(f"{name} is not one of {SERVICES}")
    parser = _Parser(prog=f"wearline run {name}", description=f"The {name} service of one cell.")
    parser.add_argument("--config", type=Path, metavar="CELL.yaml")
    parser.add_argument("--check-config", action="store_true", help="only say whether cell.yaml can be obeyed")
    parser.add_argument("--schema", action="store_true", help="print the JSON schema of this service's section")
    try:
        arguments = parser.parse_args(argv)
        if arguments.schema:
            sys.stdout.write(schema(settings_type) + "\n")
            sys.exit(0)
        if arguments.config is None:
            raise UsageError("--config is missing", parser.prog, "name the cell's file: --config CELL.yaml")
        cell = load_cell(arguments.config)
        settings = validated(settings_type, getattr(cell, name), f"{arguments.config}: {name}")
        if arguments.check_config:
            sys.stdout.write(f"{arguments.config}: {name} is valid\n")
            sys.exit(0)
    except WearlineError as error:
        sys.stderr.write(f"wearline: {error}\n")
        sys.exit(2)
    start_log(cell.cell, name)
    life = _Life(name, cell, lambda: build(cell, settings))
    with StopSignal() as stop:

        def live() -> None:
            life.live()
            stop.give_up()

        thread = threading.Thread(target=live, name=name, daemon=True)
        thread.start()
        stop.wait()
        life.stop()
        thread.join(timeout=STOP_S)
        if thread.is_alive():
            LOG.error("%s did not stop within %.1f s and was left", name, STOP_S)
            logging.shutdown()
            os._exit(1)
    if life.error:
        sys.stderr.write(f"wearline: {life.error}\n")
    _end_soon(life.code)
    sys.exit(life.code)
