"""The processes of one cell on one machine: router, services, and a simulated PLC if wanted.

Each is a session of its own, so that Ctrl-C reaches the supervisor alone, and each dies with the
supervisor, however that ends. All of it happens on one thread: the one that called `start`.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import json
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

from wearline.config import CellSettings, load_cell
from wearline.errors import ConfigError
from wearline.log import start_log
from wearline.stop import StopSignal
from wearline.topics import SERVICES

LOG = logging.getLogger(__name__)

PAUSE_S = 0.1
"""Between two looks at the processes. [s]"""
BACKOFF_S = (0.5, 2.0)
"""First and longest pause before a dead process is started anew. [s]"""
STEADY_S = 10.0
"""A process that lived so long starts with the first pause again. [s]"""
TERM_S = 2.0
"""From SIGTERM to SIGKILL. [s]"""
ROUTER_TERM_S = 0.4
"""The part of it that is the router's. [s]"""
LOG_LIMIT_BYTES = 10 * 2**20
"""A log file beyond this moves to <name>.log.1. Twice this, for each process, is all that logs take."""
LOG_LOOK_S = 5.0
PLC_SIM = "plc-sim"
_PR_SET_PDEATHSIG = 1


@dataclass
class _Process:
    name: str
    arguments: tuple[str, ...]
    is_restarted_after_success: bool = True
    popen: subprocess.Popen[bytes] | None = None
    started_s: float = 0.0
    backoff_s: float = BACKOFF_S[0]
    due_s: float | None = 0.0
    """When to start it (monotonic); None = it runs, or is not wanted any more. [s]"""
    log_read_from: int = 0
    told: set[int] = field(default_factory=set)


