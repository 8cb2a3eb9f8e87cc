"""The network to the PLC fails at each step of a cycle: nothing bad is believed, nothing is lost, the press goes on.

The default run takes every kind of fault once or twice, with deadlines cut to half; ``make plc-faults`` takes every
kind at every step, with the deadlines of a plant, and prints the figures.
"""

from __future__ import annotations

import statistics
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.faults.plc_cell import STEPS, PlcCell, Report
from wearline_fieldbus.core.cycle import HandshakeSettings
from wearline_fieldbus.core.soft_plc import SoftPlcSettings

LONGEST_MS = 500.0
"""No exchange with the PLC may block longer."""
KINDS = ("cut", "half_open", "delay", "drip", "hung", "hung_answers", "restart", "shortened", "stop")
SHORT = (
    ("cut", "idle"), ("cut", "measure"), ("cut", "accepted"), ("cut", "measuring"), ("cut", "result"),
    ("cut", "result_answer"), ("cut", "told"), ("cut", "release"), ("half_open", "measuring"), ("delay", "result"),
    ("drip", "result_answer"), ("hung", "result"), ("hung_answers", "result"), ("restart", "measuring"),
    ("shortened", "told"), ("stop", "measuring"),
)  # fmt: skip


def run_fault(cell: PlcCell, kind: str, step: str, hold_s: float) -> float:
    """Let one fault happen at one step and end; how long until the PLC believes a result again. [s]"""
    begin, end = fault(cell, kind, hold_s)
    cell.watch.arm(step, begin)
    assert cell.watch.hit.wait(20.0), f"step {step} was never seen"
    end()
    healed_s = time.monotonic()
    return cell.wait_believed(healed_s, 2) - healed_s


def fault(cell: PlcCell, kind: str, hold_s: float) -> tuple[Callable[[], bool], Callable[[], None]]:
    """What happens at the step (whether an answer is still forwarded), and what ends it."""
    pause = threading.Event().wait  # the length of the fault itself

    def cut() -> bool:
        cell.proxy.cut()
        return False

    def named(name: str) -> Callable[[], bool]:
        def begin() -> bool:
            cell.proxy.fault(name)
            return True

        return begin

    def passes_again(after_s: float) -> Callable[[], None]:
        def end() -> None:
            pause(after_s)
            cell.proxy.fault("pass")

        return end

    def restart() -> None:
        cell.line.power_off()
        pause(0.2)
        cell.line.power_on()

    def shorten() -> None:
        cell.line.resize(12)
        pause(hold_s)
        cell.line.resize(20)

    def stop() -> None:
        cell.line.is_stopped.set()
        pause(max(hold_s, 1.2))
        values = cell.service.health().values
        assert not values["ready"] and not values["plc_link_up"], "a PLC in STOP is noticed"
        cell.line.is_stopped.clear()

    def nothing() -> bool:
        return True

    return {
        "cut": (cut, lambda: None),
        "half_open": (named("swallow"), passes_again(hold_s)),
        "delay": (named("hold"), passes_again(0.15)),
        "drip": (named("drip"), passes_again(hold_s)),
        "hung": (named("hold"), passes_again(hold_s)),
        "hung_answers": (named("hold_answers"), passes_again(hold_s)),
        "restart": (nothing, restart),
        "shortened": (nothing, shorten),
        "stop": (nothing, stop),
    }[kind]


def check(report: Report, longest_ms: float = LONGEST_MS) -> None:
    assert report.false_passed == 0, "a bad part was believed to be good"
    assert report.lost == 0 and report.doubled == 0 and report.contradicted == 0, report
    assert report.longest_ms < longest_ms, report


def test_a_cell_without_faults_is_what_the_others_are_held_against(tmp_path: Path) -> None:
    cell = PlcCell(tmp_path, HandshakeSettings(), SoftPlcSettings(stroke_period_s=0.0))
    cell.start()
    cell.wait_believed(0.0, 12)
    report = cell.close()
    check(report, 2.0 * LONGEST_MS)
    assert report.accepted >= 12 and [b.passed for _, b in cell.line.beliefs[:6]] == [True, True, False] * 2


@pytest.mark.parametrize(("kind", "step"), SHORT)
def test_a_fault_at_a_step(tmp_path: Path, kind: str, step: str) -> None:
    handshake = HandshakeSettings(answer_by_s=1.0, silent_after_s=1.5, io_timeout_s=0.25)
    cell = PlcCell(tmp_path, handshake, SoftPlcSettings(stroke_period_s=0.0, result_timeout_s=1.5))
    cell.start()
    cell.wait_believed(0.0, 2)
    recover_s = run_fault(cell, kind, step, hold_s=0.5)
    # Twice, for a machine that is busy with other tests; the long form is strict.
    check(cell.close(), 2.0 * LONGEST_MS)
    assert recover_s < 5.0


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_every_fault_at_every_step(tmp_path: Path) -> None:
    recovered: dict[str, list[float]] = {}
    reports: list[Report] = []
    for kind in KINDS:
        for step in STEPS:
            cell = PlcCell(tmp_path / f"{kind}-{step}", HandshakeSettings(), SoftPlcSettings(stroke_period_s=0.0))
            cell.start()
            cell.wait_believed(0.0, 2)
            hold_s = 10.0 if kind == "hung" and step in ("idle", "result", "measuring") else 1.0
            recovered.setdefault(kind, []).append(run_fault(cell, kind, step, hold_s))
            reports.append(cell.close())
    every = sorted(s for found in recovered.values() for s in found)
    print(f"\n{'fault':<14} {'faults':>6} {'median s':>9} {'longest s':>9}   until the PLC believes a result again")
    for kind, found in recovered.items():
        print(f"{kind:<14} {len(found):>6} {statistics.median(found):>9.2f} {max(found):>9.2f}")
    p95 = every[min(len(every) - 1, round(0.95 * len(every)))]
    print(
        f"{len(every)} faults, {sum(r.accepted for r in reports)} cycles: false Passed "
        f"{sum(r.false_passed for r in reports)}, lost {sum(r.lost for r in reports)}, doubled "
        f"{sum(r.doubled for r in reports)}, recovered p95 {p95:.2f} s, longest exchange "
        f"{max(r.longest_ms for r in reports):.0f} ms"
    )
    for report in reports:
        check(report)
    assert p95 < 4.0
