"""Columns of the tables of a fleet (docs/fleet.md), and their files."""

from typing import Any

import pyarrow
from pyarrow import dataset, parquet

_text, _real, _count, _yes = pyarrow.string(), pyarrow.float64(), pyarrow.int64(), pyarrow.bool_()
_time = pyarrow.timestamp("ms", "UTC")

FLIGHTS = pyarrow.schema([
    ("start_utc", _time),
    ("season", _text),
    ("duration_s", _real),
    ("distance_m", _real),
    ("live", _yes),
    ("vehicle", _text),
    ("map", _text),
    ("map_checksum", _text),
    ("map_date", pyarrow.date32()),
    ("camera", _text),
    ("camera_width_px", _count),
    ("camera_height_px", _count),
    ("camera_fx_px", _real),
    ("camera_focal_sigma", _real),
    ("start_lat_deg", _real),
    ("start_lon_deg", _real),
    ("agl_median_m", _real),
    ("version", _text),
    ("git", _text),
    ("config_sha256", _text),
    ("frames", _count),
    ("localised", _count),
    ("fixes", _count),
    ("refusals", _count),
    ("refused", pyarrow.map_(_text, _count)),
    ("availability", _real),
    ("trusted", _real),
    ("sigma_median_m", _real),
    ("sigma_max_m", _real),
    ("longest_without_fix_s", _real),
    ("faults", pyarrow.list_(_text)),
    ("dropped", _count),
    ("messages", _count),
    ("truncated", _yes),
    ("damaged", _count),
    ("undecodable", _count),
    ("record", _text),
])  # fmt: skip
FRAMES = pyarrow.schema([
    ("frame", _count),
    ("time_utc", _time),
    ("t_s", _real),
    ("lat_deg", _real),
    ("lon_deg", _real),
    ("agl_m", _real),
    ("sigma_m", _real),
    ("source", _text),
    ("verdict", _text),
    ("reason", _text),
    ("anchor_age_ms", _count),
    ("latency_ms", _real),
])  # fmt: skip
RECORDS = pyarrow.schema([
    ("record", _text),
    ("size", _count),
    ("modified_ns", _count),
    ("flights", pyarrow.list_(_text)),
    ("error", _text),
])  # fmt: skip

TABLES = {"flights": FLIGHTS, "frames": FRAMES}
PART = "part.parquet"
UNKNOWN_DATE = "__HIVE_DEFAULT_PARTITION__"  # how the hive layout writes an unknown value
PARTITIONS = dataset.partitioning(
    pyarrow.schema([("date", pyarrow.date32()), ("flight", _text)]), flavor="hive"
)  # of both tables


def to_parquet(schema: pyarrow.Schema, rows: list[dict[str, Any]]) -> bytes:
    """The rows as a file; equal rows give equal bytes."""
    out = pyarrow.BufferOutputStream()
    parquet.write_table(pyarrow.Table.from_pylist(rows, schema=schema), out, compression="zstd")
    return out.getvalue().to_pybytes()
