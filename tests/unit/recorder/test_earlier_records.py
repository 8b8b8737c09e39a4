"""Records of earlier versions of this program, as they were written."""

from pathlib import Path

from mcap.writer import Writer

from terrafix.core.pnp import solved
from terrafix.messages import MapMatch, MapPose
from terrafix.recorder.provenance import RECORD_FORMAT
from terrafix.recorder.reader import read_flight
from terrafix.recorder.writer import HEADER_NAME

# As it was written before the estimator computed the pose: inliers only, and the pose of the anchor's PnP.
MATCH_WITH_POSE = (
    b'{"type":"MapMatch","t_ns":9,"frame_id":4,"verdict":"accepted","matcher":"gradient","inliers":1,'
    b'"reprojection_px":1.5,"matches":[[0.1,0.2,3.0,4.0,5.0,0.9]],"radial_k1":-0.02,"map_sigma_m":2.5,'
    b'"pose":{"p_c_in_w_m":[1.0,2.0,3.0],"q_w_c":[0.0,1.0,0.0,0.0],"cov":[%s],"position_only":false},'
    b'"place":{"e_m":1.5,"n_m":2.5,"mass":0.95},"belief":null,"ground":null,'
    b'"search":{"step":"normal","sigma_m":0.0,"relocalized":false}}'
) % b",".join([b"0.5"] * 36)


def test_a_match_from_before_the_estimator_computed_poses_keeps_the_pose_of_the_anchor(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata(HEADER_NAME, {"format": RECORD_FORMAT})
        writer.add_message(writer.register_channel("/map_match", "json", 0), 1, MATCH_WITH_POSE, 1)
        writer.finish()  # type: ignore[no-untyped-call]
    ((_, _, match),) = read_flight(path)
    assert isinstance(match, MapMatch) and match.pnp is None
    assert match.pose == MapPose(p_c_in_w_m=(1.0, 2.0, 3.0), q_w_c=(0.0, 1.0, 0.0, 0.0), cov=(0.5,) * 36)
    assert match.matches == [(0.1, 0.2, 3.0, 4.0, 5.0, 0.9)]
    assert solved(match) is match
