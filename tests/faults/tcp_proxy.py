"""A TCP proxy between the service and its PLC, with the vices of a plant's network."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections.abc import Callable

READ, WRITE = 0x04, 0x05
"""S7 functions, at byte 17 of a request on ISO-on-TCP."""


def function_of(request: bytes) -> int:
    """The S7 function of a request; 0 where it is none."""
    return request[17] if len(request) > 17 and request[7] == 0x32 else 0


class Proxy:
    """Forwards one port to another; `fault` says what goes wrong from now on.

    pass: nothing. swallow: both directions vanish (half-open). hold: both directions wait until the fault changes.
    hold_answers: requests arrive, answers wait. drip: answers come byte by byte. refuse: connections end at once.
    """

    def __init__(self, target_port: int) -> None:
        self._target_port = target_port
        self._changed = threading.Condition()
        self._fault = "pass"
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._is_closed = False
        self.on_request: Callable[[bytes], None] = lambda request: None
        """Called with every request before it is forwarded; may change the fault or cut."""
        self.on_answer: Callable[[bytes], bool] = lambda answer: True
        """Called with every answer before it is forwarded; False = it is not."""
        self.connections = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def fault(self, name: str) -> None:
        """From now on this goes wrong."""
        with self._changed:
            self._fault = name
            self._changed.notify_all()

    def cut(self) -> None:
        """Reset every connection."""
        with self._changed:
            pairs, self._pairs = self._pairs, []
        for pair in pairs:
            for end in pair:
                _reset(end)

    def close(self) -> None:
        """Stop."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._listener.close()
        self.cut()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            if self._fault == "refuse":
                _reset(client)
                continue
            try:
                server = socket.create_connection(("127.0.0.1", self._target_port), timeout=1.0)
            except OSError:
                _reset(client)
                continue
            server.settimeout(None)
            for end in (client, server):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.connections += 1
            with self._changed:
                self._pairs.append((client, server))
            threading.Thread(target=self._pump, args=(client, server, True), daemon=True).start()
            threading.Thread(target=self._pump, args=(server, client, False), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, is_request: bool) -> None:
        with contextlib.suppress(OSError):
            while content := source.recv(65536):
                if is_request:
                    self.on_request(content)
                elif not self.on_answer(content):
                    continue
                self._forward(content, sink, is_request)
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def _forward(self, content: bytes, sink: socket.socket, is_request: bool) -> None:
        held = ("hold",) if is_request else ("hold", "hold_answers")
        with self._changed:
            self._changed.wait_for(lambda: self._is_closed or self._fault not in held)
            fault = self._fault
        if fault == "swallow":
            return
        if fault == "drip" and not is_request:
            for byte in content:
                sink.sendall(bytes((byte,)))
                with self._changed:
                    if self._changed.wait_for(lambda: self._is_closed or self._fault != "drip", 0.05):
                        continue
            return
        sink.sendall(content)


def _reset(end: socket.socket) -> None:
    with contextlib.suppress(OSError):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    with contextlib.suppress(OSError):
        # The other thread may sit in recv: this ends it, and close then resets.
        end.shutdown(socket.SHUT_RD)
    with contextlib.suppress(OSError):
        end.close()
