"""Typed messages on one Zenoh session; the only file that knows Zenoh.

Every setting that differs from Zenoh's own is here and has its reason beside it.
"""

from __future__ import annotations

import json
import logging
import os
import secrets
import threading
from collections.abc import Callable
from typing import Any

import zenoh
import zenoh.ext as zenoh_ext
from zenoh.handlers import FifoChannel, RingChannel

from wearline import metrics
from wearline.access import access_control
from wearline.config import CellSettings, TlsSettings
from wearline.errors import BusError, ConfigError, MessageError, WearlineError
from wearline.messages import Event, Message, ServiceState, decode, encode
from wearline.stop import StopSignal
from wearline.topics import QUERIES, SERVICES, STATES, TOPICS, Delivery, Query, Topic, alive_key

LOG = logging.getLogger(__name__)

ROUTER = "router"
KEPT_SAMPLES = 64
"""How many messages a KEPT topic remembers for late joiners and after a link loss."""
CHANNEL_DEPTH = 16
"""Between the network and the thread that empties it at once. A plain callback would queue 256 frames (half a GB)."""
CONNECT_PAUSE_S = 0.1
EMPTY_PAUSE_S = 0.05
"""Before a question that found nobody is asked once more: a queryable needs a few ms to be known everywhere."""


def _plain_settings(mode: str) -> dict[str, Any]:
    return {
        "mode": mode,
        # The router is named, so nothing is searched for, and nothing else on the plant's network is found.
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # Queries by shared memory are dropped in silence when a receiver stalls; and containers share none.
        "transport/shared_memory/enabled": False,
        # Zenoh's 10 s would hide a hung process for longer than three cycles.
        "transport/link/tx/lease": 1000,
        # Zenoh's 5 s would let one hung subscriber hold up every other one for longer than a cycle. While the router
        # waits for that one it reads from nobody: a publisher must be the more patient, or its own link is closed.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 200_000 if mode == "router" else 800_000,
        # A server that accepts and never answers must not hold up a stop signal.
        "transport/unicast/open_timeout": 1000,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        # The age of what a late joiner is told is counted from these.
        "timestamping/enabled": True,
        "adminspace/enabled": False,
    }


def _settings(mode: str) -> zenoh.Config:
    return _config(_plain_settings(mode))


def _config(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _tls_settings(tls: TlsSettings, participant: str) -> dict[str, Any]:
    """Each side shows its certificate.

    Raises:
        ConfigError: a file is missing.
    """
    certificate, key = tls.files_of(participant)
    for path in (tls.authority, certificate, key):
        if not os.access(path, os.R_OK):
            raise ConfigError("cannot be read", str(path), "issue it, or correct router.tls in cell.yaml")
    side = "listen" if participant == ROUTER else "connect"
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": str(tls.authority),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            f"{side}_certificate": str(certificate),
            f"{side}_private_key": str(key),
        },
    }


