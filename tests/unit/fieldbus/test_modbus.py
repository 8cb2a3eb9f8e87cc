"""Modbus TCP: the image for clients (pymodbus and mbpoll as peers), and eight wires behind a remote I/O module."""

from __future__ import annotations

import asyncio
import shutil
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.client import ModbusTcpClient
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from tests.contract.conftest import free_port, until
from tests.faults.tcp_proxy import Proxy
from tests.unit.fieldbus.test_service import Judge
from tests.unit.fieldbus.world import verdict_on
from wearline import messages as m
from wearline.config import CellSettings, validated
from wearline.errors import ConfigError, DeviceError
from wearline_fieldbus.config import FieldbusSettings
from wearline_fieldbus.core.profiles import BASIC, EXTENDED, Direction
from wearline_fieldbus.drivers.memory import MemoryPlc
from wearline_fieldbus.drivers.modbus import DigitalIo, DigitalIoSettings, ModbusServer, ModbusSettings
from wearline_fieldbus.drivers.modbus_protocol import Area, Debouncer, Frame, FrameError, answer, frames
from wearline_fieldbus.service import Fieldbus, build

IMAGE = bytes(range(1, 21))
REQUEST_REGISTERS = range(5)


def modbus_client(port: int) -> Any:
    """pymodbus, whose methods carry no types."""
    return ModbusTcpClient("127.0.0.1", port=port, timeout=2, retries=0)


@pytest.fixture
def memory() -> MemoryPlc:
    found = MemoryPlc(20)
    found.put(0, IMAGE)
    return found


@pytest.fixture
def server(memory: MemoryPlc) -> Iterator[ModbusServer]:
    found = ModbusServer(ModbusSettings(port=0), lambda: Area(memory.read(), REQUEST_REGISTERS), memory.put)
    yield found
    found.close()


@pytest.fixture
def client(server: ModbusServer) -> Iterator[Any]:
    found = modbus_client(server.port)
    assert found.connect()
    yield found
    found.close()


def test_registers_are_the_words_of_the_image(client: Any) -> None:
    words = list(struct.unpack(">10H", IMAGE))
    assert client.read_input_registers(0, count=10).registers == words
    assert client.read_holding_registers(3, count=2).registers == words[3:5]


def test_inputs_are_the_bits_of_the_image(client: Any, memory: MemoryPlc) -> None:
    memory.put(10, b"\x05")
    assert client.read_discrete_inputs(80, count=8).bits == [True, False, True, False, False, False, False, False]
    assert client.read_coils(82, count=1).bits[0] is True


def test_only_request_registers_are_written(client: Any, memory: MemoryPlc) -> None:
    assert not client.write_register(2, 0x1234).isError()
    assert not client.write_registers(3, [1, 2]).isError()
    assert memory.read()[4:10].hex() == "123400010002"
    before = memory.read()
    for refused, code in (
        (client.write_register(5, 1), 2), (client.write_registers(4, [1, 2]), 2), (client.write_coil(2, True), 1),
        (client.write_coils(0, [True]), 1), (client.read_input_registers(8, count=3), 2),
        (client.read_discrete_inputs(153, count=8), 2),
        (client.mask_write_register(address=0, and_mask=1, or_mask=1), 1),
        (client.readwrite_registers(read_address=0, read_count=1, write_address=0, values=[1]), 1),
    ):  # fmt: skip
        assert refused.isError() and refused.exception_code == code
    assert memory.read() == before


def test_a_mirror_takes_no_writes_at_all(memory: MemoryPlc) -> None:
    mirror = ModbusServer(ModbusSettings(port=0), lambda: Area(memory.read()), memory.put)
    client = modbus_client(mirror.port)
    try:
        assert client.write_register(0, 1).exception_code == 2 and memory.read() == IMAGE
    finally:
        client.close()
        mirror.close()


def talk(port: int, content: bytes, answers: int) -> list[Frame]:
    """Send bytes as they are; the frames that come back."""
    with socket.create_connection(("127.0.0.1", port), timeout=5) as raw:
        raw.sendall(content)
        received = bytearray()
        found: list[Frame] = []
        while len(found) < answers:
            piece = raw.recv(4096)
            assert piece, "closed"
            received += piece
            found += frames(received)
        return found


def test_pipelined_requests_are_all_answered_in_order(server: ModbusServer) -> None:
    requests = b"".join(Frame(n, 1, struct.pack(">BHH", 4, n, 1)).encoded() for n in range(1, 6))
    found = talk(server.port, requests, 5)
    assert [frame.transaction for frame in found] == [1, 2, 3, 4, 5]
    assert [frame.pdu[2:] for frame in found] == [IMAGE[2 * n : 2 * n + 2] for n in range(1, 6)]


