"""Modbus TCP: the image offered to clients, and the client of a remote I/O module with the 4 + 4 wires."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, TypeVar

from pydantic import Field

from wearline.config import Settings
from wearline.errors import DeviceError
from wearline_fieldbus.drivers.modbus_protocol import (
    NO_TARGET,
    Area,
    Debouncer,
    Frame,
    RefusedError,
    answer,
    bits_of,
    check_reply,
    frames,
    read_inputs,
    write_coils,
)

CLIENTS_MAX = 16
IDLE_S = 60.0
"""A client that says nothing for so long is let go. [s]"""
INPUTS = OUTPUTS = 4
MEASURE = 2
"""Index of the input Measure."""
RESPONSE_BYTE = 10
T = TypeVar("T")


class ModbusSettings(Settings):
    """The server of the process image."""

    host: str = "127.0.0.1"
    """Address to listen on; bind the cell's network alone."""
    port: int | None = Field(default=None, ge=0, le=65535)
    """None = no server; 0 = any free port. Modbus has 502."""
    units: tuple[int, ...] = (1, 255)
    """Unit ids that are answered; others get exception 11."""


class DigitalIoSettings(Settings):
    """A remote I/O module: four inputs and four outputs of Table 5.1."""

    host: str = "127.0.0.1"
    port: int = Field(default=502, ge=1, le=65535)
    unit: int = Field(default=1, ge=0, le=255)
    first_input: int = Field(default=0, ge=0, le=65532)
    """Discrete inputs: Start camera, Stop camera, Measure, Link OK."""
    first_output: int = Field(default=0, ge=0, le=65532)
    """Coils: Ready, Measure finished, Passed, Failed."""
    debounce_reads: int = Field(default=3, ge=1, le=100)
    """An input counts when it was the same in so many polls."""
    measure: Literal["level", "pulse"] = "level"
    """level: Measure stands until Measure finished. pulse: a short pulse starts a measurement."""
    object_index: int = Field(default=1, ge=0, le=65535)
    """The wires name no object."""