class Supervisor:
    """Starts the processes of a cell and keeps them running until `stop`.

    Logs go to ``<data_dir>/log/<name>.log``, the process ids to ``<data_dir>/pids.json``.
    """

    def __init__(
        self,
        cell_path: Path,
        with_plc_sim: bool = False,
        clock: Callable[[], float] = time.monotonic,
        names: tuple[str, ...] = SERVICES,
    ) -> None:
        self.cell: CellSettings = load_cell(cell_path)
        self._clock = clock
        self._log_dir = self.cell.data_dir / "log"
        self._pids_path = self.cell.data_dir / "pids.json"
        self._next_log_look_s = 0.0
        config = ("--config", str(cell_path.resolve()))
        self._processes = [
            _Process("router", ("router", *config)),
            *(_Process(name, ("run", name, *config)) for name in names),
        ]
        if with_plc_sim:
            self._processes.append(_Process(PLC_SIM, (PLC_SIM, *config), is_restarted_after_success=False))
        self._with_plc_sim = with_plc_sim

    def pids(self) -> dict[str, int]:
        """Of the processes that run now."""
        return {p.name: p.popen.pid for p in self._processes if p.popen is not None}

    def is_done(self, name: str) -> bool:
        """Whether a process ended by itself with success and is not started again (plc-sim after its strokes)."""
        return any(p.name == name and p.popen is None and p.due_s is None for p in self._processes)

    def start(self) -> None:
        """Check the ports and start every process.

        Raises:
            ConfigError: a port is taken; nothing was started.
        """
        for setting, host, port in _ports(self.cell, self._with_plc_sim):
            _check_port(setting, host, port)
        self._log_dir.mkdir(parents=True, exist_ok=True)
        self.step()

    def step(self) -> None:
        """One look: note who died, start who is due, keep the logs bounded."""
        now_s = self._clock()
        has_changed = False
        for process in self._processes:
            if process.popen is not None and (code := process.popen.poll()) is not None:
                self._note_end(process, code, now_s)
                has_changed = True
            if process.due_s is not None and now_s >= process.due_s:
                self._spawn(process, now_s)
                has_changed = True
        if has_changed:
            self._write_pids()
        if now_s >= self._next_log_look_s:
            self._next_log_look_s = now_s + LOG_LOOK_S
            self._bound_logs()

    def run(self, stop: threading.Event) -> None:
        """`step` until the event is set."""
        while not stop.wait(PAUSE_S):
            self.step()

    def stop(self) -> None:
        """End every process within 3 s: SIGTERM to all but the router, then the router, then SIGKILL."""
        deadline_s = time.monotonic() + TERM_S
        for process in self._processes:
            process.due_s = None
        # The services say goodbye on the bus, so the router goes last.
        # A hung service must leave the router its time to stop.
        for group, spare_s in ((self._processes[1:], ROUTER_TERM_S), (self._processes[:1], 0.0)):
            running = [p.popen for p in group if p.popen is not None]
            for popen in running:
                _signal(popen, signal.SIGTERM)
            for popen in running:
                _wait(popen, deadline_s - spare_s - time.monotonic())
            for popen in running:
                if popen.poll() is None:
                    _signal(popen, signal.SIGKILL)
                    popen.wait()
        for process in self._processes:
            process.popen = None
        self._write_pids()

    def __enter__(self) -> Self:
        try:
            self.start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.stop()

    def _spawn(self, process: _Process, now_s: float) -> None:
        path = self._log_dir / f"{process.name}.log"
        environment = {
            # One process per job and few cores: threads inside a job would only take turns.
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            **os.environ,
            "PYTHONUNBUFFERED": "1",
        }
        with path.open("ab") as log:
            process.log_read_from = log.tell()
            process.popen = subprocess.Popen(
                [sys.executable, "-m", "wearline", *process.arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=environment,
                start_new_session=True,
                preexec_fn=_die_with(os.getpid()),
            )
        process.started_s, process.due_s = now_s, None
        LOG.info("%s started, pid %d", process.name, process.popen.pid)

    def _note_end(self, process: _Process, code: int, now_s: float) -> None:
        process.popen = None
        if code == 0 and not process.is_restarted_after_success:
            LOG.info("%s is done", process.name)
            return
        if now_s - process.started_s >= STEADY_S:
            process.backoff_s = BACKOFF_S[0]
            process.told.clear()
        process.due_s = now_s + process.backoff_s
        why = f"signal {-code}" if code < 0 else f"exit {code}"
        # What fails again and again is told once.
        if code not in process.told:
            process.told.add(code)
            LOG.warning(
                "%s ended (%s: %s), starts again in %.1f s",
                process.name, why, self._last_line(process) or "nothing in its log", process.backoff_s,
            )  # fmt: skip
        process.backoff_s = min(2 * process.backoff_s, BACKOFF_S[1])

    def _last_line(self, process: _Process) -> str:
        try:
            with (self._log_dir / f"{process.name}.log").open("rb") as log:
                end = log.seek(0, os.SEEK_END)
                log.seek(max(process.log_read_from if process.log_read_from <= end else 0, end - 4096))
                lines = log.read().decode(errors="replace").strip().splitlines()
        except OSError:
            return ""
        return lines[-1] if lines else ""

    def _write_pids(self) -> None:
        self.cell.data_dir.mkdir(parents=True, exist_ok=True)
        draft = self._pids_path.with_suffix(".json.new")
        draft.write_text(json.dumps(self.pids()) + "\n", encoding="utf-8")
        draft.replace(self._pids_path)

    def _bound_logs(self) -> None:
        for process in self._processes:
            path = self._log_dir / f"{process.name}.log"
            with contextlib.suppress(OSError):
                if path.stat().st_size > LOG_LIMIT_BYTES:
                    shutil.copyfile(path, path.with_suffix(".log.1"))
                    # The process appends, so it goes on at the new end.
                    os.truncate(path, 0)


def _die_with(parent: int) -> Callable[[], None]:
    """What a child does before its program: ask to be killed when its parent dies."""
    libc = ctypes.CDLL(None, use_errno=True)

    def ask() -> None:
        libc.prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
        # The parent may have died before the request.
        if os.getppid() != parent:
            os._exit(1)

    return ask


def _signal(popen: subprocess.Popen[bytes], number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        # Its session is its own: what it started itself ends, too.
        os.killpg(popen.pid, number)


def _wait(popen: subprocess.Popen[bytes], timeout_s: float) -> None:
    with contextlib.suppress(subprocess.TimeoutExpired):
        popen.wait(timeout=max(0.0, timeout_s))


def _ports(cell: CellSettings, with_plc_sim: bool) -> Iterator[tuple[str, str, int]]:
    """Every fixed port of a cell: the setting that names it, host, port."""
    endpoint = cell.router.listen or cell.router.endpoint
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    yield "router.endpoint", host.strip("[]"), int(port)
    for service, metrics_port in cell.metrics_ports.items():
        yield f"metrics_ports.{service}", cell.metrics_host, metrics_port
    sections = [("hmi", cell.hmi), *([("plc_sim", cell.plc_sim)] if with_plc_sim else [])]
    for name, section in sections:
        if isinstance(section_port := section.get("port"), int):
            yield f"{name}.port", str(section.get("host", "127.0.0.1")), section_port


def _check_port(setting: str, host: str, port: int) -> None:
    if not port:
        return
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            # Connections that have just ended do not keep a server from listening.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            what = f"port {port} is taken"
        elif error.errno == errno.EACCES:
            what = f"port {port} needs rights that this user has not"
        else:
            what = f"cannot listen on {host} port {port} ({error.strerror or error})"
        raise ConfigError(what, setting, f"stop what listens there or change {setting} in cell.yaml") from error


def up(cell_path: Path, with_plc_sim: bool) -> int:
    """Run a cell until SIGTERM or SIGINT.

    Raises:
        ConfigError: cell.yaml cannot be obeyed, or a port is taken.
    """
    supervisor = Supervisor(cell_path, with_plc_sim)
    start_log(supervisor.cell.cell, "supervisor", "plain")
    with StopSignal() as stop, supervisor:
        while not stop.wait(PAUSE_S):
            supervisor.step()
    return 0
