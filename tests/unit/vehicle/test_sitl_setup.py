"""Mission and vehicle parameters of the SITL harness, as the firmware gets them."""

import itertools
import math
from pathlib import Path

import pytest
from pyproj import Geod

from terrafix.core.errors import UsageError
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.sitl.setup import WORLD_M, laps_for, mission_for, place_of, write_parameters
from terrafix_lab.sim.world import place as world
from terrafix_tools.mission.items import Do, Mission

GEOD = Geod(ellps="WGS84")


@pytest.fixture(scope="module")
def place() -> world.World:
    return world.generate(1, width_m=WORLD_M[0], height_m=WORLD_M[1])


def length_m(mission: Mission) -> float:
    """Over the ellipsoid, home to home."""
    points = [(mission.home_lat_deg, mission.home_lon_deg)]
    points += [(i.lat_deg, i.lon_deg) for i in mission.items if i.lat_deg is not None and i.lon_deg is not None]
    return sum(GEOD.inv(lon1, lat1, lon2, lat2)[2] for (lat1, lon1), (lat2, lon2) in itertools.pairwise(points))


@pytest.mark.parametrize("kind", list(Kind))
@pytest.mark.parametrize("wanted_m", [500.0, 5000.0, 10_000.0])
def test_the_mission_is_long_enough_and_inside_the_world(place: world.World, kind: Kind, wanted_m: float) -> None:
    mission = mission_for(place, kind, wanted_m)
    before_m = (1500.0, 4000.0)  # flown before the loss
    assert wanted_m + before_m[0] <= length_m(mission) <= max(6000.0, wanted_m + before_m[1])
    laps, lap_m = laps_for(wanted_m)
    assert laps * lap_m == pytest.approx(length_m(mission), rel=0.05)  # determines the time limit of the flight
    assert mission.items[0].do is Do.TAKE_OFF and mission.items[-1].do is Do.LAND
    last = mission.items[-1]
    assert (last.lat_deg, last.lon_deg) == place_of(place) == (mission.home_lat_deg, mission.home_lon_deg)


def test_a_plane_approaches_on_a_feasible_glide_path(place: world.World) -> None:
    approach, land = mission_for(place, Kind.PLANE, 5000.0).items[-2:]
    assert approach.lat_deg and approach.lon_deg and approach.height_m and land.lat_deg and land.lon_deg
    azimuth_deg, _, away_m = GEOD.inv(approach.lon_deg, approach.lat_deg, land.lon_deg, land.lat_deg)
    assert 3.0 < math.degrees(math.atan2(approach.height_m, away_m)) < 8.0
    assert azimuth_deg == pytest.approx(90.0, abs=2.0)  # into the wind


@pytest.mark.parametrize("wanted_m", [0.0, -5000.0, 1e6])
def test_an_invalid_length_is_an_error(place: world.World, wanted_m: float) -> None:
    with pytest.raises(UsageError, match=r"--length .* choose"):
        mission_for(place, Kind.PLANE, wanted_m)


@pytest.mark.parametrize("kind", list(Kind))
def test_the_parameter_file_has_ardupilots_format(kind: Kind, tmp_path: Path) -> None:
    path = tmp_path / "vehicle.param"
    write_parameters(path, kind)
    rows = [line.split(",") for line in path.read_text().splitlines()]
    assert all(len(name) <= 16 for name, _ in rows)  # PARAM_SET has 16 characters
    values = {name: float(value) for name, value in rows}
    assert len(values) == len(rows)
    ours = Path(__file__).resolve().parents[3] / "config" / "vehicles" / "second-gps.param"
    about_us = {line.split(",")[0] for line in ours.read_text().splitlines() if not line.startswith("#")}
    assert not about_us & values.keys()  # they are in the file that users load
