"""The tables, which ``database.open_database`` makes. Times are nanoseconds, texts in JSON are noted so."""

import sqlalchemy as sa

VERSION = 3  # of these tables, in user_version of the file
SINCE_1 = "ALTER TABLE fragments ADD COLUMN state TEXT NOT NULL DEFAULT 'unanchored'"  # version 1 had none

metadata = sa.MetaData()


def _of_flight() -> "sa.Column[str]":
    return sa.Column("flight_id", sa.Text, sa.ForeignKey("flights.id", ondelete="CASCADE"), primary_key=True)


flights = sa.Table(
    "flights",
    metadata,
    sa.Column("id", sa.Text, primary_key=True),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("kind", sa.Text, nullable=False),  # FlightKind
    sa.Column("state", sa.Text, nullable=False),  # FlightState
    sa.Column("created_at", sa.Text, nullable=False),
    sa.Column("spec", sa.Text, nullable=False),  # JSON: NewFlight
    sa.Column("map_name", sa.Text, nullable=False),
    sa.Column("map_state", sa.Text, nullable=False),  # MapState
    sa.Column("map_detail", sa.Text, nullable=False),
    sa.Column("completing", sa.Boolean, nullable=False),
    sa.Column("error", sa.Text, nullable=False),
    sa.Column("request", sa.Text),  # JSON: InputRequest that is open
)
images = sa.Table(
    "images",
    metadata,
    _of_flight(),
    sa.Column("frame_id", sa.Integer, primary_key=True),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("stored", sa.Text, nullable=False),  # file in the folder of the flight
    sa.Column("bytes", sa.Integer, nullable=False),
    sa.Column("sha256", sa.Text, nullable=False),
    sa.Column("t_ns", sa.Integer, nullable=False),
    sa.Column("state", sa.Text),  # JSON: VehicleState of the image; None: it states nothing
    sa.Column("attempts", sa.Integer, nullable=False, server_default="0"),  # processes that have died at this image
    sa.UniqueConstraint("flight_id", "name"),
)
results = sa.Table(
    "results",
    metadata,
    _of_flight(),
    sa.Column("frame_id", sa.Integer, primary_key=True),
    sa.Column("immediate", sa.Text, nullable=False),  # JSON: FrameResult
    sa.Column("refined", sa.Text),  # JSON: FrameRefined, the newest
)
headings = sa.Table(
    "headings",
    metadata,
    _of_flight(),
    sa.Column("frame_id", sa.Integer, primary_key=True),
    sa.Column("heading_deg", sa.Float, nullable=False),
    sa.Column("sigma_deg", sa.Float, nullable=False),
)
fragments = sa.Table(
    "fragments",
    metadata,
    _of_flight(),
    sa.Column("fragment_id", sa.Integer, primary_key=True),
    sa.Column("first_frame", sa.Integer, nullable=False),
    sa.Column("last_frame", sa.Integer, nullable=False),
    sa.Column("frames", sa.Integer, nullable=False),
    sa.Column("joined", sa.Boolean, nullable=False),
    sa.Column("merged_at_frame", sa.Integer),
    sa.Column("state", sa.Text, nullable=False, server_default="unanchored"),  # FragmentState
)
hints = sa.Table(
    "hints",
    metadata,
    _of_flight(),
    sa.Column("hint_id", sa.Integer, primary_key=True),
    sa.Column("given", sa.Text, nullable=False),  # JSON: Hint or UserFix
    sa.Column("before_frame", sa.Integer),  # before which it was applied, in this run and in every later one
)
events = sa.Table(
    "events",
    metadata,
    _of_flight(),
    sa.Column("event_id", sa.Integer, primary_key=True),
    sa.Column("key", sa.Text, nullable=False),  # what happened; a computation that is repeated finds its event there
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("data", sa.Text, nullable=False),  # JSON
    sa.UniqueConstraint("flight_id", "key"),
)
