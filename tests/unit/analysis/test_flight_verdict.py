"""The verdict on a whole flight from rows, faults and map match verdicts, without ground truth."""

from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from flight_records import estimate, frame, origin
from terrafix import messages as m
from terrafix.core.config import Config
from terrafix.core.errors import SourceError
from terrafix.recorder.provenance import header
from terrafix.recorder.writer import FlightWriter
from terrafix_tools import cli
from terrafix_tools.estimates import Row
from terrafix_tools.flight_verdict import flight_verdict, verdict_of


def rows(count: int = 60) -> list[Row]:
    """One row per second, each with a map match."""
    return [
        Row(
            file=f"{i}.jpg",
            t_s=float(i),
            lat_deg=48.0,
            lon_deg=11.0,
            sigma_e_m=4.0,
            sigma_n_m=4.0,
            cov_en_m2=0.0,
            anchor_age_ms=0,
        )
        for i in range(count)
    ]


def fault(quantity: str, *, active: bool = True, factor: float | None = None) -> m.CalibrationFault:
    return m.CalibrationFault(t_ns=0, quantity=quantity, factor=factor, detail="", active=active)


def test_a_flight_with_map_matches_is_trusted() -> None:
    verdict = flight_verdict(rows(), (), {"map": {"accepted": 60}})
    assert (verdict.label, verdict.spans, verdict.reasons) == ("trust it", [(0.0, 59.0)], [])
    assert verdict.text() == "Trust it."
    assert verdict.as_json()["verdict"] == "trust it" and verdict.as_json()["trusted_s"] == [[0.0, 59.0]]


def test_a_start_that_contradicts_the_map_is_not_trusted() -> None:
    verdict = flight_verdict(rows(), (), {"map": {"accepted": 60}, "start": {"innovation": 1}})
    assert verdict.label == "do not trust it" and "start and map contradict each other" in verdict.text()


def test_spans_without_a_certain_position_are_excluded_with_a_reason() -> None:
    flown = rows()
    for row in flown[10:20]:
        row.sigma_e_m = row.sigma_n_m = 51.0
    flown[30].lat_deg = None
    verdict = flight_verdict(flown)
    assert verdict.label == "trust it in part"
    assert verdict.spans == [(0.0, 9.0), (20.0, 29.0), (31.0, 59.0)]
    assert "no position" in verdict.text()
    assert "from 0.0 s (0.jpg) to 9.0 s (9.jpg), from 20.0 s (20.jpg)" in verdict.text()
    assert verdict.as_json()["trusted_files"] == [["0.jpg", "9.jpg"], ["20.jpg", "29.jpg"], ["31.jpg", "59.jpg"]]
    assert verdict.as_json()["untrusted_files"] == [["10.jpg", "19.jpg"], ["30.jpg", "30.jpg"]]
    for row in flown:  # of a camera, whose images have no names
        row.file = ""
    assert "from 0.0 s to 9.0 s, from 20.0 s" in flight_verdict(flown).text()
    assert verdict.reasons == ["claims worse than 50 m", "no position"]


@pytest.mark.parametrize(("age_ms", "trusted"), [(35_000, True), (35_001, False)])
def test_a_propagated_position_is_trusted_as_long_as_the_link_sends_it(age_ms: int, trusted: bool) -> None:
    flown = rows()
    flown[-1].anchor_age_ms = age_ms
    assert (flight_verdict(flown).share == 1.0) is trusted


def test_a_start_that_a_map_match_confirms_late_is_trusted_only_briefly() -> None:
    flown = rows()
    for row in flown[:-1]:
        row.anchor_age_ms = -1
    verdict = flight_verdict(flown)
    assert verdict.spans == [(0.0, 5.0), (59.0, 59.0)]
    assert verdict.reasons == ["no map match has confirmed the start"]


def test_a_flight_that_no_map_match_ever_confirmed_is_not_trusted() -> None:
    flown = rows(2)
    for row in flown:
        row.anchor_age_ms = -1
    assert flight_verdict(flown).text() == "Do not trust it (no map match has confirmed the start)."


def test_frames_that_are_not_placed_are_named_as_such() -> None:
    flown = rows()
    for row in flown[:3]:
        row.lat_deg, row.lon_deg, row.source_label, row.anchor_age_ms = None, None, m.SourceLabel.NOT_PLACED, -1
    verdict = flight_verdict(flown)
    assert verdict.spans == [(3.0, 59.0)] and verdict.reasons == ["not found on the map"]


def test_a_calibration_fault_applies_from_the_start_of_the_flight() -> None:
    verdict = flight_verdict(rows(), [(40.0, fault("scale", factor=0.5))])
    assert verdict.label == "do not trust it" and verdict.active_faults == ["height/focal seems x0.50 off"]
    assert verdict.text() == "Do not trust it (height/focal seems x0.50 off)."


def test_the_time_after_the_end_of_a_fault_is_trusted() -> None:
    verdict = flight_verdict(rows(), [(40.0, fault("heading", active=False)), (20.0, fault("heading", factor=90.0))])
    assert verdict.spans == [(40.0, 59.0)] and verdict.active_faults == []


