"""A Siemens PLC by the classic S7 protocol (ISO on TCP, PUT/GET), with python-snap7.

What python-snap7 3.3 leaves to its user is done here: a deadline on each whole exchange (its own time-out is 5 s for
each piece received, so a dripping server holds a call for ever), no reconnection of its own (it writes again what it
was writing), one thread, and a new connection after any fault.
"""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Callable
from typing import Literal, TypeVar

from pydantic import Field
from snap7.client import Client
from snap7.connection import ISOTCPConnection
from snap7.error import S7ConnectionError, S7Error, S7TimeoutError

from wearline.config import Settings
from wearline.errors import DeviceError

# Its lines on every connection say nothing that ours do not.
logging.getLogger("snap7").setLevel(logging.CRITICAL)

T = TypeVar("T")
Family = Literal["s7-300", "s7-400", "s7-1200", "s7-1500"]
RACK_SLOT: dict[Family, tuple[int, int]] = {"s7-300": (0, 2), "s7-400": (0, 3), "s7-1200": (0, 1), "s7-1500": (0, 1)}
"""Of the CPU; an S7-400's slot depends on its power supply."""
CONNECTION = {"pg": 1, "op": 2, "basic": 3}
"""Resources of the CPU: programming device, operator panel, S7 basic communication. Those for PGs are scarce."""
READ_OVERHEAD, WRITE_OVERHEAD = 18, 35
"""Bytes of a PDU that are not content; beyond them python-snap7 splits a request, and the image would be torn."""


class S7Settings(Settings):
    """Where the PLC is."""

    family: Family = "s7-1500"
    """Gives rack, slot and the cure in messages."""
    host: str = "127.0.0.1"
    """IPv4 address or name."""
    port: int = Field(default=102, ge=1, le=65535)
    rack: int | None = Field(default=None, ge=0, le=7)
    """None = as the family has it."""
    slot: int | None = Field(default=None, ge=0, le=31)
    connection: Literal["pg", "op", "basic"] = "basic"
    db: int = Field(default=100, ge=1, le=65535)
    """Number of the data block; it belongs to Wearline alone."""
    poll_ms: float = Field(default=10.0, ge=1, le=1000)
    """Between two reads of the image. A real CPU answers in 2 to 20 ms. [ms]"""


class _Connection(ISOTCPConnection):
    """With one deadline for a whole exchange instead of a time-out for each piece."""

    deadline_s = 0.0

    def _left_s(self) -> float:
        left_s = self.deadline_s - time.monotonic()
        if left_s <= 0.0:
            self.connected = False
            raise S7TimeoutError("no complete answer in time")
        return left_s

    def _tcp_connect(self) -> None:
        self.timeout = self._left_s()
        super()._tcp_connect()
        assert self.socket is not None
        self.socket.settimeout(self._left_s())

    def send_data(self, data: bytes) -> None:
        if self.socket is not None:
            self.socket.settimeout(self._left_s())
        super().send_data(data)

    def _recv_exact(self, size: int) -> bytes:
        if self.socket is None:
            raise S7ConnectionError("not connected")
        received = bytearray()
        while len(received) < size:
            self.socket.settimeout(self._left_s())
            try:
                piece = self.socket.recv(size - len(received))
            except TimeoutError as error:
                self.connected = False
                raise S7TimeoutError("no complete answer in time") from error
            except OSError as error:
                self.connected = False
                raise S7ConnectionError(str(error)) from error
            if not piece:
                self.connected = False
                raise S7ConnectionError("closed by the other side")
            received += piece
        return bytes(received)


class _Client(Client):
    """Connects with a `_Connection`, within a time of its own."""

    def open(self, host: str, port: int, remote_tsap: int, deadline_s: float) -> None:
        self.disconnect()
        connection = _Connection(host, port, self.local_tsap, remote_tsap)
        connection.deadline_s = deadline_s
        self.connection = connection
        connection.connect(max(deadline_s - time.monotonic(), 0.001))
        self._setup_communication()
        self.connected = True


class S7Plc:
    """One data block of one CPU."""

    def __init__(self, settings: S7Settings, image_bytes: int, io_timeout_s: float) -> None:
        self.name = f"PLC {settings.host}:{settings.port}"
        self._settings, self._image_bytes, self._io_timeout_s = settings, image_bytes, io_timeout_s
        rack, slot = RACK_SLOT[settings.family]
        rack = rack if settings.rack is None else settings.rack
        slot = slot if settings.slot is None else settings.slot
        self._remote_tsap = CONNECTION[settings.connection] << 8 | rack << 5 | slot
        self._place = f"rack {rack}, slot {slot}"
        self._client: _Client | None = None

    def connect(self) -> None:
        self.close()
        self._client = client = _Client()
        deadline_s = time.monotonic() + self._io_timeout_s
        try:
            # A name is looked up by the resolver, which has its own time; an address is not.
            address = socket.gethostbyname(self._settings.host)
            client.open(address, self._settings.port, self._remote_tsap, deadline_s)
        except (S7Error, OSError) as error:
            self.close()
            raise DeviceError(f"does not connect ({error})", self.name, self._cure_of_connect(error)) from error
        room = min(client.pdu_length - READ_OVERHEAD, client.pdu_length - WRITE_OVERHEAD)
        if room < self._image_bytes:
            self.close()
            raise DeviceError(
                f"agreed on a PDU of {client.pdu_length} bytes; {self._image_bytes} bytes do not travel in one piece",
                self.name, "use profile basic, or a CPU or CP with larger PDUs",
            )  # fmt: skip
        self.read()

    def read(self) -> bytes:
        return self._do(
            lambda client: bytes(client.db_read(self._settings.db, 0, self._image_bytes)), "cannot be read"
        )  # fmt: skip

    def write(self, start: int, content: bytes) -> None:
        self._do(lambda client: client.db_write(self._settings.db, start, bytearray(content)), "cannot be written")

    def close(self) -> None:
        client, self._client = self._client, None
        if client is None:
            return
        connection = client.connection
        if connection is not None:
            # No polite disconnect request: the other side may be hung, and the next connection must not wait for it.
            connection.connected = False
        client.disconnect()

    def _do(self, exchange: Callable[[_Client], T], what: str) -> T:
        client = self._client
        if client is None or not isinstance(client.connection, _Connection):
            raise DeviceError("is not connected", self.name, "connect first")
        client.connection.deadline_s = time.monotonic() + self._io_timeout_s
        try:
            return exchange(client)
        except (S7Error, OSError) as error:
            # After any fault the stream may be out of step: an answer could be taken for that of another request.
            self.close()
            raise DeviceError(
                f"DB{self._settings.db} {what} ({error})", self.name, self._cure_of_exchange(error)
            ) from error

    def _cure_of_connect(self, error: Exception) -> str:
        if isinstance(error, S7TimeoutError) or "timed out" in str(error):
            return "is it switched on, and is nothing between (cable, VLAN, firewall on port 102)?"
        return (
            f"check fieldbus.plc.host and port, {self._place} for a {self._settings.family}, and that the CPU has a "
            "free connection"
        )

    def _cure_of_exchange(self, error: Exception) -> str:
        if isinstance(error, S7ConnectionError | S7TimeoutError | OSError):
            return "it is connected anew"
        permit = (
            "permit PUT/GET in the CPU's protection settings and switch 'optimised block access' of the DB off"
            if self._settings.family in ("s7-1200", "s7-1500")
            else "load the DB into the CPU, not write-protected"
        )
        return f"make DB{self._settings.db} a global DB of at least {self._image_bytes} bytes, and {permit}"
