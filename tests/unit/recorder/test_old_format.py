"""Records from before types and fields were renamed: JSON as those versions wrote it."""

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from terrafix.core.pnp import solved
from terrafix.messages import (
    BeliefMode,
    BeliefSummary,
    CalibrationEstimate,
    EkfDeadReckoning,
    EkfStatus,
    GnssInitialPosition,
    GpsInput,
    GroundPlane,
    InitialPosition,
    MapMatch,
    MapPose,
    MatchPlace,
    Message,
    Odometry,
    Prediction,
    SearchResult,
    SearchStep,
    Verdict,
)
from terrafix.recorder.old_format import OLD_DECODERS, OLD_FORMAT
from terrafix.recorder.provenance import RECORD_FORMAT
from terrafix.recorder.reader import ReadResult, read_flight
from terrafix.recorder.schema import TYPE_BY_TOPIC
from terrafix.recorder.writer import HEADER_NAME

COASTED = (
    b'{"type":"Coasted","t_ns":5,"coast_s":2.5,"lat_deg":48.0,"lon_deg":11.0,"velocity_enu_mps":[1.0,2.0,3.0],'
    b'"position_sigma_m":4.0,"velocity_sigma_mps":0.5,"way_m":[6.0,7.0],"gain_mps":[0.1,0.2,0.3]}'
)
SLOW_ERRORS = (
    b'{"type":"SlowErrors","t_ns":7,"frame_id":3,"error":[0.1,0.2,0.3,4.0,0.05,0.06],"cov":[1.0],'
    b'"lens":{"value":[0.1],"information":[2.0]}}'
)


def test_dead_reckoning_of_an_old_record_has_the_names_of_preintegration() -> None:
    message = OLD_DECODERS["/coasted"](COASTED)
    assert isinstance(message, EkfDeadReckoning)
    assert (message.t_ns, message.duration_s, message.delta_p_m) == (5, 2.5, (6.0, 7.0))
    assert message.delta_v_mps == (0.1, 0.2, 0.3) and message.velocity_enu_mps == (1.0, 2.0, 3.0)
    assert (message.lat_deg, message.lon_deg) == (48.0, 11.0)
    assert (message.position_sigma_m, message.velocity_sigma_mps) == (4.0, 0.5)


def test_calibration_of_an_old_record_keeps_its_numbers() -> None:
    message = OLD_DECODERS["/slow_errors"](SLOW_ERRORS)
    assert isinstance(message, CalibrationEstimate)
    assert (message.t_ns, message.frame_id) == (7, 3)
    assert message.state == (0.1, 0.2, 0.3, 4.0, 0.05, 0.06) and message.cov == (1.0,)
    assert message.lens is not None and (message.lens.value, message.lens.information) == ((0.1,), (2.0,))


COV = ",".join(["0.5"] * 36)
MAP_MATCH = (
    b'{"type":"MapMatch","t_ns":9,"frame_id":4,"verdict":"accepted","matcher":"gradient","coarse":true,'
    b'"matches":[[0.1,0.2,3.0,4.0,5.0,0.9]],"p_c_in_w_m":[1.0,2.0,3.0],"q_w_c":[0.0,1.0,0.0,0.0],"cov":[%s],'
    b'"lens":-0.02,"inliers":12,"reprojection_px":1.5,"margin":6.5,"mode_mass":0.95,"mode_e_m":1.5,"mode_n_m":2.5,'
    b'"modes":[[1.5,2.5,0.95,16.0],[90.0,-7.0,0.05,25.0]],"belief_m":[5.9,2.0],"belief_cov_m2":[20.0,1.0,1.0,30.0],'
    b'"ground":[250.0,0.01,-0.02],"relief_m":0.7,"map_sigma_m":2.5,"step":"merge","lost_sigma_m":40.0,"found":true}'
) % COV.encode()
# As the anchor published it of a frame that it did not correlate.
BAD_IMAGE = (
    b'{"type":"MapMatch","t_ns":9,"frame_id":4,"verdict":"bad_image","matcher":"xfeat","coarse":false,"matches":[],'
    b'"p_c_in_w_m":null,"q_w_c":null,"cov":null,"lens":0.0,"inliers":0,"reprojection_px":0.0,"margin":0.0,'
    b'"mode_mass":0.0,"mode_e_m":0.0,"mode_n_m":0.0,"modes":[],"belief_m":[0.0,0.0],"belief_cov_m2":[0.0,0.0,0.0,0.0],'
    b'"ground":null,"relief_m":0.0,"map_sigma_m":5.0,"step":"skip","lost_sigma_m":0.0,"found":false}'
)
START = (
    b'{"type":"Start","t_ns":3,"verdict":"accepted","lat_deg":48.0,"lon_deg":11.0,"sigma_m":4.0,"ground_amsl_m":510.0}'
)
GNSS_START = b'{"type":"GnssStart","t_ns":3,"lat_deg":48.0,"lon_deg":11.0,"sigma_m":4.0,"receiver":1}'
PREDICTION = (
    b'{"type":"Prediction","t_ns":6,"frame_id":2,"p_c_in_w_m":[1.0,2.0,3.0],"q_w_c":[0.0,1.0,0.0,0.0],"cov":[%s],'
    b'"agl_m":100.0,"agl_sigma_m":2.0,"step_m":[4.0,5.0],"step_cov_m2":[1.0,0.0,0.0,1.0],"lens":-0.03,"start_ns":5}'
) % COV.encode()
ODOMETRY = (
    b'{"type":"Odometry","t_ns":6,"frame_id":2,"keyframe_id":1,"verdict":"accepted","pairs":[[0.1,0.2,0.3,0.4]],'
    b'"sigma_norm":0.001,"inliers":1,"tracked":2,"becomes_keyframe":true,"before_id":0,'
    b'"triples":[[0.1,0.2,0.3,0.4,0.5,0.6]],"triples_sigma_norm":0.002,"static":false}'
)
GPS_INPUT = (
    b'{"type":"GpsInput","t_ns":8,"fix_type":1,"time_week":0,"time_week_ms":0,"lat_deg":0.0,"lon_deg":0.0,'
    b'"alt_amsl_m":0.0,"hdop":99.0,"vdop":99.0,"vn_mps":0.0,"ve_mps":0.0,"vd_mps":0.0,"speed_accuracy_mps":9.0,'
    b'"horiz_accuracy_m":1000.0,"vert_accuracy_m":1000.0,"satellites_visible":0,"estimate_age_ms":-1.0,"caution":2,'
    b'"unanchored_s":20.0,"map_offset_m":[1.0,2.0],"reason":"no estimate yet","resets":3}'
)


