"""The real handshake against the reference PLC, thousands of triggers with every fault now and then."""

from __future__ import annotations

import multiprocessing
import os
import secrets
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import pytest

from tests.proof.plc import ReferencePlc
from tests.proof.walk import BrokenError, Walk
from wearline_fieldbus.core.handshake import TABLE

TRIGGERS = int(os.environ.get("WEARLINE_WALK_TRIGGERS", "20000"))
"""`make handshake-walk` asks for a hundred thousand, `make handshake-soak` for a million."""
SEED = int(os.environ.get("WEARLINE_WALK_SEED", "0")) or (20261124 if TRIGGERS <= 20_000 else secrets.randbits(30))
"""The default run walks the same way each time; the soak another one each time, and prints it."""
PIECE = 5_000


def walked(seed: int, triggers: int) -> Counter[str]:
    """One walk, in a process of its own.

    Raises:
        BrokenError: an invariant does not hold; the text names seed and trigger.
    """
    walk = Walk(seed)
    walk.run(triggers)
    return walk.tally


def pieces() -> Iterator[tuple[int, int]]:
    """Seeds and lengths."""
    for index, start in enumerate(range(0, TRIGGERS, PIECE)):
        yield SEED + index, min(PIECE, TRIGGERS - start)


@pytest.mark.timeout(120 + TRIGGERS // 100)
def test_no_invariant_is_broken(capsys: pytest.CaptureFixture[str]) -> None:
    total: Counter[str] = Counter()
    with ProcessPoolExecutor(os.cpu_count() or 1, multiprocessing.get_context("spawn")) as pool:
        for tally in pool.map(walked, *zip(*pieces(), strict=True)):
            total += tally
    believed = sum(n for what, n in total.items() if what.startswith("believed"))
    with capsys.disabled():
        print(f"\n{believed} triggers, {total['faults']} faults, seeds from {SEED}: no invariant broken")
        print("  " + ", ".join(f"{what}: {n}" for what, n in sorted(total.items())))
    assert believed >= TRIGGERS
    assert total["faults"] > TRIGGERS / 20
    assert total["untouched"] > TRIGGERS / 2
    # A walk in which little happens would prove little.
    assert {f"believed {code}" for code in (0, 1, 2, 10, 17, 18, 20, 24)} <= set(total) or TRIGGERS < 50_000


def test_a_walk_repeats_itself() -> None:
    assert walked(5, 300) == walked(5, 300)


@pytest.mark.parametrize(
    ("bits", "code", "echo", "passed"),
    [(6, 1, 1, True), (6, 1, 2, None), (14, 1, 1, False), (4, 1, 1, None), (6, 2, 1, False), (2, 1, 1, False)],
)
def test_the_reference_plc_believes_only_what_agrees(bits: int, code: int, echo: int, passed: bool | None) -> None:
    plc = ReferencePlc()
    plc.memory[10] = 1
    while not plc.awaits_result:
        plc.scan(0.0)
    assert plc.number == 1 and plc.memory[0] & 4
    plc.memory[10], plc.memory[13], plc.memory[19] = bits, code, echo
    assert plc.scan(0.1) is None, "it looks at the copy of the scan before"
    end = plc.scan(0.12)
    assert (None if end is None else end.passed) is passed


def test_the_walk_sees_a_broken_table() -> None:
    """A verdict of whatever cycle, object and number is taken: the walk objects."""
    broken = tuple(replace(row, guards=()) if row.effect == "decide_by_verdict" else row for row in TABLE)
    with pytest.raises(BrokenError, match="I1"):
        Walk(3, table=broken).run(3000)