class Bus:
    """One participant: publishes under its own name only, subscribes to and asks whom it likes.

    Callbacks of subscriptions run on a thread per topic and must be quick; those of `answer` run on a
    thread per query. After a lost link Zenoh reconnects by itself and declares everything anew.
    """

    def __init__(self, cell: str, service: str, endpoint: str, tls: TlsSettings | None = None) -> None:
        self.cell, self.service, self.endpoint = cell, service, endpoint
        self._tls = {} if tls is None else _tls_settings(tls, service)
        self.instance = f"{os.getpid()}-{secrets.token_hex(4)}"
        """Tells this replica from the others of its service; new with every start."""
        self._session: zenoh.Session | None = None
        self._publishers: dict[Topic, Any] = {}
        self._by_message = {topic.message: topic for topic in TOPICS if topic.publisher == service}
        # Zenoh undeclares what Python has forgotten.
        self._declared: list[Any] = []
        self._threads: list[threading.Thread] = []
        self._closing = threading.Event()

    def open(self, stop: threading.Event | None = None, timeout_s: float | None = None) -> bool:
        """Connect to the router and declare what this service publishes; False when ``stop`` came first.

        Raises:
            BusError: no router within ``timeout_s`` (None: wait for ever).
        """
        halt = stop or threading.Event()
        tries = None if timeout_s is None else max(1, int(timeout_s / CONNECT_PAUSE_S))
        while not halt.is_set():
            config = _config(
                {
                    **_plain_settings("client"),
                    **self._tls,
                    "connect/endpoints": [self.endpoint],
                    # One try each, so that the stop is seen between two.
                    "connect/timeout_ms": 0,
                }
            )
            try:
                self._session = zenoh.open(config)
                break
            except zenoh.ZError as error:
                tries = None if tries is None else tries - 1
                if tries == 0:
                    raise BusError(
                        "no router answers", self.endpoint, "start 'wearline up' or 'wearline router', or mend router."
                    ) from error
                halt.wait(CONNECT_PAUSE_S)
        if self._session is None:
            return False
        for topic in self._by_message.values():
            self._publishers[topic] = self._publisher(topic)
        return True

    @property
    def _open(self) -> zenoh.Session:
        if self._session is None or self._session.is_closed():
            raise BusError("is not open", f"bus of {self.service}", "open it first")
        return self._session

    @property
    def is_connected(self) -> bool:
        """Whether the router is there at this moment."""
        session = self._session
        return session is not None and not session.is_closed() and bool(session.info.routers_zid())

    def close(self) -> None:
        """Leave the cell: token, queryables, subscriptions, session. May be called twice."""
        self._closing.set()
        session, self._session = self._session, None
        if session is not None and not session.is_closed():
            # A session that is left open keeps the process from ending.
            session.close()  # type: ignore[no-untyped-call]
        self._declared.clear()
        self._publishers.clear()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout=0.5)
        self._threads.clear()

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- publish and subscribe ---

    def _publisher(self, topic: Topic) -> Any:
        key = topic.key(self.cell)
        encoding = f"application/octet-stream;wearline.{topic.message.__name__}.v1"
        if topic.delivery is Delivery.LATEST:
            is_state = topic in STATES.values()
            return self._open.declare_publisher(
                key,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_LOW if is_state else zenoh.Priority.BACKGROUND,
            )
        if topic.delivery is Delivery.EVERY:
            return self._open.declare_publisher(
                key, encoding=encoding, congestion_control=zenoh.CongestionControl.BLOCK, priority=zenoh.Priority.DATA
            )
        return zenoh_ext.declare_advanced_publisher(
            self._open,
            key,
            encoding=encoding,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.DATA_HIGH,
            express=True,
            cache=zenoh_ext.CacheConfig(max_samples=KEPT_SAMPLES),
            sample_miss_detection=zenoh_ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.2),
            publisher_detection=True,
        )

    def topic_of(self, message: Message) -> Topic:
        """Where this service publishes such a message.

        Raises:
            MessageError: it is another service's to publish.
        """
        topic = self._by_message.get(type(message))
        if topic is None:
            raise MessageError(
                f"{self.service} may not publish {type(message).__name__}", "bus", "wearline/topics.py says who may"
            )
        if isinstance(message, (ServiceState, Event)) and message.service != self.service:
            raise MessageError(f"{self.service} may not speak for {message.service}", "bus")
        return topic

    def publish(self, message: Message) -> Topic:
        """Send one message on its topic; KEPT ones reach who joins or reconnects later, too.

        Raises:
            MessageError: it is another service's to publish.
            BusError: the bus is closed.
        """
        topic = self.topic_of(message)
        session = self._open
        header, payload = encode(message)
        try:
            self._publishers[topic].put(payload, attachment=header)
        except (zenoh.ZError, KeyError) as error:
            if not session.is_closed():
                raise BusError(f"cannot be published ({error})", topic.key(self.cell)) from error
            raise BusError("is not open", f"bus of {self.service}", "open it first") from error
        metrics.MESSAGES.labels(self.cell, self.service, topic.name, "out").inc()
        return topic

    def subscribe(self, topic: Topic, callback: Callable[[Any], None]) -> None:
        """Call ``callback`` with every message of a topic, in order, on a thread of that topic.

        A message that is not what the topic promises is counted, logged and left out.
        """
        key = topic.key(self.cell)
        subscriber: Any
        if topic.delivery is Delivery.LATEST:
            subscriber = self._open.declare_subscriber(key, RingChannel(1))
        elif topic.delivery is Delivery.EVERY:
            # What a replica says itself it need not hear; arrays of megabytes would be read for nothing.
            subscriber = self._open.declare_subscriber(
                key, FifoChannel(CHANNEL_DEPTH), allowed_origin=zenoh.Locality.REMOTE
            )
        else:
            subscriber = zenoh_ext.declare_advanced_subscriber(
                self._open,
                key,
                FifoChannel(CHANNEL_DEPTH + KEPT_SAMPLES),
                history=zenoh_ext.HistoryConfig(
                    detect_late_publishers=True, max_samples=KEPT_SAMPLES, max_age=topic.keep_s
                ),
                recovery=zenoh_ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                subscriber_detection=True,
            )

        def take(sample: zenoh.Sample) -> None:
            header = sample.attachment.to_bytes() if sample.attachment is not None else b""
            try:
                message = decode(topic.message, header, sample.payload.to_bytes())
            except MessageError as error:
                self.count_drop(topic, "bad_message")
                LOG.warning("%s was left out: %s", key, error)
                return
            metrics.MESSAGES.labels(self.cell, self.service, topic.name, "in").inc()
            callback(message)

        self._follow(subscriber, take, f"topic {topic.name}")

    def count_drop(self, topic: Topic, reason: str) -> None:
        """Count a message that was not handled."""
        metrics.DROPPED.labels(self.cell, self.service, topic.name, reason).inc()

    def _follow(self, source: Any, take: Callable[[Any], None], name: str) -> None:
        self._declared.append(source)

        def run() -> None:
            while True:
                try:
                    item = source.recv()
                except zenoh.ZError:
                    return
                try:
                    take(item)
                except Exception:
                    if self._closing.is_set():
                        return
                    LOG.exception("%s: a callback failed", name)

        thread = threading.Thread(target=run, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    # --- questions ---

    def ask(self, query: Query, question: Message, argument: str = "", timeout_s: float = 1.0) -> Message:
        """The typed answer. A question that only reads is asked again once if nobody was there.

        Raises:
            BusError: nobody answered in time, or the answerer refused (its sentence is the text).
            MessageError: the question is not this query's.
        """
        if not isinstance(question, query.ask):
            raise MessageError(f"got {type(question).__name__}", f"{query.name} asks {query.ask.__name__}")
        key = query.key(self.cell, argument or ("-" if query.name.endswith("**") else ""))
        answer = self._ask(query, question, key, timeout_s)
        # A command may have been obeyed by one that died before it answered: it is never repeated.
        if answer is None and not query.name.startswith("do/") and not self._closing.wait(EMPTY_PAUSE_S):
            answer = self._ask(query, question, key, timeout_s)
        if answer is None:
            raise BusError("nobody answers", key, f"is {query.answerer} running?")
        return answer

    def _ask(self, query: Query, question: Message, key: str, timeout_s: float) -> Message | None:
        header, payload = encode(question)
        try:
            replies = self._open.get(key, FifoChannel(4), payload=payload, attachment=header, timeout=timeout_s)
            for reply in replies:
                if (sample := reply.ok) is not None:
                    attached = sample.attachment
                    return decode(
                        query.answer, attached.to_bytes() if attached is not None else b"", sample.payload.to_bytes()
                    )
                refusal = reply.err.payload.to_string() if reply.err is not None else "Timeout"
                if refusal == "Timeout":
                    raise BusError(f"no answer within {timeout_s:g} s", key, f"is {query.answerer} busy or hung?")
                raise BusError(refusal)
        except zenoh.ZError as error:
            raise BusError(f"cannot be asked ({error})", key) from error
        except MessageError as error:
            raise BusError(f"answered with something else ({error})", key) from error
        return None

    def answer(self, query: Query, fn: Callable[[Any], Message]) -> None:
        """Answer a query with ``fn(question)``; what it raises becomes the asker's `BusError`.

        Raises:
            MessageError: it is another service's to answer.
        """
        if query.answerer != self.service or query not in QUERIES:
            raise MessageError(f"{self.service} may not answer {query.answerer}/{query.name}", "bus")
        # Not "complete": two replicas' answers are then both asked for, and the first one counts.
        queryable = self._open.declare_queryable(query.key(self.cell), FifoChannel(CHANNEL_DEPTH))

        def take(asked: zenoh.Query) -> None:
            # Only its end releases the asker.
            with asked:
                try:
                    attached, sent = asked.attachment, asked.payload
                    question = decode(
                        query.ask,
                        attached.to_bytes() if attached is not None else b"",
                        sent.to_bytes() if sent is not None else b"",
                    )
                    header, payload = encode(fn(question))
                except WearlineError as error:
                    asked.reply_err(str(error))
                except Exception as error:
                    LOG.exception("%s could not be answered", query.name)
                    asked.reply_err(f"{query.answerer} failed ({type(error).__name__}: {error}); its log says more")
                else:
                    asked.reply(asked.key_expr, payload, attachment=header)

        self._follow(queryable, take, f"query {query.name}")

    # --- who is there ---

    def announce(self) -> None:
        """Say that this service is alive, until it closes or dies; last of all, when it can be asked."""
        key = alive_key(self.cell, self.service, self.instance)
        self._declared.append(self._open.liveliness().declare_token(key))

    def watch_alive(self, callback: Callable[[str, frozenset[str]], None]) -> None:
        """Call ``callback(service, replicas)`` for those that are there and at every change, on a thread of its own.

        ``replicas`` are the instances of that service that are alive; empty = it has gone.
        """
        watched = self._open.liveliness().declare_subscriber(
            alive_key(self.cell, "*"), FifoChannel(4 * CHANNEL_DEPTH), history=True
        )
        there: dict[str, frozenset[str]] = {}

        def take(sample: zenoh.Sample) -> None:
            words = str(sample.key_expr).split("/")
            service, instance = words[2], frozenset(words[4:])
            if service in SERVICES:
                known = there.get(service, frozenset())
                there[service] = known | instance if sample.kind == zenoh.SampleKind.PUT else known - instance
                callback(service, there[service])

        self._follow(watched, take, "alive")


def router_settings(cell: CellSettings) -> dict[str, Any]:
    """All settings of a cell's router, nested as in a configuration file of ``zenohd``.

    With certificates each participant may say only what `wearline.access` allows it.

    Raises:
        ConfigError: a certificate is missing.
    """
    settings = {**_plain_settings("router"), "listen/endpoints": [cell.router.listen or cell.router.endpoint]}
    if cell.router.tls is not None:
        settings |= {**_tls_settings(cell.router.tls, ROUTER), "access_control": access_control(cell.cell)}
    nested: dict[str, Any] = {}
    for key, value in settings.items():
        *folders, name = key.split("/")
        place = nested
        for folder in folders:
            place = place.setdefault(folder, {})
        place[name] = value
    return nested


def open_router(cell: CellSettings) -> zenoh.Session:
    """The router of a cell, until its `close`.

    Raises:
        BusError: the address cannot be listened on.
        ConfigError: a certificate is missing.
    """
    listen = cell.router.listen or cell.router.endpoint
    config = zenoh.Config.from_json5(json.dumps(router_settings(cell)))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise BusError(
            "the router cannot listen there", listen, "free the port or change router.endpoint in cell.yaml"
        ) from error


def router(cell: CellSettings) -> int:
    """Run the router of a cell until SIGTERM or SIGINT.

    Raises:
        BusError: the address cannot be listened on.
    """
    with StopSignal() as stop:
        session = open_router(cell)
        LOG.info(
            "router of %s listens on %s, pid %d", cell.cell, cell.router.listen or cell.router.endpoint, os.getpid()
        )
        stop.wait()
        session.close()  # type: ignore[no-untyped-call]
    return 0
