"""A start with exchanged latitude and longitude is reported as such, before `run` and in `preflight`."""

from typing import cast

import msgspec
import pytest

from terrafix.core.config import Config
from terrafix.map.package import MapPackage
from terrafix_tools.live import swapped_hint
from terrafix_tools.preflight import computer
from terrafix_tools.preflight.lines import CheckStatus


class OnePlace:
    """A map that covers only the point 48, 11."""

    def covers(self, lat_deg: float, lon_deg: float) -> bool:
        return (lat_deg, lon_deg) == (48.0, 11.0)

    def covers_start(self, lat_deg: float, lon_deg: float, sigma_m: float) -> bool:
        assert -90.0 <= lat_deg <= 90.0
        return self.covers(lat_deg, lon_deg)


PLACE = cast(MapPackage, OnePlace())


def test_a_start_is_swapped_only_if_the_exchanged_coordinates_are_on_the_map() -> None:
    said = swapped_hint(PLACE, 11.0, 48.0, 10.0)
    assert said == "latitude and longitude are swapped: 48.000000, 11.000000 lies on the map"
    assert swapped_hint(PLACE, 12.0, 48.0, 10.0) == ""
    assert swapped_hint(PLACE, 11.0, 148.0, 10.0) == ""


@pytest.mark.parametrize(("start", "todo"), [("11, 48", "are swapped"), ("12, 48", "correct the start")])
def test_preflight_reports_a_swapped_start(start: str, todo: str) -> None:
    config = Config()
    config = msgspec.structs.replace(config, source=msgspec.structs.replace(config.source, start=start))
    (line,) = computer._start(PLACE, config)
    assert line.status is CheckStatus.FAIL and todo in line.fix
