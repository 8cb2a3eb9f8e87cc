"""What every PLC does, and the thread that polls it.

One thread owns the connection: it reads the image, writes what it is given, in order, and after any fault drops the
connection and connects anew. Nothing that was given to it for an earlier connection is ever written.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol, TypeVar

from wearline.errors import WearlineError

LOG = logging.getLogger(__name__)
T = TypeVar("T")

RECONNECT_S = (0.1, 0.5)
"""First and longest pause before the next attempt to connect. [s]"""


class PlcPort(Protocol):
    """A connection to one PLC, used by one thread.

    Each method takes no longer than its own time-out, and after a `DeviceError` the connection is closed.
    """

    name: str

    def connect(self) -> None:
        """Connect and make sure that the process image is there.

        Raises:
            DeviceError: it is not, with the cure.
        """
        ...

    def read(self) -> bytes:
        """The whole image, in one piece.

        Raises:
            DeviceError: no answer; the connection is closed.
        """
        ...

    def write(self, start: int, content: bytes) -> None:
        """Write bytes from ``start`` on, in one piece; returns when the PLC has acknowledged.

        Raises:
            DeviceError: no acknowledgement (it may have arrived all the same); the connection is closed.
        """
        ...

    def close(self) -> None:
        """Close the connection, if there is one."""
        ...


@dataclass(frozen=True)
class ImageRead:
    """The image changed, or is the newest one."""

    content: bytes
    writes: int
    """Writes with a token that this connection's PLC had acknowledged before."""
    at_s: float
    """When the read was sent. [s]"""


@dataclass(frozen=True)
class LinkUp:
    """A connection stands."""

    image: ImageRead
    connection: int
    """Its number, to be named with every write."""


@dataclass(frozen=True)
class LinkDown:
    """The connection ended; a write under way may or may not have arrived."""

    reason: str


@dataclass(frozen=True)
class WriteDone:
    """The PLC acknowledged."""

    token: int
    at_s: float


@dataclass(frozen=True)
class WriteSkipped:
    """Not begun: its time had gone."""

    token: int


LinkEvent = ImageRead | LinkUp | LinkDown | WriteDone | WriteSkipped


@dataclass(frozen=True)
class _Wanted:
    connection: int
    start: int
    content: bytes
    token: int | None
    not_after_s: float | None


