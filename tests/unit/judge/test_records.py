"""The production records on SQLite and PostgreSQL: durable, once each, chained, and quick at a million."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import inspect, text

from tests.unit.judge.parts import request
from wearline.cli import main
from wearline.errors import ConfigError, RecordError
from wearline.messages import AskRecords, Decision, DieEvent, Outcome, Verdict, ZoneResult
from wearline_judge.drivers.chain import SIGNED_EVERY, ChainError, key_of
from wearline_judge.drivers.records import Cycle, RecordStore, open_engine
from wearline_judge.drivers.schema import HEAD, migrate, version_of
from wearline_judge.drivers.tables import METADATA

KEY = b"k" * 32
START = datetime(2026, 1, 1, tzinfo=UTC)
Database = Callable[[str], str]


def verdict(stroke: int, decision: Decision = Decision.PASSED, wear_mm: float = 0.0, object_index: int = 1) -> Verdict:
    is_measured = decision is not Decision.NOT_MEASURED
    zones = tuple(
        ZoneResult(
            name=name, mean_error_mm=wear_mm / 2, max_error_mm=wear_mm, area_mm2=1.0, wear_mm=wear_mm, coverage=1.0,
            is_within=True,
        )
        for name in ("radius", "rim")
    )  # fmt: skip
    asked = request(stroke, object_index)
    return Verdict(
        cycle_id=asked.cycle_id, is_simulated=False, request=asked, decision=decision, code=1, reason="nothing",
        mean_error_mm=wear_mm / 2 if is_measured else None, wear_mm=wear_mm if is_measured else None,
        max_error_mm=-wear_mm if is_measured else None, coverage=0.99, zones=zones if is_measured else (),
        timings_ms={"judge": 12.5}, frame_hash=f"{stroke:064x}", code_version="v1",
    )  # fmt: skip


def outcome(stroke: int, object_index: int = 1) -> Outcome:
    asked = request(stroke, object_index)
    return Outcome(
        cycle_id=asked.cycle_id, is_simulated=False, request=asked, code=1, passed=True, failed=False, was_told=True,
        cycle_seconds=0.2, told_utc="2026-01-01T00:00:01.250+00:00",
    )  # fmt: skip


def utc(stroke: int) -> datetime:
    return START + timedelta(seconds=stroke)


def cycles(strokes: range, object_index: int = 1) -> list[Cycle]:
    return [
        Cycle(verdict(s, Decision.PASSED, 1e-4 * s, object_index), outcome(s, object_index), utc(s), float(s))
        for s in strokes
    ]


def filled(url: str, strokes: int = 6) -> RecordStore:
    store = RecordStore(url, KEY)
    for stroke in range(1, strokes + 1):
        assert store.append_verdict(verdict(stroke, wear_mm=0.01 * stroke), utc(stroke), 5.0 + stroke)
        assert store.append_outcome(outcome(stroke), utc(stroke))
    return store


def test_a_cycle_is_recorded_once_with_all_that_is_known(database: Database) -> None:
    store = filled(database("one"), 3)
    assert not store.append_verdict(verdict(2, Decision.FAILED), utc(9), 0.0)
    assert not store.append_outcome(outcome(2), utc(9))
    assert store.append(cycles(range(2, 5))) == 2
    rows = store.rows(AskRecords(last=10))
    assert [row.stroke for row in rows] == [4, 3, 2, 1]
    assert rows[-1].utc == "2026-01-01T00:00:01.000+00:00" and rows[-1].part_id == "P1"
    assert rows[-1].told_code == 1 and rows[-1].cycle_seconds == 0.2 and rows[-1].wear_mm == 0.01
    assert store.counts() == {Decision.PASSED: 4} and store.counts(7) == {}
    assert store.verdict("c-00002") == verdict(2, wear_mm=0.02) and store.verdict("c-9") is None
    assert [e.kind for e in store.entries()] == ["verdict", "outcome"] * 4
    assert len(list(store.verified())) == 8
    store.close()


def test_it_is_there_after_a_restart_and_the_chain_goes_on(database: Database) -> None:
    url = database("again")
    filled(url, 2).close()
    store = RecordStore(url, KEY)
    store.append_verdict(verdict(3), utc(3), 0.0)
    assert [e.number for e in store.verified()] == [1, 2, 3, 4, 5]
    store.close()


def test_a_die_event_splits_the_wear_of_each_zone(database: Database) -> None:
    store = filled(database("wear"))
    assert store.newest_wear(1) == [(s, 0.01 * s, 0.01 * s / 2) for s in range(1, 7)]
    assert store.zones(1) == ("", "radius", "rim")
    store.append_die_event(DieEvent(object_index=1, kind="regrind", note="both radii", user="ada"), 6, utc(6))
    assert store.newest_wear(1) == [] and store.wear_bins(1) == [] and store.zones(1) == ()
    store.append_verdict(verdict(7, Decision.FAILED, 0.02), utc(7), 0.0)
    store.append_verdict(verdict(8, Decision.NOT_MEASURED), utc(8), 0.0)
    store.append_verdict(verdict(9, object_index=2, wear_mm=0.5), utc(9), 0.0)
    assert store.newest_wear(1, "rim") == [(7, 0.02, 0.01)]
    assert store.wear_bins(1) == [(7, 0.02, 1)] and store.wear_bins(2) == [(9, 0.5, 1)]
    assert store.die_events(1) == [(6, "regrind")] and store.objects() == (1, 2)
    assert store.newest_stroke(1) == 8 and store.first_stroke(1) == 1 and store.newest_stroke(3) is None
    assert len(list(store.verified())) == 16
    store.close()


CHANGES = (
    ("UPDATE entry SET body = replace(body, 'PASSED', 'FAILED') WHERE number = 5", "entry 5 .* was altered"),
    ("UPDATE entry SET utc = '2030' WHERE number = 7", "entry 7 .* was altered"),
    ("DELETE FROM entry WHERE number = 4", "entry 4 is missing"),
    ("UPDATE entry SET digest = previous WHERE number = 6", "entry 6 .* was altered"),
    ("UPDATE record SET mean_error_mm = 0 WHERE number = 3", "row of entry 3 .* was altered"),
    ("UPDATE record SET told_code = 2 WHERE number = 9", "row of entry 10 .*outcome.* was altered"),
    ("UPDATE zone_figure SET wear_mm = 0 WHERE number = 5 AND zone = 'rim'", "zone figures of entry 5"),
    ("DELETE FROM record WHERE number = 7", "row of entry 7"),
)


@pytest.mark.parametrize(("change", "said"), CHANGES)
def test_the_first_altered_entry_is_named(tmp_path: Path, change: str, said: str) -> None:
    url = f"sqlite:///{tmp_path}/altered.db"
    store = filled(url)
    assert len(list(store.verified())) == 12
    engine = open_engine(url)
    with engine.begin() as db:
        db.execute(text(change))
        db.execute(text("UPDATE entry SET body = '{}' WHERE number = 11"))
    engine.dispose()
    with pytest.raises(ChainError, match=said):
        list(store.verified())
    store.close()
    if "entry SET" in change:
        with pytest.raises(RecordError, match="was altered"):
            RecordStore(url, KEY)


def test_a_chain_made_anew_without_the_key_is_found(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/r.db"
    store = RecordStore(url, KEY)
    store.append(cycles(range(1, SIGNED_EVERY // 2 + 10)))
    assert len(list(store.verified())) == SIGNED_EVERY + 18
    store.close()
    other = RecordStore(f"sqlite:///{tmp_path}/forged.db", b"x" * 32)
    other.append([Cycle(verdict(s, Decision.FAILED), outcome(s), utc(s)) for s in range(1, SIGNED_EVERY // 2 + 10)])
    other.close()
    forged = RecordStore(f"sqlite:///{tmp_path}/forged.db", KEY)
    with pytest.raises(ChainError, match="checkpoint 1000 was altered, or signed with another key"):
        list(forged.verified())
    engine = open_engine(f"sqlite:///{tmp_path}/forged.db")
    with engine.begin() as db:
        db.execute(text("DELETE FROM checkpoint"))
    engine.dispose()
    with pytest.raises(ChainError, match="checkpoint 1000 is missing"):
        list(forged.verified())
    forged.close()


def test_a_tail_that_was_cut_off_behind_a_signature_is_found(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/r.db"
    store = RecordStore(url, KEY)
    store.append(cycles(range(1, SIGNED_EVERY // 2 + 3)))
    engine = open_engine(url)
    with engine.begin() as db:
        db.execute(text("DELETE FROM entry WHERE number > 990"))
    engine.dispose()
    with pytest.raises(ChainError, match="entry 991 is missing"):
        list(store.verified())
    store.close()


def test_pruned_records_leave_a_signed_checkpoint(database: Database) -> None:
    url = database("pruned")
    store = filled(url, 10)
    assert store.prune(4, utc(99), at_most=5) == 5 and store.prune(4, utc(99)) == 1 and store.prune(4, utc(99)) == 0
    assert [row.stroke for row in store.rows(AskRecords(last=99))] == [10, 9, 8, 7]
    assert [e.number for e in store.verified()] == list(range(13, 21))
    assert store.counts() == {Decision.PASSED: 10} and store.wear_bins(1)[0][2] == 10
    assert store.prune(0, utc(99)) == 4 and list(store.verified()) == []
    store.close()
    again = RecordStore(url, KEY)
    again.append_verdict(verdict(11), utc(11), 0.0)
    assert [e.number for e in again.verified()] == [21]
    engine = open_engine(url)
    with engine.begin() as db:
        db.execute(text("UPDATE checkpoint SET number = 19"))
    engine.dispose()
    with pytest.raises(ChainError, match="checkpoint 19 was altered"):
        list(again.verified())
    again.close()


def test_migrations_go_up_down_and_up_again(database: Database) -> None:
    engine = open_engine(database("versions"))

    def tables() -> set[str]:
        with engine.connect() as db:
            return set(inspect(db).get_table_names()) - {"alembic_version"}

    for target, expected in ((HEAD, set(METADATA.tables)), ("base", set()), (HEAD, set(METADATA.tables))):
        with engine.begin() as db:
            migrate(db, target)
        assert tables() == expected
    with engine.connect() as db:
        assert version_of(db) == HEAD
        assert compare_metadata(MigrationContext.configure(db), METADATA) == []
    engine.dispose()


def test_tables_of_a_newer_version_are_left_alone(database: Database) -> None:
    url = database("newer")
    filled(url, 1).close()
    engine = open_engine(url)
    with engine.begin() as db:
        db.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(RecordError, match="version 9999, this code knows"):
        RecordStore(url, KEY)
    with engine.connect() as db:
        assert db.execute(text("SELECT count(*) FROM entry")).scalar() == 2
    engine.dispose()


def test_a_database_server_that_was_started_anew_costs_no_record(postgres: str, tmp_path: Path) -> None:
    admin = open_engine(postgres)
    name = f"anew_{abs(hash(str(tmp_path))):x}"
    with admin.connect().execution_options(isolation_level="AUTOCOMMIT") as db:
        db.execute(text(f'CREATE DATABASE "{name}"'))
    store = filled(postgres.replace("/postgres?", f"/{name}?"), 2)
    with admin.connect().execution_options(isolation_level="AUTOCOMMIT") as db:
        ended = db.execute(
            text("SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity WHERE datname = :name"), {"name": name}
        )
        assert ended.scalar() == 1
    assert store.append_verdict(verdict(3), utc(3), 0.0)
    assert [row.stroke for row in store.rows(AskRecords(last=9))] == [3, 2, 1]
    store.close()
    admin.dispose()


def test_what_is_no_database_is_refused_with_its_place(tmp_path: Path) -> None:
    (tmp_path / "text.db").write_text("not a database" * 100)
    with pytest.raises(RecordError, match=r"text\.db.*file is not a database"):
        RecordStore(f"sqlite:///{tmp_path}/text.db", KEY)
    with pytest.raises(RecordError, match="holds no records"):
        RecordStore(f"sqlite:///{tmp_path}/absent.db", KEY, must_exist=True)
    assert not (tmp_path / "absent.db").exists()
    with pytest.raises(RecordError) as caught:
        RecordStore(f"postgresql://ada:secret@/records?host={tmp_path}", KEY)
    assert "secret" not in str(caught.value) and "records" in str(caught.value)
    for url in ("records.db", "mysql://host/records"):
        with pytest.raises(ConfigError, match=r"judge\.records_url"):
            RecordStore(url, KEY)


def test_the_key_is_made_once_and_for_its_owner_alone(tmp_path: Path) -> None:
    key = key_of(tmp_path / "chain.key")
    assert len(key) == 32 and key == key_of(tmp_path / "chain.key")
    assert (tmp_path / "chain.key").stat().st_mode & 0o777 == 0o600
    (tmp_path / "short.key").write_bytes(b"short")
    with pytest.raises(RecordError, match="is no key"):
        key_of(tmp_path / "short.key")


def test_verify_says_what_it_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "cell.yaml"
    config.write_text("cell: test\ndata_dir: run\n")
    assert main(["verify", "--config", str(config)]) == 2
    assert "holds no records" in capsys.readouterr().err
    folder = tmp_path / "run" / "judge"
    store = RecordStore(f"sqlite:///{folder}/records.db", key_of(folder / "chain.key"))
    store.append(cycles(range(1, 150)))
    assert main(["verify", "--config", str(config)]) == 0
    assert "298 entries, none altered" in capsys.readouterr().out
    engine = open_engine(f"sqlite:///{folder}/records.db")
    with engine.begin() as db:
        db.execute(text("UPDATE entry SET body = replace(body, '12.5', '12.6') WHERE number = 77"))
    engine.dispose()
    assert main(["verify", "--config", str(config)]) == 1
    assert "entry 77 (verdict of cycle c-00039) was altered" in capsys.readouterr().out
    store.close()


def write_on(url: str, stroke: int, pipe: int) -> None:
    """Record cycle after cycle, and say so after each commit; ends by a kill."""
    store = RecordStore(url, KEY)
    while True:
        stroke += 1
        store.append_verdict(verdict(stroke, wear_mm=1e-6 * stroke), utc(stroke), 0.0)
        os.write(pipe, f"verdict {stroke}\n".encode())
        store.append_outcome(outcome(stroke), utc(stroke))
        os.write(pipe, f"outcome {stroke}\n".encode())


def killed_writer(url: str, stroke: int, lines: int, pause_s: float) -> list[tuple[str, int]]:
    """What a writer acknowledged until it was killed, some time after so many lines."""
    reader, pipe = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(reader)
            write_on(url, stroke, pipe)
        finally:
            os._exit(1)
    os.close(pipe)
    said = b""
    while said.count(b"\n") < lines:
        more = os.read(reader, 4096)
        assert more, "the writer ended by itself"
        said += more
    time.sleep(pause_s)
    os.kill(child, signal.SIGKILL)
    while more := os.read(reader, 4096):
        said += more
    os.close(reader)
    os.waitpid(child, 0)
    whole = said.decode().rpartition("\n")[0].split("\n")
    return [(line.split()[0], int(line.split()[1])) for line in whole]


def killed_writers(url: str, kills: int, seed: int) -> None:
    """What was acknowledged before each kill -9 is there, once, and the chain is whole."""
    rng = random.Random(seed)
    acknowledged: list[tuple[str, int]] = []
    stroke = 0
    for _ in range(kills):
        acknowledged += killed_writer(url, stroke, rng.randint(1, 12), rng.uniform(0.0, 0.005))
        store = RecordStore(url, KEY)
        stroke = store.newest_stroke(1) or 0
        store.close()
    store = RecordStore(url, KEY)
    entries = [(e.kind, e.cycle_id) for e in store.verified()]
    assert len(entries) == len(set(entries))
    assert {(kind, f"c-{number:05d}") for kind, number in acknowledged} <= set(entries)
    # One kill can leave no more than one entry that was written and not acknowledged.
    assert len(entries) <= len(acknowledged) + kills
    assert store.counts()[Decision.PASSED] == sum(kind == "verdict" for kind, _ in entries)
    assert sum(count for _, _, count in store.wear_bins(1)) == store.counts()[Decision.PASSED]
    assert len(acknowledged) >= kills
    store.close()


def test_nothing_committed_is_lost_when_the_writer_is_killed(tmp_path: Path) -> None:
    killed_writers(f"sqlite:///{tmp_path}/r.db", 10, seed=1)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_nothing_committed_is_lost_in_200_kills(database: Database) -> None:
    killed_writers(database("killed"), 200, seed=2)


def timed(action: Callable[[], Any], times: int, clock: Callable[[], float]) -> list[float]:
    """Milliseconds of each call, sorted."""
    found = []
    for _ in range(times):
        start = clock()
        action()
        found.append(1e3 * (clock() - start))
    return sorted(found)


def speed(url: str, records: int, inserts: int, clock: Callable[[], float] = time.perf_counter) -> dict[str, float]:
    """Milliseconds at a size."""
    store = RecordStore(url, KEY)
    for start in range(1, records + 1, 5000):
        store.append(cycles(range(start, min(start + 5000, records + 1))))
    coming = iter([verdict(s, wear_mm=1e-4 * s) for s in range(records + 1, records + inserts + 1)])

    def insert() -> None:
        store.append_verdict(next(coming), START, 0.0)

    def trend() -> None:
        assert store.newest_wear(1, last=2000) and sum(n for _, _, n in store.wear_bins(1)) >= records

    taken = timed(insert, inserts, clock)
    found = {
        "insert_median": taken[len(taken) // 2],
        "insert_p99": taken[int(0.99 * len(taken))],
        "list_1000": timed(lambda: store.rows(AskRecords(last=1000)), 9, clock)[4],
        "trend": timed(trend, 9, clock)[4],
        "open": timed(lambda: RecordStore(url, KEY).close(), 3, clock)[1],
    }
    assert store.counts()[Decision.PASSED] == records + inserts
    store.close()
    told = ", ".join(f"{name} {value:.2f} ms" for name, value in found.items())
    print(f"\n{url.partition(':')[0]}, {records} records: {told}")
    return found


def test_records_are_quick(database: Database) -> None:
    # The processor's time alone: other programs on this machine must not fail the test.
    found = speed(database("few"), 1000, 200, time.process_time)
    assert found["list_1000"] <= 50.0 and found["trend"] <= 50.0 and found["insert_median"] <= 5.0


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_million_records_are_quick(database: Database) -> None:
    found = speed(database("million"), 1_000_000, 2000)
    assert found["insert_p99"] <= 10.0
    assert found["list_1000"] <= 50.0
    assert found["trend"] <= 1000.0
