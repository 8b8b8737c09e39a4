"""Evaluation: every metric of evaluation.json on flights small enough to compute by hand."""

import json
import math
from pathlib import Path

import pytest

from flight_records import ORIGIN, live_messages, write_record, write_truth
from terrafix.core.errors import EvaluationError
from terrafix_tools.estimates import COLUMNS, Row, write_rows
from terrafix_tools.evaluate import WORDS, evaluate, offset_m, read_truth

CONTRACT = [
    "frames",
    "localised",
    *[f"{p}{k}" for p in ("", "refined_") for k in ("within_5m", "within_10m", "within_20m", "within_50m")],
    *[f"{p}{k}" for p in ("", "refined_") for k in ("median_m", "p95_m", "max_m")],
    "ellipse95_coverage",
    "mean_nees",
    "false_fixes",
    "anchor_rate",
    "odometry_rate",
    "model_rate",
    "frame_ms_median",
    "frame_ms_p95",
]


def row(i: int, east_m: float | None, *, sigma_m: float = 4.0, refined_m: float | None = None, age_ms: int = 0) -> Row:
    """A frame whose estimate is ``east_m`` east of the truth at the origin; None: no position."""
    made = Row(file=f"{i}.jpg", t_s=i / 2, process_ms=100.0 + i)
    if east_m is not None:
        made.lat_deg, made.lon_deg = ORIGIN.to_wgs84(east_m, 0.0)
        made.sigma_e_m = made.sigma_n_m = sigma_m
        made.cov_en_m2 = 0.0
        made.anchor_age_ms = age_ms
        made.source_label = "satellite_anchored"
    if refined_m is not None:
        made.refined_lat_deg, made.refined_lon_deg = ORIGIN.to_wgs84(refined_m, 0.0)
    return made


def folder(path: Path, rows: list[Row], truth: str | None = None, summary: dict[str, object] | None = None) -> Path:
    with (path / "estimates.csv").open("w") as stream:
        write_rows(stream, rows)
    lines = [f"{r.file},48.0,11.0" for r in rows]
    (path / "truth.csv").write_text(truth if truth is not None else "\n".join(["file,lat_deg,lon_deg", *lines]))
    (path / "summary.json").write_text(json.dumps(summary or {"frames": len(rows), "odometry_frames": 2}))
    return path


def test_the_metrics_of_a_small_flight_are_correct(tmp_path: Path) -> None:
    rows = [
        row(0, None),
        row(1, 3.0, refined_m=1.0),
        row(2, 8.0, refined_m=4.0, age_ms=500),
        row(3, 60.0, refined_m=30.0),
        row(4, 60.0, sigma_m=40.0),
    ]
    found = evaluate(folder(tmp_path, rows), tmp_path / "truth.csv", json_only=True)
    assert set(CONTRACT) <= set(found)
    assert (found["frames"], found["localised"]) == (5, 4)
    assert [found[f"within_{m}m"] for m in (5, 10, 20, 50)] == [0.2, 0.4, 0.4, 0.4]
    assert [found[f"refined_within_{m}m"] for m in (5, 10, 20, 50)] == [0.4, 0.4, 0.4, 0.6]
    assert found["median_m"] == pytest.approx(34.0, abs=0.01)
    assert found["max_m"] == pytest.approx(60.0, abs=0.01)
    assert found["refined_median_m"] == pytest.approx(4.0, abs=0.01)
    assert found["ellipse95_coverage"] == 0.75  # 3, 8 of 4 m and 60 of 40 m are inside; 60 of 4 m is not
    nees = [(3 / 4) ** 2, (8 / 4) ** 2, (60 / 4) ** 2, (60 / 40) ** 2]
    assert found["mean_nees"] == pytest.approx(sum(nees) / 4, rel=1e-3)
    assert found["false_fixes"] == 1  # 60 m with a sigma of 4 m; 60 m with 40 m is consistent
    assert found["anchor_rate"] == 0.6
    assert found["odometry_rate"] == 0.5
    assert found["frame_ms_median"] == 102.0
    assert json.loads((tmp_path / "evaluation.json").read_text()) == found


@pytest.mark.parametrize(
    ("matched_by", "rate"),
    [({"gradient": 2, "gradient on vectors": 1, "xfeat": 1}, 0.25), ({"gradient": 4}, 0.0), ({}, None)],
)
def test_the_model_rate_is_the_share_of_map_matches_for_which_the_model_ran(
    tmp_path: Path, matched_by: dict[str, int], rate: float | None
) -> None:
    run = folder(tmp_path, [row(0, 3.0)], summary={"frames": 1, "odometry_frames": 0, "matched_by": matched_by})
    assert evaluate(run, tmp_path / "truth.csv", json_only=True)["model_rate"] == rate


def test_a_flight_without_localised_frames_has_metrics(tmp_path: Path) -> None:
    found = evaluate(folder(tmp_path, [row(0, None), row(1, None)]), tmp_path / "truth.csv")
    assert (found["localised"], found["within_50m"], found["median_m"]) == (0, 0.0, None)
    assert (found["ellipse95_coverage"], found["false_fixes"]) == (None, 0)


def test_the_coverage_uses_the_correlation_of_the_covariance(tmp_path: Path) -> None:
    made = row(0, None)
    made.lat_deg, made.lon_deg = ORIGIN.to_wgs84(10.0, 10.0)
    made.sigma_e_m = made.sigma_n_m = 6.0
    made.cov_en_m2 = 0.9 * 36.0  # long axis towards north-east, where the error is
    along = evaluate(folder(tmp_path, [made]), tmp_path / "truth.csv", json_only=True)
    made.cov_en_m2 = -0.9 * 36.0
    across = evaluate(folder(tmp_path, [made]), tmp_path / "truth.csv", json_only=True)
    assert along["mean_nees"] == pytest.approx(200 / (36 * 1.9), rel=1e-3)
    assert across["mean_nees"] == pytest.approx(200 / (36 * 0.1), rel=1e-3)
    assert (along["ellipse95_coverage"], across["ellipse95_coverage"]) == (1.0, 0.0)