def test_a_flat_map_match_has_its_numbers_in_the_parts() -> None:
    assert OLD_DECODERS["/map_match"](MAP_MATCH) == MapMatch(
        t_ns=9,
        frame_id=4,
        verdict=Verdict.ACCEPTED,
        matcher="gradient",
        inliers=12,
        reprojection_px=1.5,
        matches=[(0.1, 0.2, 3.0, 4.0, 5.0, 0.9)],
        radial_k1=-0.02,
        map_sigma_m=2.5,
        pose=MapPose(p_c_in_w_m=(1.0, 2.0, 3.0), q_w_c=(0.0, 1.0, 0.0, 0.0), cov=(0.5,) * 36, position_only=True),
        place=MatchPlace(e_m=1.5, n_m=2.5, mass=0.95),
        belief=BeliefSummary(
            mean_m=(5.9, 2.0),
            cov_m2=(20.0, 1.0, 1.0, 30.0),
            modes=[
                BeliefMode(e_m=1.5, n_m=2.5, mass=0.95, variance_m2=16.0),
                BeliefMode(e_m=90.0, n_m=-7.0, mass=0.05, variance_m2=25.0),
            ],
            mode_score=6.5,
        ),
        ground=GroundPlane(amsl_m=250.0, slope_e=0.01, slope_n=-0.02, relief_m=0.7),
        search=SearchResult(step=SearchStep.MERGE, sigma_m=40.0, relocalized=True),
    )


def test_a_flat_map_match_without_pose_belief_and_ground_has_none_of_the_parts() -> None:
    assert OLD_DECODERS["/map_match"](BAD_IMAGE) == MapMatch(
        t_ns=9,
        frame_id=4,
        verdict=Verdict.BAD_IMAGE,
        matcher="xfeat",
        map_sigma_m=5.0,
        search=SearchResult(step=SearchStep.SKIP),
    )


def test_a_place_that_a_search_found_has_no_belief() -> None:
    old = json.loads(MAP_MATCH) | {"modes": [], "belief_m": [0.0, 0.0], "margin": 0.0, "mode_mass": 1.0}
    match = OLD_DECODERS["/map_match"](json.dumps(old).encode())
    assert isinstance(match, MapMatch) and match.belief is None
    assert match.place == MatchPlace(e_m=1.5, n_m=2.5, mass=1.0)


