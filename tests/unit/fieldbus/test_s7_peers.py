"""S7 implementations that are not ours and not python-snap7 3: the C library as server and client, pyS7, tshark."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pyS7 import S7Client

from tests.contract.conftest import free_port, until
from tests.unit.fieldbus.test_service import Judge
from tests.unit.fieldbus.world import verdict_on
from wearline import messages as m
from wearline.config import CellSettings
from wearline_fieldbus.config import FieldbusSettings, PlcSettings
from wearline_fieldbus.core.profiles import BASIC, Direction
from wearline_fieldbus.core.soft_plc import SoftPlc, SoftPlcSettings
from wearline_fieldbus.drivers.s7 import S7Plc, S7Settings
from wearline_fieldbus.drivers.s7_server import S7Server
from wearline_fieldbus.service import Fieldbus, build

ROOT = Path(__file__).resolve().parents[3]
C_SNAP7 = ROOT / "build" / "snap7-c"
"""An environment of its own with the wheel that bundles the C library; made once."""
PARTNER = r"""
import ctypes, json, sys, time
import snap7
from snap7.type import SrvArea
what, port = sys.argv[1], int(sys.argv[2])
if what == "server":
    memory = (ctypes.c_uint8 * 20)()
    server = snap7.server.Server(log=False)
    server.register_area(SrvArea.DB, 100, memory)
    server.start_to("127.0.0.1", port)
    print("up", flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        if "put" in asked:
            for i, byte in enumerate(bytes.fromhex(asked["put"])):
                memory[asked["at"] + i] = byte
        print(bytes(memory).hex(), flush=True)
    server.stop()
else:
    client = snap7.client.Client()
    client.connect("127.0.0.1", 0, 1, port)
    before = bytes(client.db_read(100, 0, 20)).hex()
    client.db_write(100, 0, bytearray(bytes.fromhex("0f000003")))
    after = bytes(client.db_read(100, 0, 4)).hex()
    try:
        client.db_read(101, 0, 4)
        unknown = "answered"
    except Exception as error:
        unknown = "refused"
    print(json.dumps({"before": before, "after": after, "unknown": unknown}))
"""


@pytest.fixture(scope="module")
def c_python() -> Path:
    """The interpreter of the environment with the C library."""
    python = C_SNAP7 / "bin" / "python"
    if not (C_SNAP7 / "ready").exists():
        shutil.rmtree(C_SNAP7, ignore_errors=True)
        subprocess.run([sys.executable, "-m", "venv", str(C_SNAP7)], check=True, timeout=120)
        install = [str(python), "-m", "pip", "install", "-q", "--only-binary", ":all:", "python-snap7==2.0.2"]
        done = subprocess.run(install, capture_output=True, text=True, timeout=240)
        if done.returncode:
            pytest.skip(f"python-snap7 2.0.2 cannot be installed: {done.stderr.strip().splitlines()[-1]}")
        (C_SNAP7 / "ready").touch()
    return python


class CServer:
    """The C library as a PLC."""

    def __init__(self, python: Path) -> None:
        self.port = free_port()
        self._process = subprocess.Popen(
            [str(python), "-c", PARTNER, "server", str(self.port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._line() == "up"

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def memory(self, **asked: Any) -> bytes:
        """The block, after ``put`` (hex) was written ``at`` a byte."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        return bytes.fromhex(self._line())

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@pytest.fixture
def c_server(c_python: Path) -> Iterator[CServer]:
    found = CServer(c_python)
    yield found
    found.close()


def started(tmp_path: Path, plc: PlcSettings) -> tuple[Fieldbus, list[m.Message]]:
    service = build(CellSettings(cell="c", data_dir=tmp_path), FieldbusSettings(plc=plc))
    assert isinstance(service, Fieldbus)
    said: list[m.Message] = list(service.start(Judge()))
    for name in ("capture", "reconstruct", "judge"):
        said.extend(service.on_alive(name, True))
    return service, said


def test_a_whole_cycle_with_the_c_library_as_plc(c_server: CServer, tmp_path: Path) -> None:
    service, said = started(tmp_path, PlcSettings(port=c_server.port))

    def turned(condition: Any) -> Any:
        def turn() -> bool:
            said.extend(service.tick(time.monotonic()))
            return bool(condition())

        until(turn)

    def shown() -> dict[str, Any]:
        return dict(BASIC.decode(c_server.memory(), Direction.RESPONSE))

    idle: dict[str, Any] = {"start_camera": True, "stop_camera": True, "link_ok": True, "object_index": 3}
    try:
        c_server.memory(at=0, put=BASIC.encode(idle, Direction.REQUEST).hex())
        turned(lambda: shown()["ready"])
        asked = {**idle, "measure": True, "measure_number": 9}
        c_server.memory(at=0, put=BASIC.encode(asked, Direction.REQUEST).hex())
        turned(lambda: any(isinstance(message, m.MeasureRequest) for message in said))
        request = next(message for message in said if isinstance(message, m.MeasureRequest))
        said.extend(service.on_verdict(verdict_on(request)))
        turned(lambda: shown()["measure_finished"])
        assert shown()["passed"] and shown()["echo"] == 9 and shown()["result_code"] == 1
    finally:
        service.close()


def test_the_c_library_reads_and_writes_our_server(c_python: Path) -> None:
    server = S7Server("127.0.0.1", 0, 100, 20)
    try:
        server.put(10, b"\x11\x22")
        done = subprocess.run(
            [str(c_python), "-c", PARTNER, "client", str(server.port)],
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
        told = json.loads(done.stdout)
        assert told == {"before": "00" * 10 + "1122" + "00" * 8, "after": "0f000003", "unknown": "refused"}
    finally:
        server.close()


def test_pys7_reads_what_the_handshake_wrote() -> None:
    server = S7Server("127.0.0.1", 0, 100, 20)
    client = S7Client(address="127.0.0.1", rack=0, slot=1, port=server.port)
    try:
        block = BASIC.encode({"ready": True, "result_code": 19, "echo": 4711}, Direction.RESPONSE)
        plc = S7Plc(S7Settings(port=server.port), 20, 0.4)
        plc.connect()
        plc.write(10, block)
        plc.close()
        client.connect()
        assert client.read(["DB100,B10", "DB100,W12", "DB100,W18"]) == [1, 19, 4711]
    finally:
        client.disconnect()
        server.close()


def test_a_plc_that_is_the_s7_client_measures_on_our_server(tmp_path: Path) -> None:
    port = free_port()
    service, said = started(tmp_path, PlcSettings(kind="s7_server", port=port))
    plc = SoftPlc(SoftPlcSettings(stroke_period_s=0.0, object_index=3))
    partner = S7Plc(S7Settings(port=port), 20, 0.4)
    beliefs: list[Any] = []
    answered: set[str] = set()
    try:
        until(lambda: service._link.fault == "")
        partner.connect()

        def turn() -> bool:
            belief = plc.scan(BASIC.decode(partner.read(), Direction.RESPONSE), time.monotonic())
            partner.write(0, BASIC.encode(plc.request(), Direction.REQUEST))
            beliefs.extend([belief] if belief else [])
            said.extend(service.tick(time.monotonic()))
            for message in list(said):
                if isinstance(message, m.MeasureRequest) and message.cycle_id not in answered:
                    answered.add(message.cycle_id)
                    said.extend(service.on_verdict(verdict_on(message)))
            return len(beliefs) >= 3

        until(turn)
        assert [(b.passed, b.measure_number) for b in beliefs[:3]] == [(True, 1), (True, 2), (True, 3)]
    finally:
        partner.close()
        service.close()


def test_tshark_dissects_a_cycle_without_an_error(tmp_path: Path) -> None:
    if shutil.which("tshark") is None:
        pytest.skip("tshark is not installed")
    server = S7Server("127.0.0.1", 0, 100, 20)
    fields = ("_ws.col.Protocol", "s7comm.param.func", "_ws.malformed")
    command = [
        "tshark", "-i", "lo", "-f", f"tcp port {server.port}", "-d", f"tcp.port=={server.port},tpkt", "-l",
        "-a", "duration:20", "-c", "60", "-T", "fields", *(word for name in fields for word in ("-e", name)),
    ]  # fmt: skip
    capture = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        said: list[str] = []
        up = threading.Event()

        def listen() -> None:
            assert capture.stderr is not None
            for line in capture.stderr:
                said.append(line.strip())
                if "Capturing on" in line:
                    up.set()
            up.set()

        threading.Thread(target=listen, daemon=True).start()
        assert up.wait(20)
        if capture.poll() is not None:
            pytest.skip(f"loopback cannot be captured here: {' '.join(said)[-120:]}")
        plc = S7Plc(S7Settings(port=server.port), 20, 0.4)
        # "Capturing on" comes a moment before the first packet is taken: go on until it has enough.
        until(lambda: _exchange(plc) or capture.poll() is not None, 25.0)
        assert capture.stdout is not None
        rows = [line.split("\t") for line in capture.stdout.read().splitlines()]
        s7 = [row for row in rows if row[0] == "S7COMM"]
        assert {row[1] for row in s7} >= {"0x04", "0x05"}, rows[:5]
        assert not [row for row in s7 if row[2]], "malformed"
    finally:
        capture.kill()
        capture.wait()
        server.close()


def _exchange(plc: S7Plc) -> bool:
    plc.connect()
    plc.write(10, bytes(10))
    plc.read()
    plc.close()
    return False
