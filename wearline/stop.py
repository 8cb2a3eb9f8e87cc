"""SIGTERM and SIGINT as something that can be waited for."""

from __future__ import annotations

import select
import signal
import socket
from types import TracebackType
from typing import Self


class StopSignal:
    """While entered (on the main thread), SIGTERM and SIGINT are kept for `wait`.

    They arrive on a socket: a handler that touched a lock could meet its own thread holding it.
    """

    def __enter__(self) -> Self:
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        self._wakeup_before = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        self._before = {number: signal.signal(number, self._heard) for number in (signal.SIGTERM, signal.SIGINT)}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._wakeup_before)
        self._reader.close()
        self._writer.close()

    @staticmethod
    def _heard(number: int, frame: object) -> None:
        """Only the socket counts."""

    def give_up(self) -> None:
        """Make `wait` return, from any thread."""
        self._writer.send(b"\0")

    def wait(self, timeout_s: float | None = None) -> bool:
        """True once a stop signal came or `give_up` was called; False after ``timeout_s``."""
        ready, _, _ = select.select([self._reader], [], [], timeout_s)
        if not ready:
            return False
        heard = self._reader.recv(64)
        return bool({0, int(signal.SIGTERM), int(signal.SIGINT)} & set(heard))