@pytest.mark.parametrize(
    ("topic", "data", "message_type", "expected"),
    [
        ("/start", START, InitialPosition, {"verdict": Verdict.ACCEPTED, "lat_deg": 48.0, "ground_amsl_m": 510.0}),
        ("/gnss_start", GNSS_START, GnssInitialPosition, {"lon_deg": 11.0, "sigma_m": 4.0, "receiver": 1}),
        ("/prediction", PREDICTION, Prediction, {"radial_k1": -0.03, "prior_t_ns": 5, "step_m": (4.0, 5.0)}),
        (
            "/odometry",
            ODOMETRY,
            Odometry,
            {
                "two_view": [(0.1, 0.2, 0.3, 0.4)],
                "three_view": [(0.1, 0.2, 0.3, 0.4, 0.5, 0.6)],
                "previous_keyframe_id": 0,
                "three_view_sigma_norm": 0.002,
            },
        ),
        (
            "/gps_input",
            GPS_INPUT,
            GpsInput,
            {"degradation": 2, "no_fix_reason": "no estimate yet", "unanchored_s": 20.0, "resets": 3},
        ),
    ],
)
def test_renamed_fields_keep_their_values(
    topic: str, data: bytes, message_type: type[Message], expected: dict[str, Any]
) -> None:
    message = OLD_DECODERS[topic](data)
    assert type(message) is message_type
    assert {name: getattr(message, name) for name in expected} == expected


# As it was written before the estimator computed the pose: inliers only, and the pose of the anchor's PnP.
MATCH_WITH_POSE = (
    b'{"type":"MapMatch","t_ns":9,"frame_id":4,"verdict":"accepted","matcher":"gradient","inliers":1,'
    b'"reprojection_px":1.5,"matches":[[0.1,0.2,3.0,4.0,5.0,0.9]],"radial_k1":-0.02,"map_sigma_m":2.5,'
    b'"pose":{"p_c_in_w_m":[1.0,2.0,3.0],"q_w_c":[0.0,1.0,0.0,0.0],"cov":[%s],"position_only":false},'
    b'"place":{"e_m":1.5,"n_m":2.5,"mass":0.95},"belief":null,"ground":null,'
    b'"search":{"step":"normal","sigma_m":0.0,"relocalized":false}}'
) % COV.encode()


def test_a_match_from_before_the_estimator_computed_poses_keeps_the_pose_of_the_anchor(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    write_old(path, RECORD_FORMAT, {"/map_match": MATCH_WITH_POSE})
    ((_, _, match),) = read_flight(path)
    assert isinstance(match, MapMatch) and match.pnp is None
    assert match.pose == MapPose(p_c_in_w_m=(1.0, 2.0, 3.0), q_w_c=(0.0, 1.0, 0.0, 0.0), cov=(0.5,) * 36)
    assert match.matches == [(0.1, 0.2, 3.0, 4.0, 5.0, 0.9)]
    assert solved(match) is match


def test_a_topic_that_is_not_one_of_today_has_the_type_that_replaced_it() -> None:
    assert set(OLD_DECODERS) - set(TYPE_BY_TOPIC) == {
        "/coasted",
        "/slow_errors",
        "/filter_status",
        "/start",
        "/gnss_start",
    }
    status = b'{"type":"FilterStatus","t_ns":1,"flags":7,"position_ratio":0.5,"velocity_ratio":0.25}'
    assert OLD_DECODERS["/filter_status"](status) == EkfStatus(t_ns=1, flags=7, position_ratio=0.5, velocity_ratio=0.25)


def write_old(path: Path, file_format: str, messages: dict[str, bytes]) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata(HEADER_NAME, {"format": file_format})
        for topic, data in messages.items():
            channel = writer.register_channel(topic, "json", 0)
            writer.add_message(channel, 1, data, 1)
        writer.finish()  # type: ignore[no-untyped-call]


def test_the_format_of_the_file_decides_how_a_topic_is_read(tmp_path: Path) -> None:
    """An old message read with the present type would have empty lists."""
    path = tmp_path / "flight.mcap"
    old = {"/coasted": COASTED, "/map_match": MAP_MATCH, "/odometry": ODOMETRY, "/start": START}
    write_old(path, OLD_FORMAT, old)
    result = ReadResult()
    read = {topic: message for topic, _, message in read_flight(path, result)}
    assert set(read) == {"/ekf_dead_reckoning", "/map_match", "/odometry", "/initial_position"}
    assert read["/map_match"] == OLD_DECODERS["/map_match"](MAP_MATCH)
    assert read["/odometry"] == OLD_DECODERS["/odometry"](ODOMETRY)
    assert (result.undecodable, result.header["format"]) == (0, OLD_FORMAT)
    present = json.loads(ODOMETRY) | {"two_view": [[0.1, 0.2, 0.3, 0.4]]}
    write_old(path, RECORD_FORMAT, {"/odometry": json.dumps(present).encode(), "/coasted": COASTED})
    ((topic, _, message),) = read_flight(path)
    assert topic == "/odometry" and isinstance(message, Odometry) and len(message.two_view) == 1


def test_a_damaged_old_message_is_counted_and_skipped(tmp_path: Path) -> None:
    path, result = tmp_path / "flight.mcap", ReadResult()
    write_old(path, OLD_FORMAT, {"/map_match": b'{"type":"MapMatch","t_ns":9}', "/prediction": PREDICTION[:40]})
    assert list(read_flight(path, result)) == []
    assert result.undecodable == 2
