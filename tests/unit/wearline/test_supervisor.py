"""Processes of a cell: started, kept, stopped, none left behind."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.contract.conftest import free_port, until
from wearline import supervisor
from wearline.errors import ConfigError
from wearline.supervisor import Supervisor, _Process


@pytest.fixture
def cell_path(tmp_path: Path) -> Path:
    path = tmp_path / "cell.yaml"
    path.write_text(
        f"cell: c1\ndata_dir: data\nrouter: {{endpoint: tcp/127.0.0.1:{free_port()}}}\n"
        f"metrics_ports: {{judge: {free_port()}}}\nhmi: {{port: {free_port()}}}\n"
    )
    return path


def pids(path: Path) -> dict[str, int]:
    try:
        found: dict[str, int] = json.loads((path.parent / "data" / "pids.json").read_text())
    except FileNotFoundError:
        return {}
    return found


def listens(endpoint: str) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", int(endpoint.rpartition(":")[2]))) == 0


@pytest.fixture
def router_only(cell_path: Path) -> Iterator[Supervisor]:
    with Supervisor(cell_path, names=()) as running:
        yield running


def test_a_killed_process_starts_again_within_two_seconds(router_only: Supervisor, cell_path: Path) -> None:
    endpoint = router_only.cell.router.endpoint
    until(lambda: listens(endpoint))
    first = pids(cell_path)["router"]
    os.kill(first, signal.SIGKILL)
    killed_s = time.monotonic()

    def is_back() -> bool:
        router_only.step()
        return pids(cell_path).get("router", first) != first

    until(is_back)
    assert 0.4 < time.monotonic() - killed_s < 2.0
    assert pids(cell_path) == router_only.pids()
    until(lambda: listens(endpoint))


def test_a_stop_ends_all_and_says_so(cell_path: Path) -> None:
    with Supervisor(cell_path, names=()) as running:
        process = psutil.Process(running.pids()["router"])
        until(lambda: listens(running.cell.router.endpoint))
        asked_s = time.monotonic()
    assert time.monotonic() - asked_s < 3.0
    assert not process.is_running()
    assert pids(cell_path) == {}
    assert "listens on" in (cell_path.parent / "data" / "log" / "router.log").read_text()


HUNG = """
import signal, threading
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("hung", flush=True)
threading.Event().wait()
"""


def replace_programs(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    """Every process of a supervisor runs this instead."""
    real = subprocess.Popen

    def popen(command: list[str], **options: object) -> object:
        return real([sys.executable, "-c", program], **options)  # type: ignore[call-overload]

    monkeypatch.setattr(subprocess, "Popen", popen)


def test_a_process_that_ignores_its_end_is_killed(cell_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace_programs(monkeypatch, HUNG)
    running = Supervisor(cell_path, names=("judge",))
    running.start()
    processes = [psutil.Process(pid) for pid in running.pids().values()]
    for name in ("router", "judge"):
        until(lambda name=name: "hung" in (cell_path.parent / "data" / "log" / f"{name}.log").read_text())  # type: ignore[misc]
    asked_s = time.monotonic()
    running.stop()
    assert time.monotonic() - asked_s < 3.0
    assert not any(process.is_running() for process in processes)


def test_a_simulated_plc_that_is_done_is_not_started_again(cell_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace_programs(monkeypatch, "pass")
    clock = [0.0]
    running = Supervisor(cell_path, with_plc_sim=True, clock=lambda: clock[0], names=())
    try:
        running.start()

        def is_done() -> bool:
            running.step()
            return running.is_done("plc-sim")

        until(is_done)

        def router_ended() -> bool:
            running.step()
            return "router" not in running.pids()

        until(router_ended)
        clock[0] += 10.0
        running.step()
        # The router ended with success, too, and comes back all the same.
        assert set(running.pids()) == {"router"}
        assert not running.is_done("router")
    finally:
        running.stop()


def test_pauses_grow_to_two_seconds_and_start_anew_after_a_steady_run(cell_path: Path) -> None:
    running, process = Supervisor(cell_path, names=()), _Process("router", ())
    pauses = []
    for _ in range(4):
        process.started_s = 100.0
        running._note_end(process, -9, 101.0)
        assert process.due_s is not None
        pauses.append(process.due_s - 101.0)
    running._note_end(process, -9, 200.0)
    assert process.due_s is not None
    assert [*pauses, process.due_s - 200.0] == [0.5, 1.0, 2.0, 2.0, 0.5]


@pytest.mark.parametrize("setting", ["router.endpoint", "metrics_ports.judge", "hmi.port", "plc_sim.port"])
def test_a_taken_port_is_named_with_its_cure(cell_path: Path, setting: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        section = {
            "router.endpoint": f"router: {{endpoint: tcp/127.0.0.1:{port}}}",
            "metrics_ports.judge": f"metrics_ports: {{judge: {port}}}",
            "hmi.port": f"hmi: {{port: {port}}}",
            "plc_sim.port": f"plc_sim: {{port: {port}}}",
        }[setting]
        router = "" if setting == "router.endpoint" else f"router: {{endpoint: tcp/127.0.0.1:{free_port()}}}\n"
        cell_path.write_text(f"cell: c1\ndata_dir: data\n{router}{section}\n")
        running = Supervisor(cell_path, with_plc_sim=True, names=())
        with pytest.raises(ConfigError, match=f"{setting}: port {port} is taken; stop what .* or change {setting}"):
            running.start()
        assert running.pids() == {}


def test_logs_stay_bounded(router_only: Supervisor, cell_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "LOG_LIMIT_BYTES", 10)
    log = cell_path.parent / "data" / "log" / "router.log"
    until(lambda: log.stat().st_size > 10)
    said = log.read_text()
    router_only._bound_logs()
    assert log.stat().st_size == 0
    assert log.with_suffix(".log.1").read_text() == said


UP = """
import sys
from pathlib import Path
from wearline import supervisor
# A cell of two: whatever services there are, these tests watch processes.
supervisor.Supervisor.__init__.__defaults__ = (False, supervisor.time.monotonic, ("judge",))
sys.exit(supervisor.up(Path(sys.argv[1]), False))
"""


@pytest.fixture
def up(cell_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen([sys.executable, "-c", UP, str(cell_path)], stderr=subprocess.DEVNULL)
    try:
        until(lambda: {"router", "judge"} <= set(pids(cell_path)))
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_process_outlives_its_supervisor(
    up: subprocess.Popen[bytes], cell_path: Path, number: signal.Signals
) -> None:
    router = psutil.Process(pids(cell_path)["router"])
    children = psutil.Process(up.pid).children(recursive=True)
    assert router in children
    asked_s = time.monotonic()
    up.send_signal(number)
    code = up.wait(timeout=5)
    until(lambda: not any(child.is_running() and child.status() != psutil.STATUS_ZOMBIE for child in children))
    assert time.monotonic() - asked_s < 3.0
    if number is not signal.SIGKILL:
        assert code == 0
        assert pids(cell_path) == {}
