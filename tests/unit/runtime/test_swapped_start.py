"""A start whose latitude and longitude are exchanged is said as such, before `run` and in `preflight`."""

from typing import cast

import msgspec
import pytest

from terrafix.core.config import Config
from terrafix.map.package import MapPackage
from terrafix_tools.live import swapped
from terrafix_tools.preflight import computer
from terrafix_tools.preflight.lines import Status


class OnePlace:
    """A map of 48, 11 and nothing else."""

    def covers(self, lat_deg: float, lon_deg: float) -> bool:
        return (lat_deg, lon_deg) == (48.0, 11.0)

    def covers_start(self, lat_deg: float, lon_deg: float, sigma_m: float) -> bool:
        assert -90.0 <= lat_deg <= 90.0
        return self.covers(lat_deg, lon_deg)


PLACE = cast(MapPackage, OnePlace())


def test_only_a_start_that_lies_on_the_map_the_other_way_round_is_called_swapped() -> None:
    said = swapped(PLACE, 11.0, 48.0, 10.0)
    assert said == "latitude and longitude are swapped: 48.000000, 11.000000 lies on the map"
    assert swapped(PLACE, 12.0, 48.0, 10.0) == ""
    assert swapped(PLACE, 11.0, 148.0, 10.0) == ""


@pytest.mark.parametrize(("start", "todo"), [("11, 48", "are swapped"), ("12, 48", "correct the start")])
def test_preflight_says_that_a_start_is_swapped(start: str, todo: str) -> None:
    config = Config()
    config = msgspec.structs.replace(config, source=msgspec.structs.replace(config.source, start=start))
    (line,) = computer._start(PLACE, config)
    assert line.status is Status.FAIL and todo in line.fix
