"""A PLC's memory behind the real S7 protocol, for the soft PLC and for tests."""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from snap7.server import Server
from snap7.type import SrvArea

from wearline.errors import DeviceError

logging.getLogger("snap7").setLevel(logging.CRITICAL)


class _Server(Server):
    """Ends its clients' connections when it stops; python-snap7 leaves them open and waits a second for each."""

    def __init__(self) -> None:
        super().__init__(log=False)
        self._sockets: set[socket.socket] = set()
        self._sockets_lock = threading.Lock()

    def _handle_client(self, client_socket: socket.socket, address: tuple[str, int]) -> None:
        with self._sockets_lock:
            self._sockets.add(client_socket)
        try:
            super()._handle_client(client_socket, address)
        finally:
            with self._sockets_lock:
                self._sockets.discard(client_socket)

    def drop_clients(self) -> None:
        """As a power cut would."""
        with self._sockets_lock:
            sockets = list(self._sockets)
        for client_socket in sockets:
            try:
                client_socket.shutdown(socket.SHUT_RDWR)
            except OSError:
                # It has gone by itself.
                continue


class S7Server:
    """One data block, served until `close`."""

    def __init__(self, host: str, port: int, db: int, size: int) -> None:
        """Listen on ``host``:``port`` (0 = any free one, see `port`).

        Raises:
            DeviceError: it is taken, or not this machine's.
        """
        self._db, self._memory = db, bytearray(size)
        self._server = _Server()
        self._server.register_area(SrvArea.DB, db, self._memory)
        try:
            # python-snap7 shares a port in silence; a probe of our own does not.
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, port))
                self.port: int = probe.getsockname()[1]
            self._server.start_to(host, self.port)
        except Exception as error:
            raise DeviceError(
                f"cannot serve on port {port} ({error})", host, "free the port, or change it on both sides in cell.yaml"
            ) from error

    @contextmanager
    def memory(self) -> Iterator[bytearray]:
        """The block, while no client reads or writes it."""
        self._server.lock_area(SrvArea.DB, self._db)
        try:
            yield self._memory
        finally:
            self._server.unlock_area(SrvArea.DB, self._db)

    def put(self, start: int, content: bytes) -> None:
        """Change some bytes in one piece."""
        with self.memory() as memory:
            memory[start : start + len(content)] = content

    def close(self) -> None:
        """Stop, and end every connection."""
        self._server.running = False
        self._server.drop_clients()
        self._server.running = True
        self._server.stop()


class ServedImage:
    """The other way round: the image lies here, and the PLC reads and writes it as an S7 client (PUT and GET).

    Whether the PLC is there is told by its life counter alone.
    """

    def __init__(self, host: str, port: int, db: int, size: int) -> None:
        self.name = f"S7 server {host}:{port}"
        self._place = (host, port, db, size)
        self._server: S7Server | None = None

    @property
    def port(self) -> int:
        """Where it listens, once it does."""
        return 0 if self._server is None else self._server.port

    def connect(self) -> None:
        if self._server is None:
            self._server = S7Server(*self._place)

    def read(self) -> bytes:
        if self._server is None:
            raise DeviceError("is not connected", self.name, "connect first")
        with self._server.memory() as memory:
            return bytes(memory)

    def write(self, start: int, content: bytes) -> None:
        if self._server is None:
            raise DeviceError("is not connected", self.name, "connect first")
        self._server.put(start, content)

    def close(self) -> None:
        server, self._server = self._server, None
        if server is not None:
            server.close()
