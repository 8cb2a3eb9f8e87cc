"""Entries, records, zone figures, tally, wear bins, marks and checkpoints."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

BIG = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "checkpoint",
        sa.Column("number", BIG, autoincrement=False, nullable=False, comment="an entry"),
        sa.Column("digest", sa.String(length=64), nullable=False, comment="of that entry"),
        sa.Column("utc", sa.String(length=40), nullable=False),
        sa.Column("is_pruned", sa.Boolean(), nullable=False, comment="the entries up to it were removed"),
        sa.Column("signature", sa.String(length=64), nullable=False, comment="HMAC-SHA256 over the other columns"),
        sa.PrimaryKeyConstraint("number"),
    )
    op.create_table(
        "die_event",
        sa.Column("number", BIG, autoincrement=False, nullable=False, comment="of its entry"),
        sa.Column("object_index", sa.Integer(), nullable=False),
        sa.Column("stroke", sa.BigInteger(), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("person", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("number"),
    )
    op.create_index("ix_die_event_object", "die_event", ["object_index", "number"])
    op.create_table(
        "entry",
        sa.Column("number", BIG, autoincrement=False, nullable=False, comment="from 1, without gaps"),
        sa.Column("kind", sa.String(length=16), nullable=False, comment="verdict, outcome or die_event"),
        sa.Column("cycle_id", sa.String(length=64), nullable=False),
        sa.Column("utc", sa.String(length=40), nullable=False, comment="ISO 8601, when it was written"),
        sa.Column("body", sa.Text(), nullable=False, comment="the message as JSON"),
        sa.Column("previous", sa.String(length=64), nullable=False, comment="digest of the entry before"),
        sa.Column("digest", sa.String(length=64), nullable=False, comment="sha256 over all other columns"),
        sa.PrimaryKeyConstraint("number"),
        sa.UniqueConstraint("kind", "cycle_id", name="uq_entry_kind_cycle_id"),
    )
    op.create_table(
        "mark",
        sa.Column("name", sa.String(length=32), nullable=False),
        sa.Column("content", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("name"),
    )
    op.create_table(
        "record",
        sa.Column("number", BIG, autoincrement=False, nullable=False, comment="of the verdict's entry"),
        sa.Column("cycle_id", sa.String(length=64), nullable=False),
        sa.Column("utc", sa.DateTime(timezone=True), nullable=False),
        sa.Column(
            "monotonic_s",
            sa.Float(precision=53),
            nullable=False,
            comment="judge's monotonic clock: durations survive clock steps",
        ),
        sa.Column("object_index", sa.Integer(), nullable=False),
        sa.Column("part_id", sa.Text(), nullable=False),
        sa.Column("stroke", sa.BigInteger(), nullable=False),
        sa.Column("measure_number", sa.Integer(), nullable=False),
        sa.Column("decision", sa.String(length=16), nullable=False),
        sa.Column("code", sa.Integer(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("mean_error_mm", sa.Float(precision=53)),
        sa.Column("max_error_mm", sa.Float(precision=53)),
        sa.Column("wear_mm", sa.Float(precision=53)),
        sa.Column("deviating_area_mm2", sa.Float(precision=53)),
        sa.Column("coverage", sa.Float(precision=53), nullable=False),
        sa.Column("is_simulated", sa.Boolean(), nullable=False),
        sa.Column("timings_json", sa.Text(), nullable=False, comment="ms of each step"),
        sa.Column("frame_hash", sa.String(length=64), nullable=False),
        sa.Column("calibration_hash", sa.String(length=64), nullable=False),
        sa.Column("template_hash", sa.String(length=64), nullable=False),
        sa.Column("recipe_hash", sa.String(length=64), nullable=False),
        sa.Column("code_version", sa.Text(), nullable=False),
        sa.Column("told_code", sa.Integer(), comment="what the PLC was told; NULL = nothing"),
        sa.Column("told_utc", sa.DateTime(timezone=True)),
        sa.Column("cycle_seconds", sa.Float(precision=53)),
        sa.PrimaryKeyConstraint("number"),
        sa.UniqueConstraint("cycle_id"),
    )
    op.create_index("ix_record_object", "record", ["object_index", "number"])
    op.create_index("ix_record_part", "record", ["part_id", "number"])
    op.create_table(
        "tally",
        sa.Column("object_index", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("decision", sa.String(length=16), nullable=False),
        sa.Column("count", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("object_index", "decision"),
    )
    op.create_table(
        "wear_bin",
        sa.Column("object_index", sa.Integer(), nullable=False),
        sa.Column("zone", sa.String(length=32), nullable=False),
        sa.Column("since", BIG, autoincrement=False, nullable=False, comment="entry of the die event before, 0 = none"),
        sa.Column("bin", BIG, autoincrement=False, nullable=False, comment="entry number / BIN"),
        sa.Column("count", sa.Integer(), nullable=False),
        sa.Column("wear_sum_mm", sa.Float(precision=53), nullable=False),
        sa.Column("wear_max_mm", sa.Float(precision=53), nullable=False),
        sa.Column("first_stroke", sa.BigInteger(), nullable=False),
        sa.Column("last_stroke", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("object_index", "zone", "since", "bin"),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "zone_figure",
        sa.Column("object_index", sa.Integer(), nullable=False),
        sa.Column("zone", sa.String(length=32), nullable=False, comment="empty = the whole part"),
        sa.Column("number", BIG, autoincrement=False, nullable=False, comment="of the record"),
        sa.Column("stroke", sa.BigInteger(), nullable=False),
        sa.Column("wear_mm", sa.Float(precision=53)),
        sa.Column("mean_error_mm", sa.Float(precision=53)),
        sa.Column("max_error_mm", sa.Float(precision=53)),
        sa.Column("area_mm2", sa.Float(precision=53)),
        sa.Column("coverage", sa.Float(precision=53), nullable=False),
        sa.Column("is_within", sa.Boolean(), nullable=False),
        sa.PrimaryKeyConstraint("object_index", "zone", "number"),
        sqlite_with_rowid=False,
    )


def downgrade() -> None:
    op.drop_table("zone_figure")
    op.drop_table("wear_bin")
    op.drop_table("tally")
    op.drop_index("ix_record_part", table_name="record")
    op.drop_index("ix_record_object", table_name="record")
    op.drop_table("record")
    op.drop_table("mark")
    op.drop_table("entry")
    op.drop_index("ix_die_event_object", table_name="die_event")
    op.drop_table("die_event")
    op.drop_table("checkpoint")
