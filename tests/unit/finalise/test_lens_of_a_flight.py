"""The focal length and the radial coefficient as unknowns of the smoother, on flights with another camera."""

import json
from pathlib import Path

import numpy as np
import pytest

from terrafix_lab.bench import finalised
from terrafix_tools.before_after import Change
from terrafix_tools.finalised import read_flights
from terrafix_tools.report.data import FlightView
from terrafix_tools.report.sections_run import finalised as section


@pytest.mark.slow
def test_a_focal_length_that_is_3_percent_off_is_found() -> None:
    """A plane that turns over relief; described focal length stated to 5 %, its radial coefficient not at all."""
    found = finalised.measure(5, 90.0)
    assert abs(found["focal_error_sigmas"]) < 2.5 and found["focal_sigma"] < 0.02
    assert abs(found["k1_error_sigmas"]) < 2.5 and found["k1_sigma"] < 0.01
    assert found["up_rms_m"] < 3.0 * found["up_sigma_m"]  # in heights as seen it would be 3 % of 176 m


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


def test_the_flights_of_the_bench_have_another_focal_length_than_described() -> None:
    drawn = finalised.uncalibrated(3)
    assert drawn.focal_error == finalised.FOCAL_ERROR and drawn.camera.focal_sigma == finalised.FOCAL_SIGMA
    assert np.log1p(finalised.FOCAL_ERROR) < 2.0 * finalised.FOCAL_SIGMA
