"""The verdict on a whole flight: from rows, faults and answers to map matches, without truth."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from flight_records import estimate, frame
from terrafix import messages as m
from terrafix.core.config import Config
from terrafix.core.errors import SourceError
from terrafix.recorder.writer import FlightWriter, header
from terrafix_tools import cli
from terrafix_tools.estimates import Row
from terrafix_tools.flight_verdict import flight_verdict, verdict_of


def rows(count: int = 60) -> list[Row]:
    """One a second, anchored each."""
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


def test_a_flight_on_the_map_is_trusted() -> None:
    said = flight_verdict(rows(), (), {"map": {"accepted": 60}})
    assert (said.word, said.spans, said.reasons) == ("trust it", [(0.0, 59.0)], [])
    assert said.text() == "Trust it."
    assert said.as_json()["verdict"] == "trust it" and said.as_json()["trusted_s"] == [[0.0, 59.0]]


def test_a_start_that_the_map_contradicts_leaves_the_choice_to_a_person() -> None:
    said = flight_verdict(rows(), (), {"map": {"accepted": 60}, "start": {"innovation": 1}})
    assert said.word == "do not trust it" and "start and map contradict each other" in said.text()


def test_spans_without_a_sure_position_are_left_out_and_named() -> None:
    flown = rows()
    for row in flown[10:20]:
        row.sigma_e_m = row.sigma_n_m = 51.0
    flown[30].lat_deg = None
    said = flight_verdict(flown)
    assert said.word == "trust it in part"
    assert said.spans == [(0.0, 9.0), (20.0, 29.0), (31.0, 59.0)]
    assert said.reasons == ["claims worse than 50 m", "no position"]
    assert "from 0.0 s to 9.0 s" in said.text() and "no position" in said.text()


@pytest.mark.parametrize(("age_ms", "trusted"), [(35_000, True), (35_001, False)])
def test_a_position_may_be_carried_forward_for_as_long_as_the_link_sends_it(age_ms: int, trusted: bool) -> None:
    flown = rows()
    flown[-1].anchor_age_ms = age_ms
    assert (flight_verdict(flown).share == 1.0) is trusted


def test_a_start_that_no_map_match_confirms_is_not_trusted_for_longer_than_a_moment() -> None:
    flown = rows()
    for row in flown:
        row.anchor_age_ms = -1
    said = flight_verdict(flown)
    assert said.spans == [(0.0, 5.0)]
    assert said.reasons == ["no map match has confirmed the start"]


def test_a_wrong_description_is_wrong_from_the_beginning_of_the_flight() -> None:
    said = flight_verdict(rows(), [(40.0, fault("scale", factor=0.5))])
    assert said.word == "do not trust it" and said.active_faults == ["height/focal seems x0.50 off"]
    assert said.text() == "Do not trust it (height/focal seems x0.50 off)."


def test_what_follows_the_end_of_a_fault_is_trusted() -> None:
    said = flight_verdict(rows(), [(40.0, fault("heading", active=False)), (20.0, fault("heading", factor=90.0))])
    assert said.spans == [(40.0, 59.0)] and said.active_faults == []


def test_a_map_that_is_found_nowhere_counts_from_the_last_match_on() -> None:
    flown = rows()
    for row in flown[31:]:
        row.anchor_age_ms = 1000
    said = flight_verdict(flown, [(50.0, fault("registration"))])
    assert said.spans == [(0.0, 30.0)]
    assert said.active_faults == ["the map is found nowhere"]


def test_an_estimate_that_refuses_most_positions_on_the_map_is_not_trusted() -> None:
    assert flight_verdict(rows(), (), {"map": {"accepted": 4, "innovation": 5}}).word == "do not trust it"
    assert flight_verdict(rows(), (), {"map": {"accepted": 5, "innovation": 5}}).word == "trust it"
    assert flight_verdict(rows(), (), {"map": {"accepted": 0, "innovation": 7}}).word == "trust it"  # too few to tell


def test_no_frames_are_nothing_to_trust() -> None:
    assert flight_verdict([]).text() == "Do not trust it (no frame)."


def test_the_verdict_of_a_record(tmp_path: Path) -> None:
    record = FlightWriter(tmp_path / "flight.mcap", header(Config()))
    for i in range(20):
        record.write(frame(i), i)
        record.write(estimate(i, 0.0, 0.0), i)
        said = m.MeasurementVerdict(t_ns=i, frame_id=i, measurement="map", verdict=m.Verdict.INNOVATION)
        record.write(said, i)
    record.close()
    assert verdict_of(tmp_path).reasons == ["20 of 20 positions on the map were refused"]
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