def test_an_unknown_unit_is_answered_with_exception_11(server: ModbusServer) -> None:
    (frame,) = talk(server.port, Frame(7, 9, b"\x04\0\0\0\x01").encoded(), 1)
    assert (frame.unit, frame.pdu) == (9, b"\x84\x0b")


def test_what_is_no_modbus_ends_its_connection_alone(server: ModbusServer, client: Any) -> None:
    with socket.create_connection(("127.0.0.1", server.port), timeout=5) as raw:
        raw.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert raw.recv(100) == b""
    assert not client.read_input_registers(0, count=1).isError()


@given(pdu=st.binary(min_size=1, max_size=253))
def test_no_request_changes_anything_but_request_registers(pdu: bytes) -> None:
    written: list[tuple[int, bytes]] = []
    reply = answer(pdu, Area(IMAGE, REQUEST_REGISTERS), lambda start, content: written.append((start, content)))
    assert reply[0] & 0x7F == pdu[0] & 0x7F and 2 <= len(reply) <= 253
    assert all(start >= 0 and start + len(content) <= 10 for start, content in written)
    assert not written or pdu[0] in (6, 16)


@given(received=st.binary(max_size=40))
def test_any_bytes_are_frames_or_an_error(received: bytes) -> None:
    try:
        frames(bytearray(received))
    except FrameError:
        assert len(received) >= 7


def test_mbpoll_agrees(server: ModbusServer, memory: MemoryPlc) -> None:
    if shutil.which("mbpoll") is None:
        pytest.skip("mbpoll is not installed")
    command = ["mbpoll", "-m", "tcp", "-p", str(server.port), "-a", "1", "-0", "-1", "127.0.0.1"]
    read = subprocess.run([*command, "-r", "0", "-c", "10", "-t", "3:hex"], capture_output=True, text=True, timeout=20)
    assert [line.split("\t")[-1] for line in read.stdout.splitlines() if line.startswith("[")] == [
        f"0x{word:04X}" for word in struct.unpack(">10H", IMAGE)
    ]
    subprocess.run([*command, "-r", "2", "-t", "4", "4711"], capture_output=True, timeout=20, check=True)
    assert memory.read()[4:6] == (4711).to_bytes(2, "big")
    refused = subprocess.run([*command, "-r", "7", "-t", "4", "1"], capture_output=True, text=True, timeout=20)
    assert "Illegal data address" in refused.stdout + refused.stderr


def serve(service: Fieldbus, said: list[m.Message]) -> bool:
    """One turn of the service."""
    said.extend(service.tick(time.monotonic()))
    return True


def started(tmp_path: Path, **settings: object) -> tuple[Fieldbus, list[m.Message]]:
    service = build(
        CellSettings(cell="c", data_dir=tmp_path, plc_is_simulated=True),
        validated(FieldbusSettings, settings, "test"),
    )
    assert isinstance(service, Fieldbus)
    said: list[m.Message] = list(service.start(Judge()))
    for name in ("capture", "reconstruct", "judge"):
        said.extend(service.on_alive(name, True))
    return service, said


def test_a_plc_that_is_a_modbus_client_measures(tmp_path: Path) -> None:
    port = free_port()
    service, said = started(tmp_path, plc={"kind": "modbus"}, modbus={"port": port})
    client = modbus_client(port)
    try:
        assert client.connect()

        def write(**values: int) -> None:
            block = BASIC.encode(values, Direction.REQUEST)
            assert not client.write_registers(0, list(struct.unpack(">5H", block))).isError()

        def bit(number: int) -> bool:
            return bool(client.read_discrete_inputs(80 + number, count=1).bits[0])

        idle = {"start_camera": 1, "stop_camera": 1, "link_ok": 1, "object_index": 3}
        write(**idle)
        until(lambda: serve(service, said) and bit(0))
        write(**idle, measure=1, measure_number=77, stroke=5)
        until(lambda: serve(service, said) and any(isinstance(message, m.MeasureRequest) for message in said))
        request = next(message for message in said if isinstance(message, m.MeasureRequest))
        said.extend(service.on_verdict(verdict_on(request)))
        until(lambda: serve(service, said) and bit(1))
        assert bit(2) and not bit(3) and client.read_input_registers(9, count=1).registers == [77]
    finally:
        client.close()
        service.close()


# --- eight wires ---