def test_a_registration_fault_applies_from_the_last_match_on() -> None:
    flown = rows()
    for row in flown[31:]:
        row.anchor_age_ms = 1000
    verdict = flight_verdict(flown, [(50.0, fault("registration"))])
    assert verdict.spans == [(0.0, 30.0)]
    assert verdict.active_faults == ["the map is found nowhere"]


@pytest.mark.parametrize("quantity", ["picture upside down", "picture turned", "picture mirrored"])
def test_a_picture_that_turned_in_flight_leaves_the_flight_before_it_trusted(quantity: str) -> None:
    flown = rows()
    for row in flown[31:]:
        row.anchor_age_ms = 1000
    verdict = flight_verdict(flown, [(33.0, fault(quantity))])
    assert verdict.spans == [(0.0, 30.0)] and verdict.active_faults == [quantity]


def test_a_flight_that_rejects_most_map_matches_is_not_trusted() -> None:
    assert flight_verdict(rows(), (), {"map": {"accepted": 4, "innovation": 5}}).label == "do not trust it"
    assert flight_verdict(rows(), (), {"map": {"accepted": 5, "innovation": 5}}).label == "trust it"
    assert flight_verdict(rows(), (), {"map": {"accepted": 0, "innovation": 7}}).label == "trust it"  # too few to tell


def test_a_flight_without_frames_is_not_trusted() -> None:
    assert flight_verdict([]).text() == "Do not trust it (no frame)."


def test_the_verdict_is_computed_from_a_record(tmp_path: Path) -> None:
    record = FlightWriter(tmp_path / "flight.mcap", header(Config()))
    for i in range(20):
        record.write(frame(i), i)
        record.write(estimate(i, 0.0, 0.0), i)
        verdict = m.MeasurementVerdict(t_ns=i, frame_id=i, measurement="map", verdict=m.Verdict.INNOVATION)
        record.write(verdict, i)
    record.close()
    assert verdict_of(tmp_path).reasons == ["20 of 20 map matches were rejected"]
    record = FlightWriter(tmp_path / "flight.mcap", header(Config()))
    for i in range(20):
        record.write(frame(i), i)
        record.write(estimate(i, 0.0, 0.0), i)
    record.write(fault("scale", factor=2.0), 20)
    record.close()
    assert verdict_of(tmp_path).active_faults == ["height/focal seems x2.00 off"]
    with pytest.raises(SourceError):
        verdict_of(tmp_path / "elsewhere")


@pytest.mark.parametrize(("active", "code"), [([], 0), (["heading off by 90 deg"], 1)])
def test_a_replay_that_ends_with_a_fault_has_exit_code_1(
    active: list[str], code: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from terrafix_tools import replay

    monkeypatch.setattr(replay, "replay", lambda *_, **__: {"verdict": {"active_faults": active}})
    assert CliRunner().invoke(cli.app, ["replay", str(tmp_path)]).exit_code == code


def test_the_times_of_a_live_record_are_those_since_its_origin(tmp_path: Path) -> None:
    """A live record has the times of the computer's clock, here 1000 s at its origin."""
    shift_ns = 1000 * 10**9
    record = FlightWriter(tmp_path / "flight.mcap", header(Config()))
    record.write(msgspec.structs.replace(origin(), t_ns=shift_ns), 0)
    for i in range(20):
        for message in (frame(i), estimate(i, 0.0, 0.0)):
            record.write(msgspec.structs.replace(message, t_ns=message.t_ns + shift_ns), i)
    record.close()
    ((from_s, to_s),) = verdict_of(tmp_path).spans
    assert from_s == pytest.approx(0.0) and 5.0 < to_s < 20.0


def test_pictures_that_were_not_used_are_named_with_their_span_and_leave_the_trust_to_the_claims() -> None:
    frozen = [(20.0, fault("picture frozen")), (35.0, fault("picture frozen", active=False))]
    verdict = flight_verdict(rows(), frozen)
    assert verdict.label == "trust it" and verdict.text() == "Trust it (picture frozen from 20.0 s to 35.0 s)."
    assert verdict.since(5.0).as_json()["refused_s"] == [[15.0, 30.0, "picture frozen"]]
    open_end = flight_verdict(rows(), frozen[:1])
    assert open_end.refused == ((20.0, 59.0, "picture frozen"),) and not open_end.active_faults


@pytest.mark.parametrize(("lost", "asks"), [(11, False), (12, True), (60, True)])
def test_a_flight_without_a_map_match_along_a_fifth_of_its_frames_asks_for_a_position_when_it_is_through(
    lost: int, asks: bool
) -> None:
    flown = rows()
    for row in flown[:lost]:
        row.anchor_age_ms = None if lost == 60 else 1000 * (int(row.t_s) + 1)
    verdict = flight_verdict(flown)
    why = f"no map match in {lost} of 60 frames"
    assert verdict.since(1.0).as_json()["asks_s"] == ([-1.0, lost - 2.0, why] if asks else None)
    assert (f"{why}: a user fix or a hint there would help." in verdict.text()) is asks
