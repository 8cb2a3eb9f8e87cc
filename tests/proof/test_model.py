"""The handshake's table, searched exhaustively: it keeps its promises, and each assumption is needed."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from tests.proof import pages
from tests.proof.promela import SOURCE, guards, is_modelled, meant, model_text
from tests.proof.run import Bench, is_as_wanted
from tests.proof.searches import DEFAULT, LARGE, Wanted
from tests.proof.spin import HEADER, Search, missing
from wearline_fieldbus.core.handshake import READY, TABLE

# A search of a few seconds may take minutes beside other jobs.
pytestmark = pytest.mark.timeout(900)
needs_spin = pytest.mark.skipif(bool(missing()), reason=missing())


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("spin"))


@pytest.fixture(scope="module")
def found() -> Iterator[list[tuple[Wanted, Search]]]:
    """Every search of the default size, printed when all are through."""
    results: list[tuple[Wanted, Search]] = []
    yield results
    print("\n" + "\n".join([HEADER, *(search.row() for _, search in results)]))


@needs_spin
@pytest.mark.parametrize("wanted", DEFAULT, ids=lambda wanted: f"{wanted.parts} parts, {wanted.name}")
def test_default_size(wanted: Wanted, bench: Bench, found: list[tuple[Wanted, Search]]) -> None:
    search = bench.search(wanted)
    found.append((wanted, search))
    assert is_as_wanted(wanted, search), f"{search.row()}\n{search.story}"
    assert search.states > 10_000


@needs_spin
def test_every_row_is_reached(bench: Bench, found: list[tuple[Wanted, Search]]) -> None:
    """A promise kept by a row that nothing reaches would be worth nothing."""
    unreached: set[int] = {index for index, row in enumerate(TABLE) if is_modelled(row)}
    for wanted, search in found:
        lines = model_text(wanted.parts).splitlines()
        at = {n: int(m[1]) - 1 for n, line in enumerate(lines, 1) if (m := re.match(r" +hit = (\d+);", line))}
        if not wanted.violates:
            unreached &= {row for line, row in at.items() if line in search.unreached}
    if len(found) < len(DEFAULT):
        pytest.skip("needs the searches of this module before it")
    assert [TABLE[index] for index in sorted(unreached)] == []


def test_everything_has_a_meaning() -> None:
    """Whatever guard, effect or event the table uses is known to the model by its own name."""
    macros, inlines = meant(SOURCE.read_text(encoding="utf-8"))
    rows = [row for row in TABLE if is_modelled(row)]
    # What Ready needs is generated too.
    assert {name for row in rows for name in row.guards} - {"is_ready"} | set(READY) <= set(macros)
    assert {row.effect for row in rows} <= set(inlines)
    for row in rows:
        assert row.event.__name__.upper() in SOURCE.read_text(encoding="utf-8"), row.event


def test_the_page_shows_the_table() -> None:
    """After a wanted change: ``python -m tests.proof.pages``."""
    page = pages.HANDSHAKE.read_text(encoding="utf-8")
    assert pages.handshake_page(page) == page


@needs_spin
@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("told + Image -> show_idle: result_is_taken", {"FAULTS": 0, "STRICT": 1}),
        ("idle + Image -> accept: measure_rises", {"FAULTS": 0, "STRICT": 1}),
        ("measuring + Tick -> decide_late: answer_is_due", {"FAULTS": 0, "STRICT": 1}),
        ("telling + Written -> confirm_told: write_is_the_result", {"FAULTS": 0, "STRICT": 1}),
        ("measuring + Image -> decide_recipe_changed: object_differs", {"FAULTS": 0}),
        (
            "measuring + VerdictCame -> decide_by_verdict: verdict_is_of_cycle",
            {"FAULTS": 0, "STRICT": 1, "NUMBERED": 0},
        ),
    ],
)
def test_the_model_objects_where_a_guard_is_left_out(name: str, parameters: dict[str, int], bench: Bench) -> None:
    """The short form of ``make handshake-mutations``."""
    guard = next(guard for guard in guards() if str(guard) == name)
    assert bench.search(Wanted(name, parameters), [guard.number]).error


@needs_spin
@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("wanted", LARGE, ids=lambda wanted: f"{wanted.parts} parts, {wanted.name}")
def test_large_size(wanted: Wanted, bench: Bench) -> None:
    search = bench.search(wanted)
    print(f"\n{search.row()}")
    assert is_as_wanted(wanted, search), f"{search.row()}\n{search.story}"
