"""One registry of Prometheus series, and the small server of /metrics and /healthz.

Names and labels are those that dashboards rely on. Labels come from closed sets: never a part
or a cycle id.
"""

from __future__ import annotations

import json
import math
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, TypeVar

import prometheus_client
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4

from wearline.errors import ConfigError

# A second series per series, with the time of its creation, doubles the scrape for nothing.
prometheus_client.disable_created_metrics()  # type: ignore[no-untyped-call]

REGISTRY = CollectorRegistry()

SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.15, 0.25, 0.4, 0.6, 1.0, 1.5, 2.0, 2.5, 3.0, 5.0)
"""Default buckets: from a message handled in passing to a cycle past its deadline. [s]"""

Health = Callable[[], tuple[bool, Mapping[str, object]]]
"""Is the service well, and what it says of itself (JSON values)."""

_Series = TypeVar("_Series", Counter, Gauge, Histogram)
_declared: dict[str, tuple[type, tuple[str, ...], Any]] = {}
_lock = threading.Lock()


def _declare(kind: type[_Series], name: str, labels: Sequence[str], make: Callable[[], _Series]) -> _Series:
    with _lock:
        if name not in _declared:
            _declared[name] = (kind, tuple(labels), make())
        known_kind, known_labels, series = _declared[name]
        if known_kind is not kind or known_labels != tuple(labels):
            raise ValueError(f"{name} is already a {known_kind.__name__} with labels {known_labels}")
        found: _Series = series
        return found


def counter(name: str, doc: str, labels: Sequence[str] = ()) -> Counter:
    """The counter of that name, declared once; ``name`` ends in ``_total``.

    Raises:
        ValueError: the name is taken by another kind or with other labels.
    """
    return _declare(Counter, name, labels, lambda: Counter(name, doc, labels, registry=REGISTRY))


def gauge(name: str, doc: str, labels: Sequence[str] = ()) -> Gauge:
    """The gauge of that name, declared once.

    Raises:
        ValueError: the name is taken by another kind or with other labels.
    """
    return _declare(Gauge, name, labels, lambda: Gauge(name, doc, labels, registry=REGISTRY))


def histogram(name: str, doc: str, labels: Sequence[str] = (), buckets: Sequence[float] = SECONDS) -> Histogram:
    """The histogram of that name, declared once, with upper bounds ``buckets``.

    Raises:
        ValueError: the name is taken by another kind or with other labels.
    """
    return _declare(
        Histogram, name, labels, lambda: Histogram(name, doc, labels, registry=REGISTRY, buckets=tuple(buckets))
    )


MESSAGES = counter(
    "wearline_messages_total", "Messages that a service received or sent", ("cell", "service", "topic", "direction")
)
HANDLING = histogram(
    "wearline_handling_seconds", "Time from taking a message to its handler's end", ("cell", "service", "topic")
)
DROPPED = counter(
    "wearline_dropped_total", "Messages that were not handled, and why", ("cell", "service", "topic", "reason")
)
TOPIC_AGE = gauge(
    "wearline_topic_age_seconds", "Since the last message of a topic arrived", ("cell", "service", "topic")
)
DISK_FREE = gauge("wearline_disk_free_bytes", "Room left where the cell's data lie", ("cell", "service"))
DISK_SIZE = gauge("wearline_disk_size_bytes", "Size of the disk where the cell's data lie", ("cell", "service"))
SERVICE_UP = gauge("wearline_service_up", "1 while a service is there and not degraded", ("cell", "service"))


def watch_disk(cell: str, service: str, folder: Path) -> None:
    """Tell room and size of the disk of a folder with every scrape; NaN while it cannot be asked."""

    def usage(which: int) -> float:
        try:
            return float(shutil.disk_usage(folder)[which])
        except OSError:
            return math.nan

    DISK_FREE.labels(cell, service).set_function(lambda: usage(2))
    DISK_SIZE.labels(cell, service).set_function(lambda: usage(0))


class MetricsServer:
    """Serves until `close`, on a thread of its own; no fault of it reaches the caller."""

    def __init__(self, server: ThreadingHTTPServer) -> None:
        self._server = server
        self.port: int = server.server_address[1]
        """Where it listens, also when any free port was asked for."""
        self._thread = threading.Thread(
            target=server.serve_forever, kwargs={"poll_interval": 0.2}, name="metrics", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop listening and free the port."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(timeout=1.0)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that goes away in the middle is no event."""


def serve(host: str, port: int, health: Health) -> MetricsServer:
    """Serve ``/metrics``, ``/healthz`` (200 when well, else 503, with JSON) and ``/livez``; port 0 takes any free one.

    ``/livez`` is 200 unless what the service says of itself has ``alive`` false.

    Raises:
        ConfigError: the port is taken or the address is not this machine's.
    """

    class Handler(BaseHTTPRequestHandler):
        timeout = 5.0

        def do_GET(self) -> None:
            path = self.path.partition("?")[0]
            if path == "/metrics":
                self._answer(200, CONTENT_TYPE_PLAIN_0_0_4, generate_latest(REGISTRY))
            elif path == "/healthz":
                is_well, facts = health()
                self._answer(200 if is_well else 503, "application/json", json.dumps(facts).encode())
            elif path == "/livez":
                # To start a service anew mends its own loop and nothing outside: no router, camera or PLC counts here.
                facts = health()[1]
                self._answer(200 if facts.get("alive", True) else 503, "application/json", json.dumps(facts).encode())
            else:
                self._answer(404, "text/plain; charset=utf-8", b"/metrics, /healthz and /livez live here\n")

        def _answer(self, status: int, content_type: str, body: bytes) -> None:
            self.send_response(status)
            self.send_header("Content-Type", content_type)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """A scrape every few seconds is not worth the log."""

    try:
        return MetricsServer(_Server((host, port), Handler))
    except OSError as error:
        raise ConfigError(
            f"cannot listen for /metrics ({error.strerror or error})",
            f"{host}:{port}",
            "free the port or change metrics_ports in cell.yaml",
        ) from error
