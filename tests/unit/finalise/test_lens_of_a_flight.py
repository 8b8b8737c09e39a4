"""The focal length and the radial coefficient as unknowns of the smoother, on flights with another camera."""

import json
from dataclasses import replace
from pathlib import Path

import gtsam
import msgspec
import numpy as np
import pytest

from simulated_flight import ORIGIN
from terrafix.core.pose import tangent_to_world
from terrafix_lab.montecarlo.fault import DrawnFault
from terrafix_lab.montecarlo.flight import Run
from terrafix_lab.montecarlo.plan import FlightPlan, plan
from terrafix_tools.before_after import Change
from terrafix_tools.finalise.batch_smoother import smooth
from terrafix_tools.finalise.flight_graph import FlightGraph, FlightReplayer
from terrafix_tools.finalise.held_out import EVERY, choose
from terrafix_tools.finalise.run import PlacedCamera, heights_as_seen, solved_track
from terrafix_tools.finalised import read_flights
from terrafix_tools.report.data import FlightView
from terrafix_tools.report.sections_run import finalised as section

FOCAL_ERROR, FOCAL_SIGMA, K1_ERROR = 0.03, 0.05, -0.03  # of the true camera, relative; as described; of the true lens


class RecordedRun(Run):
    """A simulated flight whose estimator keeps what the smoother takes."""

    def __init__(self, drawn: FlightPlan, hold_out_every: int = 0) -> None:
        self.replayer = FlightReplayer(hold_out_every)
        super().__init__(drawn, self.replayer)

    def fly(self) -> FlightGraph:
        self.record(refine=False)
        graph = self.replayer.flights[-1]
        graph.recorder.store_estimates()
        return graph


@pytest.mark.slow
def test_a_focal_length_that_is_3_percent_off_is_found() -> None:
    """A plane that turns over relief; described focal length stated to 5 %, its radial coefficient not at all."""
    drawn = plan(41, 5, fault=DrawnFault.NONE, duration_s=90.0)
    camera = msgspec.structs.replace(drawn.camera, focal_sigma=FOCAL_SIGMA)
    uncalibrated = replace(drawn, camera=camera, focal_error=FOCAL_ERROR, k1_error=K1_ERROR)
    choice, flight = choose(RecordedRun(uncalibrated, EVERY).fly()), RecordedRun(uncalibrated)
    graph = flight.fly()
    found = smooth(graph, estimates_lens=choice.estimates_lens)
    assert abs(found.lens.log_focal - np.log1p(FOCAL_ERROR)) < 2.5 * found.lens_sigma.log_focal < 2.5 * 0.02
    assert abs(found.lens.k1 - K1_ERROR) < 2.5 * found.lens_sigma.k1 < 2.5 * 0.01
    placed = solved_track(graph, found)
    up_m = np.array([at.pose.translation()[2] - flight.flown.frames[i].p_m[2] for i, at in placed.items()])
    covs = [tangent_to_world(at.cov, at.pose.rotation().matrix()) for at in placed.values()]
    sigma_m = np.sqrt(np.mean([cov[2, 2] for cov in covs]))
    assert np.sqrt(np.mean(up_m**2)) < 3.0 * sigma_m  # in heights as seen it would be 3 % of 176 m
    assert sigma_m > 176.0 * found.lens_sigma.log_focal  # no height is known better than the focal length


def test_heights_as_seen_through_the_described_lens_have_its_share_of_the_height() -> None:
    camera, above_m = msgspec.structs.replace(ORIGIN.camera, focal_sigma=0.02), 80.0
    flight = FlightGraph(msgspec.structs.replace(ORIGIN, camera=camera, ground_amsl_m=500.0))
    down = gtsam.Pose3(gtsam.Rot3(np.diag([1.0, -1.0, -1.0])), np.array([0.0, 0.0, 500.0 + above_m]))
    placed = {3: PlacedCamera(down, np.eye(6), np.zeros(6))}
    added = heights_as_seen(flight, placed)[3].cov - np.eye(6)
    assert added[5, 5] == pytest.approx((0.02 * above_m) ** 2) and np.count_nonzero(added) == 1


def test_a_row_of_before_and_after_has_both_with_their_sigma() -> None:
    assert Change("focal length", "px", 684.0, 68.4, 543.72, 16.91).cells() == (
        "focal length px", "684.0 ± 68.4", "543.7 ± 16.9",
    )  # fmt: skip
    assert Change("radial coefficient", "", -0.048391, 0.0019, None, None).cells()[1:] == ("-0.0484 ± 0.0019", "-")


def test_the_report_shows_before_and_after(tmp_path: Path) -> None:
    row = {"what": "map points", "unit": "px", "before": 8.25, "before_sigma": None, "after": 7.0, "after_sigma": None}
    path = tmp_path / "finalised.json"
    path.write_text(json.dumps({"flights": [{"before_after": [row]}, {}]}), encoding="utf-8")
    view = FlightView("a flight", [], [])
    assert section(view) == ""
    view.finalised_flights = read_flights(path)
    shown = section(view)
    assert "map points px" in shown and "<td>8.2</td><td>7.0</td>" in shown
    assert read_flights(tmp_path / "missing.json") == []
