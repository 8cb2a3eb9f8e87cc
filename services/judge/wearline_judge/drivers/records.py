"""The production records on SQLite (WAL, synchronous FULL) or PostgreSQL; what returned is on disk.

One process writes (the judge); any may read. A verdict, its row, its zone figures, its place in
the tally and in the wear bins are one transaction.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import (
    Connection,
    Engine,
    Select,
    Table,
    create_engine,
    delete,
    event,
    func,
    insert,
    select,
    text,
    update,
)
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from wearline.errors import ConfigError, RecordError
from wearline.messages import AskRecords, Decision, DieEvent, Outcome, RecordRow, Verdict
from wearline_judge.drivers.chain import FIRST, SIGNED_EVERY, ChainError, Checkpoint, Entry, checked, digest, signature
from wearline_judge.drivers.schema import HEAD, migrate, version_of
from wearline_judge.drivers.tables import (
    ALARM,
    CHECKPOINT,
    DIE_EVENT,
    ENTRY,
    MARK,
    PART,
    RECORD,
    TALLY,
    WEAR_BIN,
    WEAR_MAP,
    ZONE_FIGURE,
)

BIN = 128
"""Entries that share a wear bin: about 64 cycles of a verdict and an outcome each."""
_WRITER_LOCK = 0x57454152
"""PostgreSQL advisory lock of whoever appends to the chain."""
_PRUNED = "pruned"
"""Mark: how many records were pruned."""
_HEAD_CHECKED = 100
"""Newest entries that are checked whenever the records are opened."""
_GOES_ON = "coil_change"
"""The one die event after which the same surface wears on."""
_AT_ONCE = 500
"""Cycle ids in one question; databases bound the number of parameters."""
_SEARCHED = 400_000
"""Newest entries (half as many records) that are searched for a part of an id."""
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
    options: dict[str, Any] = {"timeout": _WAIT_S}
    if name == "postgresql":
        # A server that went away without a word must cost one verdict, not a cell.
        options = {"connect_timeout": 2, "tcp_user_timeout": int(1e3 * _WAIT_S)}
    # A connection that a restarted server has forgotten is noticed before it is used.
    engine = create_engine(url, connect_args=options, pool_size=2, max_overflow=2, pool_pre_ping=name == "postgresql")

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


@dataclass(frozen=True)
class Cycle:
    """One cycle to be recorded: the verdict, the outcome, or both."""

    verdict: Verdict | None
    outcome: Outcome | None
    utc: datetime
    monotonic_s: float = 0.0

    @property
    def cycle_id(self) -> str:
        return self.verdict.cycle_id if self.verdict is not None else self._outcome.cycle_id

    @property
    def _outcome(self) -> Outcome:
        assert self.outcome is not None
        return self.outcome


@dataclass(frozen=True)
class StoredAlarm:
    """Alarm of one zone; see the table ``alarm``."""

    zone: str
    level: int
    stroke: int
    reason: str
    person: str
    utc: str
    note: str


@dataclass(frozen=True)
class StoredMap:
    """Running sums of a wear map."""

    square_px: int
    origin_px: tuple[int, int]
    arrays: dict[str, NDArray[np.float64]]


class _Draft:
    """Rows of one transaction, chained to the head of what is there."""

    def __init__(self, number: int, previous: str, key: bytes) -> None:
        self._number, self._previous, self._key = number, previous, key
        self.rows: dict[Table, list[dict[str, Any]]] = {}
        self.records: dict[str, dict[str, Any]] = {}
        self.tally: dict[tuple[int, str], int] = {}
        self.bins: dict[tuple[int, str, int, int], dict[str, Any]] = {}
        self.told: dict[str, dict[str, Any]] = {}

    def put(self, table: Table, row: dict[str, Any]) -> None:
        self.rows.setdefault(table, []).append(row)

    def entry(self, kind: str, cycle_id: str | None, utc: datetime, body: str) -> int:
        self._number += 1
        number, when = self._number, utc.isoformat(timespec="milliseconds")
        name = cycle_id or f"{kind}-{number}"
        own = digest(number, kind, name, when, body, self._previous)
        self.put(
            ENTRY,
            {"number": number, "kind": kind, "cycle_id": name, "utc": when, "body": body, "previous": self._previous,
             "digest": own},
        )  # fmt: skip
        if number % SIGNED_EVERY == 0:
            self.put(CHECKPOINT, signed_row(self._key, number, own, when, is_pruned=False))
        self._previous = own
        return number

    def verdict(self, verdict: Verdict, utc: datetime, monotonic_s: float, since: int) -> None:
        number = self.entry("verdict", verdict.cycle_id, utc, verdict.model_dump_json())
        record = {"number": number, "utc": utc, "monotonic_s": monotonic_s, **record_of(verdict), **_UNTOLD}
        self.put(RECORD, record)
        self.records[verdict.cycle_id] = record
        index = verdict.request.object_index
        place = (index, verdict.decision.value)
        self.tally[place] = self.tally.get(place, 0) + 1
        for row in zone_rows(verdict):
            self.put(ZONE_FIGURE, {"number": number, **row})
            if row["wear_mm"] is not None:
                self._bin((index, row["zone"], since, number // BIN), row["wear_mm"], row["stroke"])

    def _bin(self, key: tuple[int, str, int, int], wear_mm: float, stroke: int) -> None:
        found = self.bins.get(key)
        if found is None:
            self.bins[key] = {
                "count": 1, "wear_sum_mm": wear_mm, "wear_max_mm": wear_mm, "first_stroke": stroke,
                "last_stroke": stroke,
            }  # fmt: skip
            return
        found["count"] += 1
        found["wear_sum_mm"] += wear_mm
        found["wear_max_mm"] = max(found["wear_max_mm"], wear_mm)
        found["last_stroke"] = stroke

    def outcome(self, outcome: Outcome, utc: datetime) -> None:
        self.entry("outcome", outcome.cycle_id, utc, outcome.model_dump_json())
        told = told_of(outcome)
        if outcome.cycle_id in self.records:
            self.records[outcome.cycle_id].update(told)
        else:
            self.told[outcome.cycle_id] = told


class RecordStore:
    """The chained entries and what is made from them; used by one thread."""

    def __init__(self, url: str, key: bytes, *, must_exist: bool = False) -> None:
        """Open, and make or migrate the tables.

        Args:
            url: of SQLite or PostgreSQL.
            key: signs checkpoints (`chain.key_of`).
            must_exist: do not make a database where there is none.

        Raises:
            ConfigError: no URL of SQLite or PostgreSQL.
            RecordError: not a database, damaged, not writable, not reachable, or of a newer version.
        """
        self._engine = open_engine(url)
        self._place = self._engine.url.render_as_string(hide_password=True)
        self._key = key
        self._insert = sqlite.insert if self._engine.dialect.name == "sqlite" else postgresql.insert
        self._count = self._upsert(TALLY, {"count": "sum"})
        self._gather = self._upsert(
            WEAR_BIN, {"count": "sum", "wear_sum_mm": "sum", "wear_max_mm": "max", "last_stroke": "new"}
        )
        self._keep = self._upsert(MARK, {"content": "new"})
        self._raise = self._upsert(ALARM, dict.fromkeys(("level", "stroke", "reason", "person", "utc", "note"), "new"))
        self._draw = self._upsert(WEAR_MAP, dict.fromkeys(("square_px", "origin_x_px", "origin_y_px", "arrays"), "new"))
        self._since: dict[int, int] = {}
        file = self._engine.url.database
        if must_exist and self._engine.dialect.name == "sqlite" and not Path(file or "").is_file():
            raise self._absent()
        try:
            with self._reading() as db:
                found = version_of(db)
            if not found and must_exist:
                raise self._absent()
            if found != HEAD:
                with self._writing() as db:
                    migrate(db)
        except ValueError as error:
            raise self._broken(str(error)) from error
        self._check_head()

    def close(self) -> None:
        """Give the connections back."""
        self._engine.dispose()

    def _absent(self) -> RecordError:
        return RecordError("holds no records", self._place, "check data_dir and judge.records_url in cell.yaml")

    def _broken(self, what: str) -> RecordError:
        return RecordError(
            f"the records cannot be used ({what})", self._place,
            "free space on the disk, restore a backup, or mend judge.records_url",
        )  # fmt: skip

    def _upsert(self, table: Table, changes: Mapping[str, str]) -> Any:
        """Insert a row; where its key is there already, add to, maximise or replace the columns in `changes`."""
        made = self._insert(table)
        greatest = func.max if self._engine.dialect.name == "sqlite" else func.greatest
        merge: dict[str, Callable[[Any, Any], Any]] = {
            "sum": lambda old, new: old + new, "max": greatest, "new": lambda _, new: new,
        }  # fmt: skip
        return made.on_conflict_do_update(
            index_elements=[column.name for column in table.primary_key],
            set_={name: merge[how](table.c[name], made.excluded[name]) for name, how in changes.items()},
        )

    def _check_head(self) -> None:
        """The newest entries must fit each other: who appends to a damaged file makes it worse."""
        asked = select(ENTRY).order_by(ENTRY.c.number.desc()).limit(_HEAD_CHECKED)
        with self._reading() as db:
            newest = [Entry(*row) for row in db.execute(asked)]
        later: Entry | None = None
        for entry in newest:
            own = digest(entry.number, entry.kind, entry.cycle_id, entry.utc, entry.body, entry.previous)
            if own != entry.digest or (later is not None and later.previous != own):
                raise self._broken(f"entry {entry.number} was altered")
            later = entry

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
        return self.append((Cycle(verdict, None, utc, monotonic_s),)) == 1

    def append_outcome(self, outcome: Outcome, utc: datetime) -> bool:
        """Commit what the PLC was told; False where this cycle already has an outcome.

        Raises:
            RecordError: it could not be made durable.
        """
        return self.append((Cycle(None, outcome, utc),)) == 1

    def append(self, cycles: Sequence[Cycle]) -> int:
        """Commit cycles, all or none; entries that are there already are left out. Returns the number of new entries.

        Raises:
            RecordError: they could not be made durable.
        """
        with self._writing() as db:
            draft = self._draft(db)
            known = self._known(db, [cycle.cycle_id for cycle in cycles])
            added = 0
            for cycle in cycles:
                if cycle.verdict is not None and ("verdict", cycle.cycle_id) not in known:
                    since = self._since_of(db, cycle.verdict.request.object_index)
                    draft.verdict(cycle.verdict, cycle.utc, cycle.monotonic_s, since)
                    known.add(("verdict", cycle.cycle_id))
                    added += 1
                if cycle.outcome is not None and ("outcome", cycle.cycle_id) not in known:
                    draft.outcome(cycle.outcome, cycle.utc)
                    known.add(("outcome", cycle.cycle_id))
                    added += 1
            self._flush(db, draft)
        return added

    def append_die_event(self, done: DieEvent, stroke: int, utc: datetime) -> None:
        """Commit one service of the die; the wear trend starts anew.

        Raises:
            RecordError: it could not be made durable.
        """
        body = json.dumps({**done.model_dump(mode="json"), "stroke": stroke})
        with self._writing() as db:
            draft = self._draft(db)
            number = draft.entry("die_event", None, utc, body)
            draft.put(DIE_EVENT, {"number": number, **die_event_of(json.loads(body))})
            self._flush(db, draft)
        if done.kind != _GOES_ON:
            self._since[done.object_index] = number

    def append_acknowledgement(self, object_index: int, alarm: StoredAlarm, utc: datetime) -> None:
        """Commit that somebody took notice of an alarm: as an entry of the chain, and in the alarm's row.

        Raises:
            RecordError: it could not be made durable.
        """
        body = json.dumps({"object_index": object_index, **alarm.__dict__})
        with self._writing() as db:
            draft = self._draft(db)
            draft.entry("acknowledgement", None, utc, body)
            self._flush(db, draft)
            db.execute(self._raise, {"object_index": object_index, **alarm.__dict__})

    def keep_alarm(self, object_index: int, alarm: StoredAlarm) -> None:
        """Keep the state of a zone's alarm.

        Raises:
            RecordError: it could not be made durable.
        """
        with self._writing() as db:
            db.execute(self._raise, {"object_index": object_index, **alarm.__dict__})

    def keep_map(self, object_index: int, wear: StoredMap) -> None:
        """Keep a wear map.

        Raises:
            RecordError: it could not be made durable.
        """
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **wear.arrays)  # type: ignore[arg-type]
        row = {
            "object_index": object_index, "square_px": wear.square_px, "origin_x_px": wear.origin_px[0],
            "origin_y_px": wear.origin_px[1], "arrays": buffer.getvalue(),
        }  # fmt: skip
        with self._writing() as db:
            db.execute(self._draw, row)

    def drop_map(self, object_index: int) -> None:
        """Forget a wear map: the die was serviced.

        Raises:
            RecordError: it could not be made durable.
        """
        with self._writing() as db:
            db.execute(delete(WEAR_MAP).where(WEAR_MAP.c.object_index == object_index))

    def prune(self, kept: int, utc: datetime, at_most: int = 500) -> int:
        """Remove the oldest records beyond `kept`, no more than `at_most` at once; returns how many went.

        A signed checkpoint stands for them. Tally, wear bins and die events stay.

        Raises:
            RecordError: it could not be made durable.
        """
        with self._reading() as db:
            all_time = int(db.execute(select(func.sum(TALLY.c.count))).scalar() or 0)
        pruned = int(self.mark(_PRUNED) or 0)
        excess = all_time - pruned - kept
        if excess <= 0:
            return 0
        with self._writing() as db:
            oldest = select(RECORD.c.number).order_by(RECORD.c.number)
            gone = min(excess, at_most)
            cut = db.execute(oldest.offset(gone).limit(1)).scalar()
            if cut is None:
                cut = 1 + int(db.execute(select(func.max(ENTRY.c.number))).scalar() or 0)
            last = db.execute(select(ENTRY.c.number, ENTRY.c.digest).where(ENTRY.c.number == cut - 1)).one()
            for table in (ZONE_FIGURE, RECORD, ENTRY, CHECKPOINT):
                db.execute(delete(table).where(table.c.number < cut))
            when = utc.isoformat(timespec="milliseconds")
            db.execute(insert(CHECKPOINT), signed_row(self._key, int(last[0]), str(last[1]), when, is_pruned=True))
            self._set_mark(db, _PRUNED, str(pruned + gone))
        return gone

    def _draft(self, db: Connection) -> _Draft:
        last = db.execute(select(ENTRY.c.number, ENTRY.c.digest).order_by(ENTRY.c.number.desc()).limit(1)).first()
        if last is None:
            pruned = select(CHECKPOINT.c.number, CHECKPOINT.c.digest).order_by(CHECKPOINT.c.number.desc()).limit(1)
            last = db.execute(pruned).first()
        return _Draft(int(last[0]), str(last[1]), self._key) if last else _Draft(0, FIRST, self._key)

    def _flush(self, db: Connection, draft: _Draft) -> None:
        for table, rows in draft.rows.items():
            db.execute(insert(table), rows)
        for cycle_id, told in draft.told.items():
            db.execute(update(RECORD).where(RECORD.c.cycle_id == cycle_id).values(**told))
        if draft.tally:
            db.execute(
                self._count, [{"object_index": i, "decision": d, "count": n} for (i, d), n in draft.tally.items()]
            )
        if draft.bins:
            db.execute(
                self._gather,
                [
                    {"object_index": index, "zone": zone, "since": since, "bin": number, **figures}
                    for (index, zone, since, number), figures in draft.bins.items()
                ],
            )

    @staticmethod
    def _known(db: Connection, cycle_ids: Sequence[str]) -> set[tuple[str, str]]:
        """(kind, cycle_id) of the entries that these cycles have."""
        known: set[tuple[str, str]] = set()
        for start in range(0, len(cycle_ids), _AT_ONCE):
            asked = select(ENTRY.c.kind, ENTRY.c.cycle_id).where(
                ENTRY.c.kind.in_(("verdict", "outcome")), ENTRY.c.cycle_id.in_(cycle_ids[start : start + _AT_ONCE])
            )
            known.update((str(kind), str(name)) for kind, name in db.execute(asked))
        return known

    def _since_of(self, db: Connection, object_index: int) -> int:
        if object_index not in self._since:
            asked = select(func.max(DIE_EVENT.c.number)).where(
                DIE_EVENT.c.object_index == object_index, DIE_EVENT.c.kind != _GOES_ON
            )
            self._since[object_index] = int(db.execute(asked).scalar() or 0)
        return self._since[object_index]

    # --- read ---

    def has_verdict(self, cycle_id: str) -> bool:
        """Whether this cycle was judged."""
        with self._reading() as db:
            return ("verdict", cycle_id) in self._known(db, [cycle_id])

    def has_outcome(self, cycle_id: str) -> bool:
        """Whether it is on record what the PLC was told."""
        with self._reading() as db:
            return ("outcome", cycle_id) in self._known(db, [cycle_id])

    def rows(self, wanted: AskRecords) -> tuple[RecordRow, ...]:
        """The records that are asked for, newest first."""
        columns = [RECORD.c[name] for name in ("number", "utc", *_ROW)] + (
            [ENTRY.c.body] if wanted.with_verdict else []
        )
        asked: Select[Any] = select(*columns).order_by(RECORD.c.number.desc()).limit(wanted.last)
        if wanted.with_verdict:
            asked = asked.join(ENTRY, ENTRY.c.number == RECORD.c.number)
        if wanted.object_index is not None:
            asked = asked.where(RECORD.c.object_index == wanted.object_index)
        if wanted.cycle_id:
            asked = asked.where(RECORD.c.cycle_id == wanted.cycle_id)
        if wanted.decisions:
            asked = asked.where(RECORD.c.decision.in_([decision.value for decision in wanted.decisions]))
        if wanted.search:
            found = RECORD.c.part_id.icontains(wanted.search, autoescape=True)
            # Ten digits and more are no stroke that a press has counted.
            is_stroke = wanted.search.isascii() and wanted.search.isdigit() and len(wanted.search) < 10
            asked = asked.where(found | (RECORD.c.stroke == int(wanted.search)) if is_stroke else found)
            # No index helps to find a part of an id; whoever looks for one must not keep a verdict waiting.
            newest = select(func.max(RECORD.c.number)).scalar_subquery()
            asked = asked.where(RECORD.c.number > newest - _SEARCHED)
        if wanted.before is not None:
            asked = asked.where(RECORD.c.number < wanted.before)
        with self._reading() as db:
            return tuple(_row(dict(found)) for found in db.execute(asked).mappings())

    def verdict(self, cycle_id: str) -> Verdict | None:
        """One verdict as it was published."""
        asked = select(ENTRY.c.body).where(ENTRY.c.kind == "verdict", ENTRY.c.cycle_id == cycle_id)
        with self._reading() as db:
            body = db.execute(asked).scalar()
        return None if body is None else Verdict.model_validate_json(body)

    def outcome(self, cycle_id: str) -> Outcome | None:
        """What the PLC was told of a cycle."""
        asked = select(ENTRY.c.body).where(ENTRY.c.kind == "outcome", ENTRY.c.cycle_id == cycle_id)
        with self._reading() as db:
            body = db.execute(asked).scalar()
        return None if body is None else Outcome.model_validate_json(body)

    def cycles(self, last: int | None = None, object_index: int | None = None) -> Iterator[tuple[int, Cycle]]:
        """Record number and whole cycle, oldest first; `last` = the newest so many."""
        numbers: Select[Any] = select(RECORD.c.number).order_by(RECORD.c.number.desc())
        if object_index is not None:
            numbers = numbers.where(RECORD.c.object_index == object_index)
        with self._reading() as db:
            first = db.execute(numbers.offset(last - 1).limit(1)).scalar() if last is not None else None
        told = ENTRY.alias("told")
        after = (first or 1) - 1
        while True:
            asked = (
                select(RECORD.c.number, RECORD.c.utc, RECORD.c.monotonic_s, ENTRY.c.body, told.c.body)
                .join(ENTRY, ENTRY.c.number == RECORD.c.number)
                .outerjoin(told, (told.c.kind == "outcome") & (told.c.cycle_id == RECORD.c.cycle_id))
                .where(RECORD.c.number > after)
                .order_by(RECORD.c.number)
                .limit(_AT_ONCE)
            )
            if object_index is not None:
                asked = asked.where(RECORD.c.object_index == object_index)
            with self._reading() as db:
                found = list(db.execute(asked))
            for number, utc, monotonic_s, body, said in found:
                outcome = None if said is None else Outcome.model_validate_json(said)
                yield int(number), Cycle(Verdict.model_validate_json(body), outcome, utc, float(monotonic_s))
            if len(found) < _AT_ONCE:
                return
            after = int(found[-1][0])

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

    def newest_decisions(self, object_index: int, last: int) -> list[Decision]:
        """Of the newest parts, oldest first."""
        asked = select(RECORD.c.decision).where(RECORD.c.object_index == object_index)
        with self._reading() as db:
            found = db.execute(asked.order_by(RECORD.c.number.desc()).limit(last)).scalars()
            return [Decision(name) for name in found][::-1]

    def alarms(self, object_index: int) -> list[StoredAlarm]:
        """Of all zones that ever had one."""
        asked = select(ALARM).where(ALARM.c.object_index == object_index)
        with self._reading() as db:
            return [
                StoredAlarm(**{name: row[name] for name in StoredAlarm.__dataclass_fields__})
                for row in db.execute(asked).mappings()
            ]

    def stored_map(self, object_index: int) -> StoredMap | None:
        """The wear map as it was kept last."""
        with self._reading() as db:
            row = db.execute(select(WEAR_MAP).where(WEAR_MAP.c.object_index == object_index)).mappings().first()
        if row is None:
            return None
        with np.load(io.BytesIO(row["arrays"]), allow_pickle=False) as arrays:
            return StoredMap(
                row["square_px"],
                (row["origin_x_px"], row["origin_y_px"]),
                {name: arrays[name] for name in arrays.files},
            )

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

    def newest_utc(self, object_index: int) -> datetime | None:
        """When the newest record of an object was made."""
        asked = select(RECORD.c.utc).where(RECORD.c.object_index == object_index)
        with self._reading() as db:
            found: datetime | None = db.execute(asked.order_by(RECORD.c.number.desc()).limit(1)).scalar()
        return found

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

    def verified(self) -> Iterator[Entry]:
        """Every entry, oldest first, once it and all that was made from it was checked.

        Raises:
            ChainError: naming the first entry that was altered, removed or put in.
        """
        with self._reading() as db:
            points = [Checkpoint(*row) for row in db.execute(select(CHECKPOINT).order_by(CHECKPOINT.c.number))]
        batch: list[Entry] = []
        try:
            for entry in checked(self.entries(), points, self._key):
                batch.append(entry)
                if len(batch) == _AT_ONCE:
                    self._check_rows(batch)
                    yield from batch
                    batch = []
        except ChainError:
            # What was made from an earlier entry comes first.
            self._check_rows(batch)
            raise
        self._check_rows(batch)
        yield from batch

    def count_entries(self) -> int:
        """How many entries there are."""
        with self._reading() as db:
            return int(db.execute(select(func.count()).select_from(ENTRY)).scalar() or 0)

    def _check_rows(self, entries: Sequence[Entry]) -> None:
        """The rows beside the entries must say what the entries say.

        Raises:
            ChainError: one does not.
        """
        if not entries:
            return
        within = (entries[0].number, entries[-1].number)
        with self._reading() as db:
            records = self._rows_between(db, RECORD, *within)
            events = self._rows_between(db, DIE_EVENT, *within)
            told = {
                row["cycle_id"]: dict(row)
                for row in db.execute(
                    select(RECORD).where(RECORD.c.cycle_id.in_([e.cycle_id for e in entries if e.kind == "outcome"]))
                ).mappings()
            }
            zones: dict[int, list[dict[str, Any]]] = {}
            asked = select(ZONE_FIGURE).where(ZONE_FIGURE.c.number.between(*within)).order_by(ZONE_FIGURE.c.zone)
            for row in db.execute(asked).mappings():
                zones.setdefault(row["number"], []).append(dict(row))
        for entry in entries:
            found: Mapping[str, Any] | None
            if entry.kind == "verdict":
                verdict = Verdict.model_validate_json(entry.body)
                found, made = records.get(entry.number), record_of(verdict)
                figures = sorted(({"number": entry.number, **row} for row in zone_rows(verdict)), key=_zone_of)
                if zones.get(entry.number, []) != figures:
                    raise ChainError(f"zone figures of entry {entry.number} (cycle {entry.cycle_id}) were altered")
            elif entry.kind == "outcome":
                found, made = told.get(entry.cycle_id), told_of(Outcome.model_validate_json(entry.body))
                if found is None:
                    continue  # its verdict was pruned
            elif entry.kind == "acknowledgement":
                continue  # the alarm's row follows what comes after it
            else:
                found, made = events.get(entry.number), die_event_of(json.loads(entry.body))
            if found is None or any(found[name] != value for name, value in made.items()):
                raise ChainError(f"row of entry {entry.number} ({entry.kind} of cycle {entry.cycle_id}) was altered")

    @staticmethod
    def _rows_between(db: Connection, table: Table, first: int, last: int) -> dict[int, dict[str, Any]]:
        asked = select(table).where(table.c.number.between(first, last))
        return {row["number"]: dict(row) for row in db.execute(asked).mappings()}

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
            self._set_mark(db, name, content)

    def _set_mark(self, db: Connection, name: str, content: str) -> None:
        db.execute(self._keep, {"name": name, "content": content})


_UNTOLD: dict[str, Any] = {"told_code": None, "told_utc": None, "cycle_seconds": None}


def signed_row(key: bytes, number: int, entry_digest: str, utc: str, *, is_pruned: bool) -> dict[str, Any]:
    """A row of ``checkpoint``."""
    return {
        "number": number, "digest": entry_digest, "utc": utc, "is_pruned": is_pruned,
        "signature": signature(key, number, entry_digest, utc, is_pruned),
    }  # fmt: skip


def told_of(outcome: Outcome) -> dict[str, Any]:
    """The columns of ``record`` that an outcome fills."""
    return {
        "told_code": outcome.code if outcome.was_told else None,
        "told_utc": _instant(outcome.told_utc),
        "cycle_seconds": outcome.cycle_seconds,
    }


def die_event_of(body: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of ``die_event`` that an entry fills."""
    return {
        "object_index": body["object_index"], "stroke": body["stroke"], "kind": body["kind"], "note": body["note"],
        "person": body["user"],
    }  # fmt: skip


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


_ROW = (
    "cycle_id", "object_index", "part_id", "stroke", "measure_number", "decision", "code", "reason",
    "mean_error_mm", "max_error_mm", "wear_mm", "told_code", "cycle_seconds", "is_simulated",
)  # fmt: skip
"""Columns of ``record`` that `RecordRow` has under the same name."""


def _row(found: Mapping[str, Any]) -> RecordRow:
    return RecordRow(
        record_id=found["number"],
        utc=found["utc"].isoformat(timespec="milliseconds"),
        verdict_json=found.get("body", ""),
        **{name: found[name] for name in _ROW},
    )


def _zone_of(row: Mapping[str, Any]) -> str:
    return str(row["zone"])


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