def test_an_invalid_covariance_does_not_count_as_covered(tmp_path: Path) -> None:
    found = evaluate(folder(tmp_path, [row(0, 60.0, sigma_m=0.0)]), tmp_path / "truth.csv", json_only=True)
    assert (found["ellipse95_coverage"], found["mean_nees"], found["covariance_invalid"]) == (0.0, None, 1)
    assert found["false_fixes"] == 1


def test_frames_without_truth_are_excluded_from_the_metrics(tmp_path: Path) -> None:
    truth = "file,lat_deg,lon_deg,agl_m\n0.jpg,48.0,11.0,5\n1.jpg,,,\nother.jpg,48.0,11.0,5\n"
    found = evaluate(folder(tmp_path, [row(0, 1.0), row(1, 1.0)], truth), tmp_path / "truth.csv", json_only=True)
    assert (found["frames"], found["frames_without_truth"]) == (1, 1)


def test_the_sigma_of_the_truth_adds_a_second_coverage(tmp_path: Path) -> None:
    folder(tmp_path, [row(0, 12.0, sigma_m=4.0)])
    (tmp_path / "flight.toml").write_text("[truth]\nsigma_m = 7.0\n")
    found = evaluate(tmp_path, tmp_path / "truth.csv", json_only=True)
    assert (found["ellipse95_coverage"], found["ellipse95_coverage_with_truth_sigma"]) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("truth", "says"),
    [
        ("file,lat_deg\n0.jpg,48\n", "column lon_deg missing"),
        ("", "column file, lat_deg, lon_deg missing"),
        ("file,lat_deg,lon_deg\na.jpg,48,11\n", "no frame in common"),
        ("file,lat_deg,lon_deg\n0.jpg,48,11\n0.jpg,48,11\n", "line 3: duplicate row of '0.jpg'"),
        ("file,lat_deg,lon_deg\n0.jpg,north,11\n", "line 2: lat_deg is 'north', not a number"),
        ("file,lat_deg,lon_deg\n0.jpg,nan,11\n", "not a finite number"),
        ("file,lat_deg,lon_deg\n0.jpg,148,11\n", "not a valid position"),
        ("file,lat_deg,lon_deg\n0.jpg,48\n", "line 2: 2 cells, but the header has 3"),
        ("file,lat_deg,lon_deg\n0.jpg,,\n", "no row with a position"),
    ],
)
def test_a_bad_truth_file_is_one_line_with_its_location(tmp_path: Path, truth: str, says: str) -> None:
    with pytest.raises(EvaluationError, match=says) as caught:
        evaluate(folder(tmp_path, [row(0, 1.0)], truth), tmp_path / "truth.csv")
    assert "\n" not in str(caught.value)


def test_the_error_names_the_missing_file(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match=r"estimates.csv: no such file; write it with 'terrafix replay'"):
        evaluate(tmp_path, tmp_path / "truth.csv")
    with pytest.raises(EvaluationError, match=r"truth.csv: no such file"):
        read_truth(tmp_path / "truth.csv")


def test_offsets_are_metres_east_and_north(tmp_path: Path) -> None:
    (tmp_path / "truth.csv").write_text("\ufefffile, lat_deg, lon_deg\n0.jpg, 48.0, 11.0\n")
    truth = read_truth(tmp_path / "truth.csv")["0.jpg"]
    east_m, north_m = offset_m(truth, *ORIGIN.to_wgs84(30.0, -40.0))
    assert (east_m, north_m) == (pytest.approx(30.0, abs=1e-3), pytest.approx(-40.0, abs=1e-3))
    assert math.hypot(east_m, north_m) == pytest.approx(50.0, abs=1e-3)


def test_the_columns_of_estimates_csv_are_as_specified() -> None:
    assert ",".join(COLUMNS) == (
        "file,t_s,lat_deg,lon_deg,alt_amsl_m,agl_m,sigma_e_m,sigma_n_m,cov_en_m2,yaw_deg,source_label,anchor_age_ms,"
        "covariance_mode,process_ms,refined_lat_deg,refined_lon_deg,refined_alt_amsl_m,refined_q_w_c,refined_cov,"
        "refined_m_per_unit,refined_fragment_id,frame_uid"
    )


def test_the_record_of_a_live_run_is_evaluated_without_estimates_csv(tmp_path: Path) -> None:
    write_record(tmp_path / "flight-000.mcap", live_messages())
    write_truth(tmp_path / "truth.csv")
    result = evaluate(tmp_path, tmp_path / "truth.csv", json_only=True)
    assert (result["frames"], result["localised"]) == (20, 19)
    assert result["median_m"] == pytest.approx(math.hypot(1.0, 2.0), abs=0.01)
    assert json.loads((tmp_path / "evaluation.json").read_text()) == result


def test_the_table_has_words_for_every_metric_and_no_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = folder(tmp_path, [row(0, 1.0), row(1, 30.0)])
    result = evaluate(flight, flight / "truth.csv")
    shown = capsys.readouterr().out
    shown_keys = {key for key in result if not key.startswith("refined_") and key not in ("frames", "localised")}
    assert shown_keys <= set(WORDS)
    assert "frames within 5 m" in shown and "median error" in shown and "within_5m" not in shown
    assert "│  │" not in shown  # no column without a head
