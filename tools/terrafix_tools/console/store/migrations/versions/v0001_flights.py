"""The first schema. A migration states its tables itself: those of ``schema.py`` are the newest ones."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    op.create_table(
        "flights",
        sa.Column("id", sa.Text, primary_key=True),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("state", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.Column("spec", sa.Text, nullable=False),
        sa.Column("map_name", sa.Text, nullable=False),
        sa.Column("map_state", sa.Text, nullable=False),
        sa.Column("map_detail", sa.Text, nullable=False),
        sa.Column("completing", sa.Boolean, nullable=False),
        sa.Column("error", sa.Text, nullable=False),
        sa.Column("request", sa.Text),
        sa.Column("last_number", sa.Integer),
    )
    op.create_table(
        "images",
        sa.Column("flight_id", sa.Text, sa.ForeignKey("flights.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("frame_id", sa.Integer, primary_key=True),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("stored", sa.Text, nullable=False),
        sa.Column("bytes", sa.Integer, nullable=False),
        sa.Column("sha256", sa.Text, nullable=False),
        sa.Column("t_ns", sa.Integer, nullable=False),
        sa.Column("state", sa.Text),
        sa.Column("attempts", sa.Integer, nullable=False, server_default="0"),
        sa.UniqueConstraint("flight_id", "name"),
    )
    op.create_table(
        "results",
        sa.Column("flight_id", sa.Text, sa.ForeignKey("flights.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("frame_id", sa.Integer, primary_key=True),
        sa.Column("immediate", sa.Text, nullable=False),
        sa.Column("refined", sa.Text),
    )
    op.create_table(
        "headings",
        sa.Column("flight_id", sa.Text, sa.ForeignKey("flights.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("frame_id", sa.Integer, primary_key=True),
        sa.Column("heading_deg", sa.Float, nullable=False),
        sa.Column("sigma_deg", sa.Float, nullable=False),
    )
    op.create_table(
        "fragments",
        sa.Column("flight_id", sa.Text, sa.ForeignKey("flights.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("fragment_id", sa.Integer, primary_key=True),
        sa.Column("first_frame", sa.Integer, nullable=False),
        sa.Column("last_frame", sa.Integer, nullable=False),
        sa.Column("frames", sa.Integer, nullable=False),
        sa.Column("joined", sa.Boolean, nullable=False),
        sa.Column("merged_at_frame", sa.Integer),
    )
    op.create_table(
        "hints",
        sa.Column("flight_id", sa.Text, sa.ForeignKey("flights.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("hint_id", sa.Integer, primary_key=True),
        sa.Column("given", sa.Text, nullable=False),
        sa.Column("before_frame", sa.Integer),
    )
    op.create_table(
        "events",
        sa.Column("flight_id", sa.Text, sa.ForeignKey("flights.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("event_id", sa.Integer, primary_key=True),
        sa.Column("key", sa.Text, nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("data", sa.Text, nullable=False),
        sa.UniqueConstraint("flight_id", "key"),
    )


def downgrade() -> None:
    for table in ("events", "hints", "fragments", "headings", "results", "images", "flights"):
        op.drop_table(table)
