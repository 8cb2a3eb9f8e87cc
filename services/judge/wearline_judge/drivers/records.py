"""The production records on SQLite (WAL, synchronous FULL) or PostgreSQL; what returned is on disk.

One process writes (the judge); any may read. A verdict, its row, its zone figures, its place in
the tally and in the wear bins are one transaction.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, Select, Table, create_engine, event, func, insert, select, text, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from wearline.errors import ConfigError, RecordError
from wearline.messages import Decision, DieEvent, Outcome, RecordRow, Verdict
from wearline_judge.drivers.chain import FIRST, Entry, digest
from wearline_judge.drivers.tables import (
    DIE_EVENT,
    ENTRY,
    MARK,
    METADATA,
    PART,
    RECORD,
    TALLY,
    WEAR_BIN,
    ZONE_FIGURE,
)

BIN = 128
"""Entries that share a wear bin: about 64 cycles of a verdict and an outcome each."""
_WRITER_LOCK = 0x57454152
"""PostgreSQL advisory lock of whoever appends to the chain."""
_WAIT_S = 2.0
"""For another process that is writing; a verdict can wait no longer. [s]"""


def sqlite_url(path: Path) -> str:
    """The URL of a file."""
    return f"sqlite:///{path}"


def open_engine(url: str) -> Engine:
    """Connections that commit durably.

    Raises:
        ConfigError: no URL of SQLite or PostgreSQL.
    """
    try:
        name = make_url(url).get_backend_name()
    except ArgumentError as error:
        raise ConfigError("is no database URL", "judge.records_url", "write sqlite:/// or postgresql://") from error
    if name not in ("sqlite", "postgresql"):
        raise ConfigError(f"{name} is not supported", "judge.records_url", "write sqlite:/// or postgresql://")
    options: dict[str, Any] = {"timeout": _WAIT_S} if name == "sqlite" else {"connect_timeout": 2}
    engine = create_engine(url, connect_args=options, pool_size=2, max_overflow=2)

    @event.listens_for(engine, "connect")
    def connected(connection: Any, _: Any) -> None:
        cursor = connection.cursor()
        if name == "sqlite":
            # The driver's own transactions begin too late for BEGIN IMMEDIATE.
            connection.isolation_level = None
            cursor.execute("PRAGMA journal_mode=WAL")
            cursor.execute("PRAGMA synchronous=FULL")
        else:
            cursor.execute("SET synchronous_commit = on")
            cursor.execute(f"SET lock_timeout = {int(1e3 * _WAIT_S)}")
            connection.commit()
        cursor.close()

    if name == "sqlite":

        @event.listens_for(engine, "begin")
        def begun(connection: Connection) -> None:
            is_reading = connection.get_execution_options().get("is_reading", False)
            connection.exec_driver_sql("BEGIN" if is_reading else "BEGIN IMMEDIATE")

    return engine


class RecordStore:
    """The chained entries and what is made from them; used by one thread."""

    def __init__(self, url: str) -> None:
        """Open, and make the tables where they are missing.

        Raises:
            ConfigError: no URL of SQLite or PostgreSQL.
            RecordError: not a database, damaged, not writable, not reachable.
        """
        self._engine = open_engine(url)
        self._place = self._engine.url.render_as_string(hide_password=True)
        self._insert = sqlite.insert if self._engine.dialect.name == "sqlite" else postgresql.insert
        self._since: dict[int, int] = {}
        with self._writing() as db:
            METADATA.create_all(db)
            if self._engine.dialect.name == "sqlite":
                found = str(db.exec_driver_sql("PRAGMA quick_check(1)").scalar())
                if found != "ok":
                    raise self._broken(found)

    def close(self) -> None:
        """Give the connections back."""
        self._engine.dispose()

    def _broken(self, what: str) -> RecordError:
        return RecordError(
            f"the records cannot be used ({what})", self._place,
            "free space on the disk, restore a backup, or mend judge.records_url",
        )  # fmt: skip

    @contextmanager
    def _writing(self) -> Iterator[Connection]:
        try:
            with self._engine.begin() as db:
                if self._engine.dialect.name == "postgresql":
                    db.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _WRITER_LOCK})
                yield db
        except SQLAlchemyError as error:
            # What was counted on in memory may not have been committed.
            self._since.clear()
            raise self._broken(_first_line(error)) from error

    @contextmanager
    def _reading(self) -> Iterator[Connection]:
        try:
            with self._engine.connect().execution_options(is_reading=True) as db:
                yield db
        except SQLAlchemyError as error:
            raise self._broken(_first_line(error)) from error

    # --- write ---

    def append_verdict(self, verdict: Verdict, utc: datetime, monotonic_s: float) -> bool:
        """Commit one verdict; False where this cycle already has one.

        Raises:
            RecordError: it could not be made durable (disk full, damaged file, no database).
        """
        with self._writing() as db:
            return self._verdict(db, verdict, utc, monotonic_s)

    def append_outcome(self, outcome: Outcome, utc: datetime) -> bool:
        """Commit what the PLC was told; False where this cycle already has an outcome.

        Raises:
            RecordError: it could not be made durable.
        """
        with self._writing() as db:
            return self._outcome(db, outcome, utc)

    def append_cycle(self, verdict: Verdict, outcome: Outcome, utc: datetime, monotonic_s: float) -> bool:
        """Commit verdict and outcome of a cycle that was never judged, both or none; False where it has a verdict.

        Raises:
            RecordError: they could not be made durable.
        """
        with self._writing() as db:
            is_new = self._verdict(db, verdict, utc, monotonic_s)
            self._outcome(db, outcome, utc)
            return is_new

    def append_die_event(self, done: DieEvent, stroke: int, utc: datetime) -> None:
        """Commit one service of the die; the wear trend starts anew.

        Raises:
            RecordError: it could not be made durable.
        """
        body = json.dumps({**done.model_dump(mode="json"), "stroke": stroke})
        with self._writing() as db:
            number = self._append(db, "die_event", None, utc, body)
            db.execute(
                insert(DIE_EVENT),
                {"number": number, "object_index": done.object_index, "stroke": stroke, "kind": done.kind,
                 "note": done.note, "person": done.user},
            )  # fmt: skip
        self._since[done.object_index] = number

    def _append(self, db: Connection, kind: str, cycle_id: str | None, utc: datetime, body: str) -> int:
        last = db.execute(select(ENTRY.c.number, ENTRY.c.digest).order_by(ENTRY.c.number.desc()).limit(1)).first()
        number, previous = (int(last[0]) + 1, str(last[1])) if last else (1, FIRST)
        name, when = cycle_id or f"{kind}-{number}", utc.isoformat(timespec="milliseconds")
        db.execute(
            insert(ENTRY),
            {"number": number, "kind": kind, "cycle_id": name, "utc": when, "body": body, "previous": previous,
             "digest": digest(number, kind, name, when, body, previous)},
        )  # fmt: skip
        return number

    @staticmethod
    def _has(db: Connection, kind: str, cycle_id: str) -> bool:
        asked = select(ENTRY.c.number).where(ENTRY.c.kind == kind, ENTRY.c.cycle_id == cycle_id)
        return db.execute(asked).first() is not None

    def _verdict(self, db: Connection, verdict: Verdict, utc: datetime, monotonic_s: float) -> bool:
        if self._has(db, "verdict", verdict.cycle_id):
            return False
        number = self._append(db, "verdict", verdict.cycle_id, utc, verdict.model_dump_json())
        db.execute(insert(RECORD), {"number": number, "utc": utc, "monotonic_s": monotonic_s, **record_of(verdict)})
        index = verdict.request.object_index
        self._add(db, TALLY, {"object_index": index, "decision": verdict.decision.value}, {"count": 1}, {})
        rows = zone_rows(verdict)
        if rows:
            db.execute(insert(ZONE_FIGURE), [{"number": number, **row} for row in rows])
        since = self._since_of(db, index)
        for row in rows:
            if row["wear_mm"] is None:
                continue
            key = {"object_index": index, "zone": row["zone"], "since": since, "bin": number // BIN}
            self._add(
                db, WEAR_BIN, key, {"count": 1, "wear_sum_mm": row["wear_mm"]},
                {"wear_max_mm": row["wear_mm"], "first_stroke": row["stroke"], "last_stroke": row["stroke"]},
            )  # fmt: skip
        return True

    def _outcome(self, db: Connection, outcome: Outcome, utc: datetime) -> bool:
        if self._has(db, "outcome", outcome.cycle_id):
            return False
        self._append(db, "outcome", outcome.cycle_id, utc, outcome.model_dump_json())
        told = {"told_code": outcome.code if outcome.was_told else None, "told_utc": _instant(outcome.told_utc),
                "cycle_seconds": outcome.cycle_seconds}  # fmt: skip
        db.execute(update(RECORD).where(RECORD.c.cycle_id == outcome.cycle_id).values(**told))
        return True

    def _add(
        self, db: Connection, table: Table, key: Mapping[str, Any], more: Mapping[str, Any], last: Mapping[str, Any]
    ) -> None:
        """Insert a row, or add `more` to the one that is there; of `last`, a maximum is kept, else the newest."""
        made = self._insert(table).values(**key, **more, **last)
        changes: dict[str, Any] = {name: table.c[name] + made.excluded[name] for name in more}
        for name in last:
            if name.endswith("max_mm"):
                old, new = table.c[name], made.excluded[name]
                changes[name] = func.max(old, new) if db.dialect.name == "sqlite" else func.greatest(old, new)
            elif name != "first_stroke":
                changes[name] = made.excluded[name]
        db.execute(made.on_conflict_do_update(index_elements=list(key), set_=changes))

    def _since_of(self, db: Connection, object_index: int) -> int:
        if object_index not in self._since:
            asked = select(func.max(DIE_EVENT.c.number)).where(DIE_EVENT.c.object_index == object_index)
            self._since[object_index] = int(db.execute(asked).scalar() or 0)
        return self._since[object_index]

    # --- read ---

    def has_verdict(self, cycle_id: str) -> bool:
        """Whether this cycle was judged."""
        with self._reading() as db:
            return self._has(db, "verdict", cycle_id)

    def has_outcome(self, cycle_id: str) -> bool:
        """Whether it is on record what the PLC was told."""
        with self._reading() as db:
            return self._has(db, "outcome", cycle_id)

    def rows(
        self, last: int, object_index: int | None = None, cycle_id: str = "", with_verdict: bool = False
    ) -> tuple[RecordRow, ...]:
        """The newest records, newest first."""
        wanted = [RECORD, ENTRY.c.body] if with_verdict else [RECORD]
        asked: Select[Any] = select(*wanted).order_by(RECORD.c.number.desc()).limit(last)
        if with_verdict:
            asked = asked.join(ENTRY, ENTRY.c.number == RECORD.c.number)
        if object_index is not None:
            asked = asked.where(RECORD.c.object_index == object_index)
        if cycle_id:
            asked = asked.where(RECORD.c.cycle_id == cycle_id)
        with self._reading() as db:
            return tuple(_row(dict(found)) for found in db.execute(asked).mappings())

    def verdict(self, cycle_id: str) -> Verdict | None:
        """One verdict as it was published."""
        asked = select(ENTRY.c.body).where(ENTRY.c.kind == "verdict", ENTRY.c.cycle_id == cycle_id)
        with self._reading() as db:
            body = db.execute(asked).scalar()
        return None if body is None else Verdict.model_validate_json(body)

    def counts(self, object_index: int | None = None) -> dict[Decision, int]:
        """How many records of each decision."""
        asked = select(TALLY.c.decision, func.sum(TALLY.c.count)).group_by(TALLY.c.decision)
        if object_index is not None:
            asked = asked.where(TALLY.c.object_index == object_index)
        with self._reading() as db:
            return {Decision(name): int(count) for name, count in db.execute(asked)}

    def objects(self) -> tuple[int, ...]:
        """Object indices that have records."""
        asked = select(TALLY.c.object_index).distinct().order_by(TALLY.c.object_index)
        with self._reading() as db:
            return tuple(int(n) for n in db.execute(asked).scalars())

    def zones(self, object_index: int) -> tuple[str, ...]:
        """Zones that have figures since the last die event; the whole part ("") first."""
        with self._reading() as db:
            since = self._since_of(db, object_index)
            asked = select(WEAR_BIN.c.zone).distinct().where(
                WEAR_BIN.c.object_index == object_index, WEAR_BIN.c.since == since
            )  # fmt: skip
            return tuple(sorted(str(zone) for zone in db.execute(asked).scalars()))

    def newest_wear(self, object_index: int, zone: str = PART, last: int = 1000) -> list[tuple[int, float, float]]:
        """(stroke, wear_mm, mean_error_mm) of the newest measured records since the last die event, oldest first."""
        with self._reading() as db:
            asked = (
                select(ZONE_FIGURE.c.stroke, ZONE_FIGURE.c.wear_mm, ZONE_FIGURE.c.mean_error_mm)
                .where(
                    ZONE_FIGURE.c.object_index == object_index, ZONE_FIGURE.c.zone == zone,
                    ZONE_FIGURE.c.number > self._since_of(db, object_index), ZONE_FIGURE.c.wear_mm.is_not(None),
                )
                .order_by(ZONE_FIGURE.c.number.desc())
                .limit(last)
            )  # fmt: skip
            found = [(int(s), float(w), float(m or 0.0)) for s, w, m in db.execute(asked)]
        return found[::-1]

    def wear_bins(self, object_index: int, zone: str = PART) -> list[tuple[int, float, int]]:
        """(last stroke, mean wear_mm, records) of every bin since the last die event, oldest first."""
        with self._reading() as db:
            asked = (
                select(WEAR_BIN.c.last_stroke, WEAR_BIN.c.wear_sum_mm / WEAR_BIN.c.count, WEAR_BIN.c.count)
                .where(
                    WEAR_BIN.c.object_index == object_index, WEAR_BIN.c.zone == zone,
                    WEAR_BIN.c.since == self._since_of(db, object_index),
                )
                .order_by(WEAR_BIN.c.bin)
            )  # fmt: skip
            return [(int(s), float(w), int(n)) for s, w, n in db.execute(asked)]

    def die_events(self, object_index: int) -> list[tuple[int, str]]:
        """(stroke, kind), oldest first."""
        asked = select(DIE_EVENT.c.stroke, DIE_EVENT.c.kind).where(DIE_EVENT.c.object_index == object_index)
        with self._reading() as db:
            return [(int(s), str(k)) for s, k in db.execute(asked.order_by(DIE_EVENT.c.number))]

    def newest_stroke(self, object_index: int) -> int | None:
        """Stroke of the newest record of an object."""
        asked = select(RECORD.c.stroke).where(RECORD.c.object_index == object_index)
        with self._reading() as db:
            found = db.execute(asked.order_by(RECORD.c.number.desc()).limit(1)).scalar()
        return None if found is None else int(found)

    def first_stroke(self, object_index: int) -> int | None:
        """Stroke of the oldest record of an object."""
        asked = select(RECORD.c.stroke).where(RECORD.c.object_index == object_index)
        with self._reading() as db:
            found = db.execute(asked.order_by(RECORD.c.number).limit(1)).scalar()
        return None if found is None else int(found)

    def entries(self, after: int = 0, batch: int = 1000) -> Iterator[Entry]:
        """All entries behind a number, oldest first."""
        while True:
            asked = select(ENTRY).where(ENTRY.c.number > after).order_by(ENTRY.c.number).limit(batch)
            with self._reading() as db:
                found = [Entry(*row) for row in db.execute(asked)]
            yield from found
            if len(found) < batch:
                return
            after = found[-1].number

    def mark(self, name: str) -> str:
        """A small fact that was kept, or nothing."""
        with self._reading() as db:
            return str(db.execute(select(MARK.c.content).where(MARK.c.name == name)).scalar() or "")

    def set_mark(self, name: str, content: str) -> None:
        """Keep a small fact.

        Raises:
            RecordError: it could not be made durable.
        """
        with self._writing() as db:
            made = self._insert(MARK).values(name=name, content=content)
            db.execute(made.on_conflict_do_update(index_elements=["name"], set_={"content": made.excluded.content}))


def record_of(verdict: Verdict) -> dict[str, Any]:
    """The columns of ``record`` that a verdict fills."""
    request = verdict.request
    return {
        "cycle_id": verdict.cycle_id,
        "object_index": request.object_index,
        "part_id": request.part_id,
        "stroke": request.stroke,
        "measure_number": request.measure_number,
        "decision": verdict.decision.value,
        "code": verdict.code,
        "reason": verdict.reason,
        "mean_error_mm": verdict.mean_error_mm,
        "max_error_mm": verdict.max_error_mm,
        "wear_mm": verdict.wear_mm,
        "deviating_area_mm2": verdict.deviating_area_mm2,
        "coverage": verdict.coverage,
        "is_simulated": verdict.is_simulated,
        "timings_json": json.dumps(verdict.timings_ms),
        "frame_hash": verdict.frame_hash,
        "calibration_hash": verdict.calibration_hash,
        "template_hash": verdict.template_hash,
        "recipe_hash": verdict.recipe_hash,
        "code_version": verdict.code_version,
    }


def zone_rows(verdict: Verdict) -> list[dict[str, Any]]:
    """The rows of ``zone_figure`` of a part that was measured: the whole part, then each zone."""
    if verdict.decision is Decision.NOT_MEASURED:
        return []
    place = {"object_index": verdict.request.object_index, "stroke": verdict.request.stroke}
    whole = {
        **place, "zone": PART, "wear_mm": verdict.wear_mm, "mean_error_mm": verdict.mean_error_mm,
        "max_error_mm": verdict.max_error_mm, "area_mm2": verdict.deviating_area_mm2, "coverage": verdict.coverage,
        "is_within": verdict.decision is Decision.PASSED,
    }  # fmt: skip
    return [
        whole,
        *(
            {
                **place, "zone": zone.name, "wear_mm": zone.wear_mm, "mean_error_mm": zone.mean_error_mm,
                "max_error_mm": zone.max_error_mm, "area_mm2": zone.area_mm2, "coverage": zone.coverage,
                "is_within": zone.is_within,
            }
            for zone in verdict.zones
        ),
    ]  # fmt: skip


def _row(found: Mapping[str, Any]) -> RecordRow:
    fields: Sequence[str] = (
        "cycle_id", "object_index", "part_id", "stroke", "measure_number", "decision", "code", "reason",
        "mean_error_mm", "max_error_mm", "wear_mm", "told_code", "cycle_seconds", "is_simulated",
    )  # fmt: skip
    return RecordRow(
        record_id=found["number"],
        utc=found["utc"].isoformat(timespec="milliseconds"),
        verdict_json=found.get("body", ""),
        **{name: found[name] for name in fields},
    )


def _instant(iso: str) -> datetime | None:
    """An aware instant of an ISO 8601 text; None where it is none."""
    try:
        found = datetime.fromisoformat(iso)
    except ValueError:
        return None
    return found if found.tzinfo is not None else None


def _first_line(error: SQLAlchemyError) -> str:
    cause = getattr(error, "orig", None) or error
    return str(cause).strip().split("\n", 1)[0]
