"""The table of aid sources. A new source is one file in measurements/, its test, and one row here."""

from collections.abc import Callable

from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.measurements.aid_source import AidSource
from terrafix.estimator.measurements.airspeed import AirspeedAid

AID_SOURCES: tuple[Callable[[FilterState], AidSource], ...] = (AirspeedAid,)
