"""Consistency of claims over several flights: NEES and coverage with equal weights of the flights, and the terms."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from terrafix.core.config import Config
from terrafix.core.geodesy import LocalFrame
from terrafix.messages import Camera, CovarianceMode, Message, NavEstimate, Origin, SourceLabel
from terrafix.recorder.provenance import header
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.bench.claims import claims_of, main, pool, table
from terrafix_tools.estimates import Row, write_rows

LAT_DEG, LON_DEG = 48.0, 11.0


def row(file: str, east_m: float, sigma_m: float) -> Row:
    lat_deg, lon_deg = LocalFrame(LAT_DEG, LON_DEG).to_wgs84(east_m, 0.0)
    return Row(file, 0.0, lat_deg, lon_deg, sigma_e_m=sigma_m, sigma_n_m=sigma_m, cov_en_m2=0.0)


def estimate(frame_id: int, speed_mps: float, map_sigma_m: float) -> NavEstimate:
    cov = np.diag([25.0] * 3 + [1e-4] * 3)
    return NavEstimate(
        t_ns=frame_id, frame_id=frame_id, lat_deg=LAT_DEG, lon_deg=LON_DEG, alt_amsl_m=100.0, agl_m=100.0,
        velocity_enu_mps=(speed_mps, 0.0, 0.0), velocity_sigma_mps=0.1, q_w_b=(1.0, 0.0, 0.0, 0.0),
        cov=tuple(map(float, cov.ravel())), map_sigma_m=map_sigma_m, source_label=SourceLabel.SATELLITE_ANCHORED,
        covariance_mode=CovarianceMode.MARGINALS, last_anchor_age_ms=0, emitted_at_ns=frame_id,
    )  # fmt: skip


def origin(focal_sigma: float) -> Origin:
    camera = Camera(width=800, height=600, fx=400.0, fy=400.0, cx=399.5, cy=299.5, focal_sigma=focal_sigma)
    return Origin(
        t_ns=0, camera=camera, lat_deg=LAT_DEG, lon_deg=LON_DEG, ground_amsl_m=0.0, start_sigma_m=10.0,
        yaw_sigma_deg=2.0, agl_sigma_m=2.0, attitude_sigma_deg=1.0,
    )  # fmt: skip


def replay(
    folder: Path,
    errors_m: list[float],
    sigma_m: float,
    messages: list[Message] | None = None,
    *,
    truth_sigma_m: float = 0.0,
) -> Path:
    """Writes a replay folder and its flight folder -> the replay folder."""
    flight, out = folder / "flight", folder / "out"
    flight.mkdir(parents=True)
    out.mkdir()
    names = [f"{i}.jpg" for i in range(len(errors_m))]
    truth = "".join(f"{name},{LAT_DEG},{LON_DEG}\n" for name in names)
    (flight / "truth.csv").write_text(f"file,lat_deg,lon_deg\n{truth}")
    (flight / "flight.toml").write_text(f"[truth]\nsigma_m = {truth_sigma_m}\n")
    (out / "summary.json").write_text(json.dumps({"source": str(flight)}))
    with (out / "estimates.csv").open("w", newline="") as stream:
        write_rows(stream, [row(name, e, sigma_m) for name, e in zip(names, errors_m, strict=True)])
    writer = FlightWriter(out / "flight.mcap", header(Config()))
    for message in messages or [origin(0.01), estimate(1, 0.0, 0.0)]:
        writer.write(message, 0)
    writer.close()
    return out


def test_errors_and_claims_are_per_axis_and_the_mean_error_is_the_bias(tmp_path: Path) -> None:
    found = claims_of(replay(tmp_path, [3.0, 5.0], 2.0))
    assert found.nees == pytest.approx((9.0 + 25.0) / 2 / 4.0 / 2, rel=1e-4)
    assert found.error_m2 == pytest.approx((9.0 + 25.0) / 4, rel=1e-4)
    assert found.bias_m2 == pytest.approx(16.0 / 2, rel=1e-4)
    assert (found.claimed_m2, found.inside_95) == (pytest.approx(4.0), 0.5)  # 5 m are 2.5 sigmas, outside 95 %
    assert found.ratio == pytest.approx(math.sqrt(4.0 / 8.5), rel=1e-4)
    assert (found.median_error_m, found.median_claim_m) == (pytest.approx(4.0, rel=1e-4), pytest.approx(2.0))
    assert found.median_ratio == pytest.approx(2.0 / (4.0 / 1.1774), rel=1e-3)


def test_the_error_of_the_truth_is_added_to_the_claim(tmp_path: Path) -> None:
    found = claims_of(replay(tmp_path, [5.0, 5.0], 3.0, truth_sigma_m=4.0))
    assert (found.claimed_m2, found.truth_m2) == (pytest.approx(25.0), 16.0)
    assert found.nees == pytest.approx(0.5, rel=1e-4)


def test_the_claimed_variance_is_split_into_its_terms(tmp_path: Path) -> None:
    """Map sigma; principal point: 2 % of the image width of an uncalibrated lens; time offset: 30 ms; the rest."""
    messages: list[Message] = [origin(0.1), estimate(1, 0.0, 9.0), estimate(1, 20.0, 3.0), estimate(2, 20.0, 3.0)]
    found = claims_of(replay(tmp_path, [1.0, 1.0], 6.0, messages))
    assert found.map_m2 == pytest.approx(9.0)
    assert found.nees_if_map_off == pytest.approx((1.0 / 36.0 + 9.0 * 2.0 / 36.0) / 2.0, rel=1e-4)
    assert found.principal_m2 == pytest.approx((100.0 * 0.02 * 800 / 400) ** 2)
    assert found.time_m2 == pytest.approx(0.6**2 / 2)
    assert found.rest_m2 == pytest.approx(36.0 - 9.0 - 16.0)


def test_flights_have_equal_weights_whatever_their_number_of_frames(tmp_path: Path) -> None:
    flights = [
        claims_of(replay(tmp_path / "long", [0.0] * 9, 1.0)),
        claims_of(replay(tmp_path / "short", [4.0], 1.0)),
    ]
    pooled = pool(flights)
    assert pooled.nees == pytest.approx(4.0, rel=1e-4) and pooled.inside_95 == 0.5
    assert pooled.nees_sigma == pytest.approx(4.0, rel=1e-4)
    assert pooled.ratio == pytest.approx(math.sqrt(2.0 / 8.0), rel=1e-4)
    assert pooled.median_ratio == pytest.approx(math.sqrt(2.0) / (4.0 / 1.1774), rel=1e-3)
    assert pooled.shares["rest"] == pytest.approx(1.0) and pooled.shares["map"] == 0.0
    assert pool(flights[:1]).nees_sigma is None
    assert "2 flights: inside 50.0%, NEES / dof 4.00 +- 4.00, 4.00 if maps are off" in table(flights)[-1]


def test_the_claims_command_prints_the_table_and_writes_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = replay(tmp_path, [3.0, 5.0], 2.0)
    main([str(out), "--json", str(tmp_path / "claims.json")])
    assert "| out | 2 | 50% | 2.12 | 2.12 |" in capsys.readouterr().out
    assert json.loads((tmp_path / "claims.json").read_text())["pool"]["flights"] == 1


def test_a_flight_without_truth_is_an_error_of_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = replay(tmp_path, [3.0], 2.0)
    truth = tmp_path / "flight" / "truth.csv"
    elsewhere = truth.rename(tmp_path / "elsewhere.csv")
    with pytest.raises(SystemExit):
        main([str(out)])
    assert "has no truth.csv" in capsys.readouterr().err
    assert claims_of(out, elsewhere).frames == 1
    with pytest.raises(SystemExit):
        main([str(out), str(out), "--truth", str(elsewhere)])
    assert "give one REPLAY with it" in capsys.readouterr().err
