"""What the PLC side costs: jitter of the poll beside that of a bare sleep, CPU, verdict to PLC. ``make plc-bench``.

The PLC is `wearline plc-sim` in a process of its own, so that the CPU counted here is that of the poll alone.
"""

from __future__ import annotations

import json
import logging
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import yaml

from tests.contract.conftest import free_port, until
from tests.faults.plc_cell import PlcCell
from wearline_fieldbus.core.cycle import HandshakeSettings
from wearline_fieldbus.core.profiles import BASIC
from wearline_fieldbus.core.soft_plc import SoftPlcSettings
from wearline_fieldbus.drivers.plc import PlcLink
from wearline_fieldbus.drivers.s7 import S7Plc, S7Settings

PERIOD_S = 0.010
SECONDS = 20.0
CYCLES = 200


class TimedPlc(S7Plc):
    """Notes when each read begins."""

    def __init__(self, port: int) -> None:
        super().__init__(S7Settings(port=port), BASIC.size, 0.3)
        self.began_s: list[float] = []

    def read(self) -> bytes:
        self.began_s.append(time.monotonic())
        return super().read()


def quantile(values: Sequence[float], part: float) -> float:
    """Of a sample, by rank."""
    return sorted(values)[min(len(values) - 1, int(part * len(values)))]


def line(what: str, values_s: Sequence[float]) -> None:
    """Median, p99 and maximum in ms."""
    ms = [1000.0 * value for value in values_s]
    print(f"{what:<44} {statistics.median(ms):>8.3f} {quantile(ms, 0.99):>8.3f} {max(ms):>8.3f}")


def bare_wait() -> list[float]:
    """How late a 10 ms wait ends, on this machine, now. [s]"""
    late, pause, due_s = [], threading.Event(), time.monotonic()
    for _ in range(int(SECONDS / PERIOD_S)):
        due_s = max(due_s + PERIOD_S, time.monotonic())
        pause.wait(max(0.0, due_s - time.monotonic()))
        late.append(time.monotonic() - due_s)
    return late


def poll(port: int) -> tuple[list[float], list[float], float]:
    """How much later than 10 ms after the one before each read begins [s], how long it takes [s], and CPU share."""
    took: list[float] = []
    plc = TimedPlc(port)
    link = PlcLink(plc, poll_s=PERIOD_S, quiet=BASIC.life_bytes, observe_poll=took.append)
    link.start()
    until(lambda: link.fault == "", 30.0)
    cpu_s, wall_s = time.process_time(), time.monotonic()
    threading.Event().wait(SECONDS)
    share = (time.process_time() - cpu_s) / (time.monotonic() - wall_s)
    link.close()
    began = plc.began_s[5:]
    return [max(0.0, b - a - PERIOD_S) for a, b in pairwise(began)], took, share


def verdict_to_plc(folder: Path) -> list[float]:
    """From the verdict handed over to the outcome published: journal, write and acknowledgement between. [s]"""
    cell = PlcCell(folder, HandshakeSettings(), SoftPlcSettings(stroke_period_s=0.05), verdict_s=0.02)
    cell.start()
    cell.wait_believed(0.0, CYCLES, 120.0)
    cell.close()
    return [cell.told_s[name] - at_s for name, at_s in cell.judged_s.items() if name in cell.told_s]


def main() -> None:
    """Print the figures."""
    if sys.argv[1:] == ["wait"]:
        print(json.dumps(bare_wait()))
        return
    logging.disable(logging.WARNING)
    print(f"{'':<44} {'median':>8} {'p99':>8} {'max':>8}   [ms]")
    with tempfile.TemporaryDirectory() as name:
        folder, port = Path(name), free_port()
        (folder / "cell.yaml").write_text(yaml.safe_dump({"cell": "b", "data_dir": ".", "plc_sim": {"port": port}}))
        command = [sys.executable, "-m", "wearline", "plc-sim", "--config", str(folder / "cell.yaml")]
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as plc:
            # Beside it, in the same seconds and under the same load.
            wait = [sys.executable, "-m", "tests.faults.plc_bench", "wait"]
            with subprocess.Popen(wait, stdout=subprocess.PIPE) as beside:
                late, took, share = poll(port)
                waited: list[float] = json.loads(beside.communicate()[0])
            plc.terminate()
        line("bare wait of 10 ms: late by", waited)
        line("poll every 10 ms: late by", late)
        line("one read of the image", took)
        line("verdict to result acknowledged and published", verdict_to_plc(folder / "cell"))
        print(f"{'CPU of the poll':<44} {100.0 * share:>8.1f} % of one core")


if __name__ == "__main__":
    main()