class PlcLink:
    """Polls a PLC on a thread of its own; what happened waits in `take`, and ``wake`` says that something does."""

    def __init__(
        self,
        port: PlcPort,
        *,
        poll_s: float,
        quiet: frozenset[int],
        observe_poll: Callable[[float], None] = lambda seconds: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``quiet``: bytes whose change alone wakes nobody (life counters)."""
        self._port, self._poll_s, self._quiet = port, poll_s, quiet
        self._observe_poll, self._clock = observe_poll, clock
        self._changed = threading.Condition()
        self._wanted: deque[_Wanted] = deque()
        self._events: deque[LinkEvent] = deque()
        self._newest: ImageRead | None = None
        self._connection = 0
        self._is_closed = False
        self._fault = "not connected yet"
        self._longest_s = 0.0
        self.wake: Callable[[], None] = lambda: None
        self._thread = threading.Thread(target=self._run, name="plc", daemon=True)

    @property
    def fault(self) -> str:
        """Why there is no connection; empty while there is one."""
        return self._fault

    @property
    def longest_s(self) -> float:
        """The longest exchange so far. [s]"""
        return self._longest_s

    def start(self) -> None:
        """Begin to poll."""
        self._thread.start()

    def take(self) -> list[LinkEvent]:
        """What happened since the last call, in order; the newest image comes last, though only life counters moved."""
        with self._changed:
            events, newest = list(self._events), self._newest
            self._events.clear()
            self._newest = None
        return events if newest is None else [*events, newest]

    def write(
        self, connection: int, start: int, content: bytes, token: int | None = None, not_after_s: float | None = None
    ) -> None:
        """Write soon, on the connection that `LinkUp` named and on no later one.

        `WriteDone` or `WriteSkipped` tells what came of a write with a ``token``, unless `LinkDown` comes first.
        """
        with self._changed:
            self._wanted.append(_Wanted(connection, start, content, token, not_after_s))
            self._changed.notify()

    def close(self) -> None:
        """End the thread and the connection; an exchange under way is waited for."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(timeout=1.0)

    def _tell(self, event: LinkEvent) -> None:
        with self._changed:
            self._events.append(event)
        self.wake()

    def _run(self) -> None:
        pause_s = RECONNECT_S[0]
        while not self._is_closed:
            try:
                self._exchange(self._port.connect)
                with self._changed:
                    self._connection += 1
                self._serve()
            except WearlineError as error:
                was_linked, text = not self._fault, str(error)
                if text != self._fault:
                    LOG.warning("%s", text)
                self._fault = text
                pause_s = RECONNECT_S[0] if was_linked else min(2.0 * pause_s, RECONNECT_S[1])
                self._end_connection()
                if was_linked:
                    self._tell(LinkDown(text))
                else:
                    self.wake()
            except Exception as error:
                # Whatever a driver does not foresee is a lost connection and not the end of polling.
                LOG.exception("%s: the driver failed", self._port.name)
                was_linked, self._fault = not self._fault, f"{type(error).__name__}: {error}"
                self._port.close()
                self._end_connection()
                if was_linked:
                    self._tell(LinkDown(self._fault))
                pause_s = RECONNECT_S[1]
            with self._changed:
                if not self._is_closed:
                    self._changed.wait_for(lambda: self._is_closed, pause_s)
        self._port.close()

    def _end_connection(self) -> None:
        """What is still to be written was meant for a connection that is no more."""
        with self._changed:
            self._connection += 1
            self._newest = None

    def _exchange(self, what: Callable[[], T]) -> T:
        began_s = self._clock()
        try:
            return what()
        finally:
            self._longest_s = max(self._longest_s, self._clock() - began_s)

    def _read(self, writes: int) -> ImageRead:
        at_s = self._clock()
        content = self._exchange(self._port.read)
        self._observe_poll(self._clock() - at_s)
        return ImageRead(content, writes, at_s)

    def _serve(self) -> None:
        """Poll until a fault or the end."""
        writes = 0
        image = self._read(writes)
        if self._fault:
            LOG.info("%s: connected", self._port.name)
        self._fault = ""
        told = image
        self._tell(LinkUp(image, self._connection))
        due_s = self._clock()
        while not self._is_closed:
            writes += self._write_all()
            image = self._read(writes)
            if self._differs(told.content, image.content):
                told = image
                with self._changed:
                    self._newest = None
                self._tell(image)
            else:
                with self._changed:
                    self._newest = image
            due_s = max(due_s + self._poll_s, self._clock())
            with self._changed:
                if not self._wanted and not self._is_closed:
                    self._changed.wait(max(0.0, due_s - self._clock()))

    def _differs(self, one: bytes, other: bytes) -> bool:
        return one != other and any(
            a != b and i not in self._quiet for i, (a, b) in enumerate(zip(one, other, strict=True))
        )

    def _write_all(self) -> int:
        """Write what waits, in order; how many blocks (writes with a token) the PLC acknowledged."""
        count = 0
        while True:
            with self._changed:
                if not self._wanted:
                    return count
                wanted = self._wanted.popleft()
                is_current = wanted.connection == self._connection
            is_late = wanted.not_after_s is not None and self._clock() > wanted.not_after_s
            if not is_current or is_late:
                if wanted.token is not None and is_current:
                    self._tell(WriteSkipped(wanted.token))
                continue
            self._exchange(partial(self._port.write, wanted.start, wanted.content))
            if wanted.token is not None:
                count += 1
                self._tell(WriteDone(wanted.token, self._clock()))
