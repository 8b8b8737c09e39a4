"""A simulated flight over a map of roads, water and buildings without imagery."""

from pathlib import Path

import pytest

from terrafix.messages import MapMatch, Verdict
from terrafix.recorder.reader import read_flight
from terrafix_lab.sim.flights.make import FlightOptions, make
from terrafix_lab.sim.world.map_content import MapContent
from terrafix_tools.evaluate import evaluate
from terrafix_tools.replay import replay

pytestmark = pytest.mark.slow


def test_a_flight_over_a_map_without_imagery_is_localised(tmp_path: Path) -> None:
    flight, out = tmp_path / "flight", tmp_path / "replay"
    make(flight, FlightOptions(seed=31, duration_s=20.0, map_content=MapContent.VECTORS), progress=False)
    assert not (flight / "map.tif").exists()
    replay(flight, None, out)
    result = evaluate(out, flight / "truth.csv", json_only=True)
    assert result["within_50m"] == 1.0 and result["median_m"] < 8.0
    assert result["ellipse95_coverage"] >= 0.95 and result["false_fixes"] == 0
    matches = [message for _, _, message in read_flight(out / "flight.mcap") if isinstance(message, MapMatch)]
    accepted = [match for match in matches if match.verdict is Verdict.ACCEPTED]
    assert accepted and all(match.on_drawn and match.position_only for match in accepted)
