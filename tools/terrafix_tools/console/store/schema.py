"""The tables of the newest schema; ``migrations`` makes them. Times are nanoseconds, texts in JSON are noted so."""

import sqlalchemy as sa

metadata = sa.MetaData()


def _of_flight() -> "sa.Column[str]":
    return sa.Column("flight_id", sa.Text, primary_key=True)


flights = sa.Table(
    "flights",
    metadata,
    sa.Column("id", sa.Text, primary_key=True),
    sa.Column("name", sa.Text),
    sa.Column("kind", sa.Text),  # FlightKind
    sa.Column("state", sa.Text),  # FlightState
    sa.Column("created_at", sa.Text),
    sa.Column("spec", sa.Text),  # JSON: NewFlight
    sa.Column("map_name", sa.Text),
    sa.Column("map_state", sa.Text),  # MapState
    sa.Column("map_detail", sa.Text),
    sa.Column("completing", sa.Boolean),
    sa.Column("error", sa.Text),
    sa.Column("request", sa.Text),  # JSON: InputRequest that is open
    sa.Column("last_number", sa.Integer),  # in the name of the newest image
)
images = sa.Table(
    "images",
    metadata,
    _of_flight(),
    sa.Column("frame_id", sa.Integer, primary_key=True),
    sa.Column("name", sa.Text),
    sa.Column("stored", sa.Text),  # file in the folder of the flight
    sa.Column("bytes", sa.Integer),
    sa.Column("sha256", sa.Text),
    sa.Column("t_ns", sa.Integer),
    sa.Column("state", sa.Text),  # JSON: VehicleState of the image; None: it states nothing
    sa.Column("attempts", sa.Integer),  # processes that have died at this image
)
results = sa.Table(
    "results",
    metadata,
    _of_flight(),
    sa.Column("frame_id", sa.Integer, primary_key=True),
    sa.Column("immediate", sa.Text),  # JSON: FrameResult
    sa.Column("refined", sa.Text),  # JSON: FrameRefined, the newest
)
headings = sa.Table(
    "headings",
    metadata,
    _of_flight(),
    sa.Column("frame_id", sa.Integer, primary_key=True),
    sa.Column("heading_deg", sa.Float),
    sa.Column("sigma_deg", sa.Float),
)
fragments = sa.Table(
    "fragments",
    metadata,
    _of_flight(),
    sa.Column("fragment_id", sa.Integer, primary_key=True),
    sa.Column("first_frame", sa.Integer),
    sa.Column("last_frame", sa.Integer),
    sa.Column("frames", sa.Integer),
    sa.Column("joined", sa.Boolean),
    sa.Column("merged_at_frame", sa.Integer),
)
hints = sa.Table(
    "hints",
    metadata,
    _of_flight(),
    sa.Column("hint_id", sa.Integer, primary_key=True),
    sa.Column("given", sa.Text),  # JSON: Hint or UserFix
    sa.Column("before_frame", sa.Integer),  # before which it was applied, in this run and in every later one
)
events = sa.Table(
    "events",
    metadata,
    _of_flight(),
    sa.Column("event_id", sa.Integer, primary_key=True),
    sa.Column("key", sa.Text),  # what happened; a computation that is repeated finds its event there
    sa.Column("name", sa.Text),
    sa.Column("data", sa.Text),  # JSON
)
