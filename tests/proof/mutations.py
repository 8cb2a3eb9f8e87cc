"""Leave out every guard of the handshake in turn and see who objects: ``make handshake-mutations``.

Guards are enumerated from the table. The model is asked first, from small searches to large ones; what it cannot see
(measurements by hand, which tell the PLC nothing, and clocks that it does not have) is put to the random walk of the
real code and to its unit tests. Guards of one name that stand in for each other are left out together.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from tests.proof.promela import MANUAL, Guard, guards, is_modelled, without
from tests.proof.run import Bench
from tests.proof.searches import EVERYTHING, Wanted
from tests.proof.spin import missing
from tests.proof.walk import Walk
from wearline_fieldbus.core.handshake import TABLE

ROOT = Path(__file__).resolve().parent.parent.parent
RESULTS = Path(__file__).with_name("mutations.json")
CONSTANT = frozenset({"is_auto", "no_manual_cycle", "plc_is_alive", "link_is_ok", "object_is_settled"})
"""Guards that the model takes for always true."""
BATTERY = (
    Wanted("PLC waits 3 s, no fault", {"FAULTS": 0, "STRICT": 1}),
    Wanted("PLC may lose patience, no fault", {"FAULTS": 0}),
    Wanted("not numbered, PLC waits 3 s, no fault", {"NUMBERED": 0, "FAULTS": 0, "STRICT": 1}),
    Wanted("PLC waits 3 s, one fault of every kind", {"FAULTS": 1, "STRICT": 1, **EVERYTHING}),
    Wanted("not numbered, one cut or kill", {"NUMBERED": 0, "FAULTS": 1, "STRICT": 1, "CUT": 1, "KILL": 1}),
    Wanted("not numbered, PLC may lose patience, one cut", {"NUMBERED": 0, "FAULTS": 1, "CUT": 1}),
    Wanted("PLC may lose patience, one fault of every kind", {"FAULTS": 1, **EVERYTHING}),
)
QUICK = BATTERY[:3]
"""Searches of a second or two."""
WALK_TRIGGERS = 4000
WALK_SEEDS = (1, 2)
UNIT = ("tests/unit/fieldbus/test_handshake.py", "tests/unit/fieldbus/test_handshake_machine.py")
NAMES = f"{UNIT[0]}::test_the_table_names_only_guards_and_effects_that_exist_and_uses_all_of_them"
"""Left out: it compares names, so it would object without looking at what the machine does."""


@dataclass(frozen=True)
class Verdict:
    """What became of one left-out guard, or pair."""

    guard: str
    killed_by: str
    """The search or test that objects; empty = none."""
    objection: str


def singles() -> tuple[Guard, ...]:
    """Every guard of the table and of Ready."""
    return guards()


def is_seen_by_model(guard: Guard) -> bool:
    """Whether leaving it out changes the model."""
    if guard.name in CONSTANT | MANUAL:
        return False
    return guard.row is None or is_modelled(TABLE[guard.row])


def objection_of_model(bench: Bench, left_out: Sequence[Guard], battery: Sequence[Wanted]) -> Verdict | None:
    """The first search that finds an error."""
    name = " AND ".join(map(str, left_out))
    for wanted in battery:
        found = bench.search(wanted, [guard.number for guard in left_out])
        if found.error:
            return Verdict(name, f"model: {wanted.name}", found.error)
    return None


def objection_of_walk(left_out: Sequence[Guard]) -> Verdict | None:
    """The invariant that the real code breaks on a random walk with these guards left out."""
    table, ready = without(left_out)
    for seed in WALK_SEEDS:
        try:
            Walk(seed, table=table, ready=ready).run(WALK_TRIGGERS)
        except AssertionError as error:
            said = str(error).split(" (seed")[0] or "an assertion of the machine itself"
            return Verdict(" AND ".join(map(str, left_out)), f"code: walk with seed {seed}", said)
    return None


def objection_of_code(left_out: Sequence[Guard], tests: Sequence[str]) -> Verdict | None:
    """The first test of the real code that fails with the guards left out (``WEARLINE_WITHOUT_GUARDS``)."""
    environment = {
        **os.environ,
        "WEARLINE_WITHOUT_GUARDS": ",".join(str(guard.number) for guard in left_out),
    }
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-x", "-p", "tests.proof.without", "--deselect", NAMES, *tests],
        cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900.0, check=False,
    )  # fmt: skip
    first = next((line for line in run.stdout.splitlines() if line.startswith("FAILED")), "")
    if run.returncode != 1 or not first:
        return None
    test, _, why = first.removeprefix("FAILED ").partition(" - ")
    return Verdict(" AND ".join(map(str, left_out)), f"code: {test}", why.split(" (seed")[0][:100])


def objection(bench: Bench, left_out: Sequence[Guard]) -> Verdict | None:
    """Who objects first: small searches, the walk, unit tests, large searches."""
    seen = any(is_seen_by_model(guard) for guard in left_out)
    return (
        (objection_of_model(bench, left_out, QUICK) if seen else None)
        or objection_of_walk(left_out)
        or objection_of_code(left_out, UNIT)
        or (objection_of_model(bench, left_out, BATTERY[len(QUICK) :]) if seen else None)
    )


def tried(bench: Bench, chosen: Sequence[Guard]) -> Iterator[Verdict]:
    """Each guard; then what survived, together with each guard that may stand in for it."""
    survivors: list[Guard] = []
    for guard in chosen:
        verdict = objection(bench, [guard])
        if verdict:
            yield verdict
        else:
            survivors.append(guard)
    for guard in survivors:
        kin = sorted((g for g in guards() if g != guard and _is_kin(guard, g)), key=lambda g: g not in survivors)
        pairs = (objection(bench, [guard, other]) for other in kin)
        yield next((verdict for verdict in pairs if verdict), Verdict(str(guard), "", ""))


def _is_kin(one: Guard, other: Guard) -> bool:
    """In the same row, of the same name, or both of Ready."""
    return one.row == other.row or one.name == other.name


def main(argv: Sequence[str] | None = None) -> int:
    """Try every guard (or those that contain a word), print and keep the list; 1 when one survives."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("word", nargs="?", default="")
    options = parser.parse_args(argv)
    if missing():
        print(missing(), file=sys.stderr)
        return 2
    chosen = [guard for guard in singles() if options.word in str(guard)]
    verdicts: list[Verdict] = []
    with tempfile.TemporaryDirectory() as folder:
        for verdict in tried(Bench(Path(folder)), chosen):
            verdicts.append(verdict)
            state = "red" if verdict.killed_by else "SURVIVES"
            print(f"{state:<9} {verdict.guard}\n          {verdict.killed_by}: {verdict.objection}", flush=True)
    killed = sum(bool(verdict.killed_by) for verdict in verdicts)
    print(f"{killed} of {len(verdicts)} left-out guards were objected to")
    if not options.word:
        RESULTS.write_text(json.dumps([asdict(v) for v in verdicts], indent=1) + "\n", encoding="utf-8")
    return 0 if killed == len(verdicts) else 1


if __name__ == "__main__":
    sys.exit(main())
