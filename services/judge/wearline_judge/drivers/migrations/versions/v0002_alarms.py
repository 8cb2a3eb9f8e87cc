"""Alarms with who acknowledged them, and wear maps."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "alarm",
        sa.Column("object_index", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("zone", sa.String(length=32), nullable=False, comment="empty = the whole part"),
        sa.Column("level", sa.Integer(), nullable=False, comment="0 none to 4 stop"),
        sa.Column("stroke", sa.BigInteger(), nullable=False, comment="at which the level was reached"),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("person", sa.Text(), nullable=False, comment="who acknowledged it; empty = nobody yet"),
        sa.Column("utc", sa.String(length=40), nullable=False, comment="when"),
        sa.Column("note", sa.Text(), nullable=False, comment="why"),
        sa.PrimaryKeyConstraint("object_index", "zone"),
    )
    op.create_table(
        "wear_map",
        sa.Column("object_index", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("square_px", sa.Integer(), nullable=False),
        sa.Column("origin_x_px", sa.Integer(), nullable=False),
        sa.Column("origin_y_px", sa.Integer(), nullable=False),
        sa.Column("arrays", sa.LargeBinary(), nullable=False, comment="npz of the running sums"),
        sa.PrimaryKeyConstraint("object_index"),
    )


def downgrade() -> None:
    op.drop_table("wear_map")
    op.drop_table("alarm")
