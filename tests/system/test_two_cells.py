"""Two cells on one host: what happens to one is no matter of the other."""

from __future__ import annotations

from pathlib import Path
from statistics import median

import pytest

from tests.system.cell import SimulatedCell, cycle_seconds
from wearline.messages import Outcome

STROKES = 5


def test_a_cell_that_dies_does_not_touch_its_neighbour(
    tmp_path: Path, taught: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (
        SimulatedCell(tmp_path / "left", taught, name="left", stroke_period_s=1.2) as left,
        SimulatedCell(tmp_path / "right", taught, name="right", stroke_period_s=1.2) as right,
    ):
        left.wait_until_measured(0.0, within_s=40.0)
        start_s = right.wait_until_measured(0.0, within_s=40.0)
        quiet = told_after(right, start_s, STROKES)
        for name in ("router", "fieldbus", "capture", "reconstruct", "judge", "hmi"):
            killed_s = left.kill(name)
        disturbed = told_after(right, killed_s, STROKES)
        back_s = left.wait_until_measured(killed_s, within_s=20.0)
        # What else this machine does may change meanwhile, so the quiet is measured before and after.
        quiet_again = told_after(right, back_s, STROKES)
        neighbour, victim = right.books(), left.books()
    assert neighbour.audit() == []
    assert victim.audit() == []
    assert {line["code"] for line in neighbour.believed} <= {1, 2}, "the neighbour measured every part"
    strokes = [line["stroke"] for line in neighbour.believed]
    assert strokes == list(range(strokes[0], strokes[0] + len(strokes)))
    before, meanwhile, after = (cycle_seconds(phase) for phase in (quiet, disturbed, quiet_again))
    with capsys.disabled():
        print(
            f"\nneighbour's cycles: {told(before)}; while six processes of the other cell die and come back: "
            f"{told(meanwhile)}; afterwards: {told(after)}"
        )
    assert max(meanwhile) < 2.5
    # Both cells share the processors of this machine, and nothing else.
    assert median(meanwhile) < 2.0 * max(median(before), median(after)) + 0.2


def told_after(cell: SimulatedCell, after_s: float, count: int) -> list[Outcome]:
    """The next outcomes from a moment on."""
    found = cell.wait(
        lambda heard: sum(isinstance(h.message, Outcome) and h.at_s > after_s for h in heard) >= count,
        within_s=60.0,
        what=f"{count} outcomes",
    )
    return [h.message for h in found if isinstance(h.message, Outcome) and h.at_s > after_s][:count]


def told(seconds: list[float]) -> str:
    return f"median {1e3 * median(seconds):.0f} ms, longest {1e3 * max(seconds):.0f} ms"