class ModbusServer:
    """Offers an image; answers on threads of its own, one per client, until `close`."""

    def __init__(self, settings: ModbusSettings, area: Callable[[], Area], write: Callable[[int, bytes], None]) -> None:
        """Listen; ``area`` gives what is offered now, ``write`` takes first byte and content.

        Raises:
            DeviceError: the port is taken.
        """
        self._units, self._area, self._write = settings.units, area, write
        self._clients: set[socket.socket] = set()
        self._lock = threading.Lock()
        try:
            self._listener = socket.create_server((settings.host, settings.port or 0))
        except OSError as error:
            raise DeviceError(
                f"cannot serve Modbus on port {settings.port} ({error.strerror or error})", settings.host,
                "free the port, or change fieldbus.modbus.port",
            ) from error  # fmt: skip
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, name="modbus", daemon=True).start()

    def close(self) -> None:
        """Stop, and end every connection."""
        # close alone does not wake the thread that accepts.
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            clients = list(self._clients)
        for client in clients:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            with self._lock:
                is_full = len(self._clients) >= CLIENTS_MAX
                if not is_full:
                    self._clients.add(client)
            if is_full:
                client.close()
                continue
            threading.Thread(target=self._serve, args=(client,), name="modbus client", daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        received = bytearray()
        try:
            client.settimeout(IDLE_S)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while content := client.recv(4096):
                received += content
                # A client may send the next request before it has the answer to the last one.
                for frame in frames(received):
                    client.sendall(Frame(frame.transaction, frame.unit, self._answer(frame)).encoded())
        except (OSError, ValueError):
            # Gone, idle for too long, or no Modbus: in each case this connection is over.
            pass
        finally:
            client.close()
            with self._lock:
                self._clients.discard(client)

    def _answer(self, frame: Frame) -> bytes:
        if frame.unit not in self._units:
            return bytes((frame.pdu[0] | 0x80, NO_TARGET))
        return answer(frame.pdu, self._area(), self._write)


@dataclass
class _Connection:
    socket: socket.socket
    transaction: int = 0
    received: bytearray = field(default_factory=bytearray)


class DigitalIo:
    """A PLC that has nothing but eight wires: Table 5.1's digital column behind a Modbus TCP I/O module.

    The inputs become bits 0.0-0.3 and the outputs are bits 10.0-10.3 of profile `basic`; the rest of the image is
    kept here. A wire that breaks reads 0, and Stop camera = 0 stops: no input is ever invented.
    """

    def __init__(self, settings: DigitalIoSettings, image_bytes: int, io_timeout_s: float) -> None:
        self.name = f"I/O module {settings.host}:{settings.port}"
        self._settings, self._io_timeout_s = settings, io_timeout_s
        self._image = bytearray(image_bytes)
        self._debouncer = Debouncer(INPUTS, settings.debounce_reads)
        self._was_measure = False
        self._latched = False
        self._connection: _Connection | None = None

    def connect(self) -> None:
        self.close()
        try:
            found = socket.create_connection((self._settings.host, self._settings.port), self._io_timeout_s)
        except OSError as error:
            raise DeviceError(
                f"does not connect ({error})", self.name, "check fieldbus.digital_io.host and port, cable and supply"
            ) from error
        found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connection = _Connection(found)
        # What was before the connection is not known: inputs count anew, outputs are what the module says.
        self._image[:] = bytes(len(self._image))
        self._image[2:4] = self._settings.object_index.to_bytes(2, "big")
        self._debouncer = Debouncer(INPUTS, self._settings.debounce_reads)
        self._was_measure, self._latched = True, False
        self.read()

    def read(self) -> bytes:
        request = read_inputs(self._settings.first_input, INPUTS)
        inputs = self._debouncer.take(self._ask(request, lambda reply: bits_of(request, reply, INPUTS)))
        measure = inputs[MEASURE]
        if self._settings.measure == "pulse":
            # A pulse is a Measure until its result stands.
            self._latched = (self._latched or (measure and not self._was_measure)) and not self._is_finished()
            self._was_measure = measure
            inputs = [*inputs[:MEASURE], self._latched, *inputs[MEASURE + 1 :]]
        self._image[0] = sum(value << i for i, value in enumerate(inputs))
        return bytes(self._image)

    def write(self, start: int, content: bytes) -> None:
        after = bytearray(self._image)
        after[start : start + len(content)] = content
        outputs = [bool(after[RESPONSE_BYTE] >> i & 1) for i in range(OUTPUTS)]
        request = write_coils(self._settings.first_output, outputs)
        self._ask(request, lambda reply: check_reply(request, reply))
        self._image = after

    def close(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.socket.close()

    def _is_finished(self) -> bool:
        return bool(self._image[RESPONSE_BYTE] & 2)

    def _ask(self, pdu: bytes, understood: Callable[[bytes], T]) -> T:
        connection = self._connection
        if connection is None:
            raise DeviceError("is not connected", self.name, "connect first")
        deadline_s = time.monotonic() + self._io_timeout_s
        connection.transaction = connection.transaction % 65535 + 1
        try:
            connection.socket.settimeout(self._io_timeout_s)
            connection.socket.sendall(Frame(connection.transaction, self._settings.unit, pdu).encoded())
            while True:
                for frame in frames(connection.received):
                    if frame.transaction == connection.transaction:
                        return understood(frame.pdu)
                left_s = deadline_s - time.monotonic()
                if left_s <= 0.0:
                    raise TimeoutError("no complete answer in time")
                connection.socket.settimeout(left_s)
                content = connection.socket.recv(512)
                if not content:
                    raise ConnectionError("closed by the other side")
                connection.received += content
        except RefusedError as error:
            self.close()
            raise DeviceError(f"refused ({error})", self.name, "check first_input, first_output and unit") from error
        except (OSError, ValueError) as error:
            self.close()
            raise DeviceError(f"does not answer ({error})", self.name, "it is connected anew") from error
