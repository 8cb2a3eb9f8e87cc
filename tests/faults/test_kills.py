"""kill -9 while strokes run: nothing false, nothing lost, nothing twice, and measuring again without a hand."""

from __future__ import annotations

import signal
import threading
from pathlib import Path

import pytest

from tests.system.cell import WORN_AFTER, SimulatedCell
from wearline.messages import MeasureRequest, Message, Outcome, Verdict
from wearline.topics import SERVICES

BACK_WITHIN_S = 10.0
MOMENTS: tuple[type[Message], ...] = (MeasureRequest, Verdict, Outcome)
"""A Measure has just been accepted; a verdict has just been given; the PLC has just been told."""


def kill_in_turn(folder: Path, taught: Path, victims: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    back_s: list[tuple[str, str, float]] = []
    with SimulatedCell(folder, taught, first_stroke=WORN_AFTER + 1) as cell:
        cell.wear_every_other_part()
        cell.wait_until_measured(0.0, within_s=30.0, times=2)
        for number, victim in enumerate(victims):
            moment = MOMENTS[number % len(MOMENTS)]
            cell.wait_for_next(moment)
            killed_s = cell.kill(victim)
            back = cell.wait_until_measured(killed_s, within_s=30.0) - killed_s
            back_s.append((victim, moment.__name__, back))
        # Both kinds of part once more, all services being there.
        cell.wait_until_measured(killed_s, within_s=30.0, times=4)
        books = cell.books()
    late = [f"{victim} (at {moment}): {seconds:.1f} s" for victim, moment, seconds in back_s if seconds > BACK_WITHIN_S]
    assert books.audit() == []
    assert not late, f"not measuring again within {BACK_WITHIN_S:g} s after the end of {late}"
    passed = sum(bool(line["passed"]) for line in books.believed)
    failed = sum(line["code"] == 2 for line in books.believed)
    assert passed >= 2 and failed >= 2, "parts of both kinds were measured"
    with capsys.disabled():
        print(
            f"\n{len(victims)} kills, {len(books.journal)} accepted, {passed} passed, {failed} failed, "
            f"{len(books.believed) - passed - failed} not measured; measuring again after "
            f"{max(seconds for _, _, seconds in back_s):.1f} s at most"
        )


def test_each_service_may_die(tmp_path: Path, taught: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kill_in_turn(tmp_path, taught, list(SERVICES), capsys)


HANGS_S = 3.5
"""Longer than the PLC waits, so that what the service does when it goes on is too late. [s]"""


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_each_service_may_hang(tmp_path: Path, taught: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """SIGSTOP in the middle of a cycle: what comes out of a service that was hung is never believed of another part."""
    back_s: list[tuple[str, float]] = []
    with SimulatedCell(tmp_path, taught, first_stroke=WORN_AFTER + 1) as cell:
        cell.wear_every_other_part()
        cell.wait_until_measured(0.0, within_s=30.0, times=2)
        for victim in ("judge", "reconstruct", "capture", "fieldbus", "judge", "reconstruct", "router"):
            cell.wait_for_next(MeasureRequest)
            cell.kill(victim, signal.SIGSTOP)
            threading.Event().wait(HANGS_S)
            on_s = cell.kill(victim, signal.SIGCONT)
            back_s.append((victim, cell.wait_until_measured(on_s, within_s=30.0) - on_s))
        cell.wait_until_measured(on_s, within_s=30.0, times=4)
        books = cell.books()
    assert books.audit() == []
    assert all(seconds <= BACK_WITHIN_S for _, seconds in back_s), back_s
    with capsys.disabled():
        print(
            f"\n{len(back_s)} hangs of {HANGS_S:g} s, {len(books.journal)} accepted; measuring again after "
            f"{max(seconds for _, seconds in back_s):.1f} s at most"
        )


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_twenty_deaths(tmp_path: Path, taught: Path, capsys: pytest.CaptureFixture[str]) -> None:
    victims = ("fieldbus", "judge", "capture", "reconstruct", "router", "hmi", "judge")
    kill_in_turn(tmp_path, taught, [victims[number % len(victims)] for number in range(20)], capsys)
