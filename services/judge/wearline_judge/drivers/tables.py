"""Tables of the production records, the same on SQLite and PostgreSQL.

``entry`` is the truth: append-only, chained. All other tables are made from it in the same
transaction, so that lists, counts and trends over a million records need no scan; `verify`
compares them with it.
"""

from __future__ import annotations

from datetime import UTC, datetime

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    DateTime,
    Dialect,
    Float,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    TypeDecorator,
    UniqueConstraint,
)

BIG = BigInteger().with_variant(Integer(), "sqlite")
METADATA = MetaData()
PART = ""
"""Stands for the whole part where a zone is named."""


class Utc(TypeDecorator[datetime]):
    """An aware datetime in UTC; SQLite has no time zones of its own."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        return value if value is None else value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


ENTRY = Table(
    "entry", METADATA,
    Column("number", BIG, primary_key=True, autoincrement=False, comment="from 1, without gaps"),
    Column("kind", String(16), nullable=False, comment="verdict, outcome or die_event"),
    Column("cycle_id", String(64), nullable=False),
    Column("utc", String(40), nullable=False, comment="ISO 8601, when it was written"),
    Column("body", Text, nullable=False, comment="the message as JSON"),
    Column("previous", String(64), nullable=False, comment="digest of the entry before"),
    Column("digest", String(64), nullable=False, comment="sha256 over all other columns"),
    UniqueConstraint("kind", "cycle_id", name="uq_entry_kind_cycle_id"),
)  # fmt: skip

RECORD = Table(
    "record", METADATA,
    Column("number", BIG, primary_key=True, autoincrement=False, comment="of the verdict's entry"),
    Column("cycle_id", String(64), nullable=False, unique=True),
    Column("utc", Utc, nullable=False),
    Column("monotonic_s", Float(53), nullable=False, comment="judge's monotonic clock: durations survive clock steps"),
    Column("object_index", Integer, nullable=False),
    Column("part_id", Text, nullable=False),
    Column("stroke", BigInteger, nullable=False),
    Column("measure_number", Integer, nullable=False),
    Column("decision", String(16), nullable=False),
    Column("code", Integer, nullable=False),
    Column("reason", Text, nullable=False),
    Column("mean_error_mm", Float(53)),
    Column("max_error_mm", Float(53)),
    Column("wear_mm", Float(53)),
    Column("deviating_area_mm2", Float(53)),
    Column("coverage", Float(53), nullable=False),
    Column("is_simulated", Boolean(create_constraint=False), nullable=False),
    Column("timings_json", Text, nullable=False, comment="ms of each step"),
    Column("frame_hash", String(64), nullable=False),
    Column("calibration_hash", String(64), nullable=False),
    Column("template_hash", String(64), nullable=False),
    Column("recipe_hash", String(64), nullable=False),
    Column("code_version", Text, nullable=False),
    Column("told_code", Integer, comment="what the PLC was told; NULL = nothing"),
    Column("told_utc", Utc),
    Column("cycle_seconds", Float(53)),
    Index("ix_record_object", "object_index", "number"),
    Index("ix_record_part", "part_id", "number"),
)  # fmt: skip

ZONE_FIGURE = Table(
    "zone_figure", METADATA,
    Column("object_index", Integer, primary_key=True),
    Column("zone", String(32), primary_key=True, comment="empty = the whole part"),
    Column("number", BIG, primary_key=True, autoincrement=False, comment="of the record"),
    Column("stroke", BigInteger, nullable=False),
    Column("wear_mm", Float(53)),
    Column("mean_error_mm", Float(53)),
    Column("max_error_mm", Float(53)),
    Column("area_mm2", Float(53)),
    Column("coverage", Float(53), nullable=False),
    Column("is_within", Boolean(create_constraint=False), nullable=False),
    sqlite_with_rowid=False,
)  # fmt: skip

DIE_EVENT = Table(
    "die_event", METADATA,
    Column("number", BIG, primary_key=True, autoincrement=False, comment="of its entry"),
    Column("object_index", Integer, nullable=False),
    Column("stroke", BigInteger, nullable=False),
    Column("kind", String(16), nullable=False),
    Column("note", Text, nullable=False),
    Column("person", Text, nullable=False),
    Index("ix_die_event_object", "object_index", "number"),
)  # fmt: skip

TALLY = Table(
    "tally", METADATA,
    Column("object_index", Integer, primary_key=True, autoincrement=False),
    Column("decision", String(16), primary_key=True),
    Column("count", BigInteger, nullable=False),
)  # fmt: skip

WEAR_BIN = Table(
    "wear_bin", METADATA,
    Column("object_index", Integer, primary_key=True),
    Column("zone", String(32), primary_key=True),
    Column("since", BIG, primary_key=True, autoincrement=False, comment="entry of the die event before, 0 = none"),
    Column("bin", BIG, primary_key=True, autoincrement=False, comment="entry number / BIN"),
    Column("count", Integer, nullable=False),
    Column("wear_sum_mm", Float(53), nullable=False),
    Column("wear_max_mm", Float(53), nullable=False),
    Column("first_stroke", BigInteger, nullable=False),
    Column("last_stroke", BigInteger, nullable=False),
    sqlite_with_rowid=False,
)  # fmt: skip

MARK = Table(
    "mark", METADATA,
    Column("name", String(32), primary_key=True),
    Column("content", Text, nullable=False),
)  # fmt: skip

CHECKPOINT = Table(
    "checkpoint", METADATA,
    Column("number", BIG, primary_key=True, autoincrement=False, comment="an entry"),
    Column("digest", String(64), nullable=False, comment="of that entry"),
    Column("utc", String(40), nullable=False),
    Column("is_pruned", Boolean(create_constraint=False), nullable=False, comment="the entries up to it were removed"),
    Column("signature", String(64), nullable=False, comment="HMAC-SHA256 over the other columns"),
)  # fmt: skip

ALARM = Table(
    "alarm", METADATA,
    Column("object_index", Integer, primary_key=True, autoincrement=False),
    Column("zone", String(32), primary_key=True, comment="empty = the whole part"),
    Column("level", Integer, nullable=False, comment="0 none to 4 stop"),
    Column("stroke", BigInteger, nullable=False, comment="at which the level was reached"),
    Column("reason", Text, nullable=False),
    Column("person", Text, nullable=False, comment="who acknowledged it; empty = nobody yet"),
    Column("utc", String(40), nullable=False, comment="when"),
    Column("note", Text, nullable=False, comment="why"),
)  # fmt: skip

WEAR_MAP = Table(
    "wear_map", METADATA,
    Column("object_index", Integer, primary_key=True, autoincrement=False),
    Column("square_px", Integer, nullable=False),
    Column("origin_x_px", Integer, nullable=False),
    Column("origin_y_px", Integer, nullable=False),
    Column("arrays", LargeBinary, nullable=False, comment="npz of the running sums"),
)  # fmt: skip