class IoModule:
    """A remote I/O module by pymodbus, on a loop of its own."""

    def __init__(self) -> None:
        self.port = free_port()
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        threading.Thread(target=self._run, daemon=True).start()
        assert self._ready.wait(10)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._start())
        self._ready.set()
        self._loop.run_forever()

    async def _start(self) -> None:
        bits = [SimData(0, values=[False] * 16, datatype=DataType.BITS)]
        registers = [SimData(0, values=[0] * 4, datatype=DataType.REGISTERS)]
        device = SimDevice(
            1, simdata=(bits, [SimData(0, values=[False] * 16, datatype=DataType.BITS)], registers, registers)
        )
        self.server: Any = ModbusTcpServer(device, address=("127.0.0.1", self.port))
        await self.server.serve_forever(background=True)

    def inputs(self, start: bool, stop: bool, measure: bool, link: bool) -> None:
        values = [start, stop, measure, link]
        asyncio.run_coroutine_threadsafe(self.server.async_setValues(1, 2, 0, values), self._loop).result(5)

    def outputs(self) -> list[bool]:
        client = modbus_client(self.port)
        found = client.read_coils(0, count=4).bits[:4]
        client.close()
        return list(found)

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self.server.shutdown(), self._loop).result(5)
        self._loop.call_soon_threadsafe(self._loop.stop)


@pytest.fixture(scope="module")
def module() -> Iterator[IoModule]:
    found = IoModule()
    yield found
    found.close()


def test_debouncing() -> None:
    debouncer = Debouncer(1, 3)
    seen = [debouncer.take([value])[0] for value in (True, True, False, True, True, True, False, False, False)]
    assert seen == [False, False, False, False, False, True, True, True, False]


@pytest.mark.parametrize("measure", ["level", "pulse"])
def test_eight_wires_measure_and_a_broken_link_is_safe(module: IoModule, tmp_path: Path, measure: str) -> None:
    proxy = Proxy(module.port)
    module.inputs(True, True, False, True)
    service, said = started(
        tmp_path, plc={"kind": "digital_io"}, handshake={"numbered": False, "minimum_pause_s": 3.1},
        digital_io={"port": proxy.port, "measure": measure, "object_index": 3},
    )  # fmt: skip
    try:
        until(lambda: serve(service, said) and module.outputs() == [True, False, False, False])
        module.inputs(True, True, True, True)
        until(lambda: serve(service, said) and any(isinstance(message, m.MeasureRequest) for message in said))
        if measure == "pulse":
            module.inputs(True, True, False, True)
        request = next(message for message in said if isinstance(message, m.MeasureRequest))
        assert request.object_index == 3 and request.measure_number == 0
        said.extend(service.on_verdict(verdict_on(request)))
        until(lambda: serve(service, said) and module.outputs() == [False, True, True, False])
        module.inputs(True, True, False, True)
        until(lambda: serve(service, said) and module.outputs()[1:] == [False, False, False])
        proxy.fault("swallow")
        until(lambda: serve(service, said) and service.health().status == "degraded")
        proxy.fault("pass")
        until(lambda: serve(service, said) and module.outputs() == [True, False, False, False])
        # A wire that breaks reads 0: the camera stops.
        module.inputs(False, False, False, False)
        until(lambda: serve(service, said) and module.outputs() == [False] * 4)
    finally:
        service.close()
        proxy.close()


def test_no_exchange_with_the_module_blocks_longer_than_its_time_out(module: IoModule) -> None:
    proxy = Proxy(module.port)
    wires = DigitalIo(DigitalIoSettings(port=proxy.port), 20, 0.2)
    try:
        wires.connect()
        for fault in ("swallow", "drip"):
            proxy.fault(fault)
            began = time.monotonic()
            with pytest.raises(DeviceError, match="does not answer"):
                for _ in range(3):
                    wires.read()
            assert time.monotonic() - began < 1.0
            proxy.fault("pass")
            wires.connect()
        refusing = DigitalIo(DigitalIoSettings(port=proxy.port, first_input=4000), 20, 0.2)
        with pytest.raises(DeviceError, match="check first_input"):
            refusing.connect()
    finally:
        wires.close()
        proxy.close()


def test_wires_and_numbers_do_not_go_together() -> None:
    with pytest.raises(ConfigError, match="eight wires"):
        validated(FieldbusSettings, {"plc": {"kind": "digital_io"}}, "cell.yaml")
    with pytest.raises(ConfigError, match=r"modbus\.port"):
        validated(FieldbusSettings, {"plc": {"kind": "modbus"}}, "cell.yaml")
    with pytest.raises(ConfigError, match="always numbered"):
        validated(FieldbusSettings, {"profile": EXTENDED.name, "handshake": {"numbered": False}}, "cell.yaml")
