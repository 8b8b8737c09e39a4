"""`terrafix bench` on a tiny generated flight: fields of its JSON, and errors of bad arguments."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrafix.core.errors import OutputError, SourceError, UsageError
from terrafix.core.geodesy import quat_from_rot
from terrafix.messages import Prediction
from terrafix_engines.features.keypoints import Keypoints, MutualNearestMatcher
from terrafix_lab.bench.peers import LIGHTERGLUE, SIFT, XFEAT, ModelPoints, Peer, methods
from terrafix_lab.bench.run import bench
from textured_ground import PINHOLE, FlatMap, rotation, texture, view

FRAMES = 3


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Result of a run without data, which uses the generated flight."""
    out = tmp_path_factory.mktemp("bench") / "deep" / "bench.json"
    returned = bench(out.parent / "no-data", out, frames=FRAMES, page=out.parent / "benchmark.md")
    written: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    assert written == json.loads(json.dumps(returned))
    return written


@pytest.mark.slow
def test_the_result_lists_missing_data_and_describes_the_machine(measured: dict[str, Any]) -> None:
    assert [text.split(":")[0] for text in measured["missing"]] == ["XFeat", "flight village-1", "flight town-a"]
    assert list(measured["flights"]) == ["generated"]
    machine = measured["machine"]
    assert machine["cores"] >= 1 and machine["memory_mb"] > 100 and machine["cpu"]
    assert len(machine["load_average_before"]) == len(machine["load_average_after"]) == 3
    assert machine["versions"]["numpy"] and machine["versions"]["python"]


@pytest.mark.slow
def test_the_result_has_times_memory_and_accuracy_of_the_replay(measured: dict[str, Any]) -> None:
    flight = measured["flights"]["generated"]
    assert flight["frames"] == FRAMES and list(flight["runs"]) == ["weights-free"]
    run = flight["runs"]["weights-free"]
    assert list(run["stage_ms"]) == ["decode", "vision", "anchor", "estimator", "smoother"]
    for times in (run["frame_ms"], run["cpu_ms"], *run["stage_ms"].values()):
        assert 0.0 < times["median"] <= times["p95"]
    parts = sum(times["median"] for times in run["stage_ms"].values())
    assert parts == pytest.approx(run["frame_ms"]["median"], rel=0.3)
    for times in run["stage_cpu_ms"].values():
        assert 0.0 < times["median"] <= times["p95"] <= times["p99"]
    assert run["first_frame_ms"] > 0.0 and run["start_up_s"] > 0.0
    # frames_per_s includes the first frame, the median does not.
    assert run["frames_per_s"] == pytest.approx(1e3 / run["frame_ms"]["median"], rel=0.9)
    assert 50.0 < run["peak_memory_mb"] < 4000.0
    assert run["accuracy"]["localised"] == FRAMES
    assert 0.0 <= run["accuracy"]["within_20m"] <= run["accuracy"]["within_50m"] <= 1.0


@pytest.mark.slow
def test_the_result_has_the_peers_that_can_run(measured: dict[str, Any]) -> None:
    flight = measured["flights"]["generated"]
    assert list(flight["peers"]) == [SIFT] and 0 <= flight["peers"][SIFT]["answered"] <= FRAMES
    assert set(flight["peers"][SIFT]["accuracy"]) == {"within_20m", "within_50m", "median_m"}
    assert flight["missing"][-1] == f"{LIGHTERGLUE}: no weights"  # there are no data


@pytest.mark.slow
def test_vision_and_anchor_have_a_floor_below_their_own_time_and_single_parts_have_times(
    measured: dict[str, Any],
) -> None:
    floor = measured["flights"]["generated"]["floor"]
    for stage, kernel in (("vision", "KLT"), ("anchor", "Fourier transforms")):
        assert floor[stage]["ratio"] > 1.0
        assert 0.0 < floor[stage]["kernel_cpu_ms"]["median"] < floor[stage]["cpu_ms"]["median"]
        assert floor[stage]["kernels"][kernel]["calls"] >= 1.0
    assert floor["estimator"]["ratio"] is None
    micro = measured["micro"]
    assert micro["flight"] == "generated"
    for part in ("odometry", "look (search)", "belief update", "fix (patches + PnP)", "link, one second"):
        assert micro[part]["median"] > 0.0
    for mode in ("marginals", "jacobian"):
        assert f"estimator frame, 20 nodes, {mode}" in micro  # without times: three frames do not fill the window


def test_an_unknown_flight_raises_a_source_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"none of moon-1 is there; check --data and --flight"):
        bench(tmp_path, tmp_path / "b.json", flights=["moon-1"])


def test_bad_bench_arguments_raise_usage_and_output_errors(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--frames 1"):
        bench(tmp_path, tmp_path / "b.json", frames=1)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        bench(tmp_path, tmp_path / "file" / "b.json")


def test_peers_without_weights_are_named_as_missing(tmp_path: Path) -> None:
    found, missing = methods(tmp_path)
    assert SIFT in found and XFEAT not in found
    for method, what in zip((XFEAT, LIGHTERGLUE), missing[-2:], strict=True):
        assert what.startswith(f"{method}: {tmp_path}") and "terrafix models fetch" in what


def test_points_of_a_model_outside_of_the_mask_are_left_out() -> None:
    xy_px = np.array([[0.0, 0.0], [3.0, 1.0], [1.4, 2.0]], np.float32)

    class Detects:
        name = "three"

        def detect(self, image: np.ndarray, max_points: int) -> Keypoints:
            return Keypoints(xy_px, np.arange(3.0), np.eye(3, dtype=np.float32), (4, 3))

    mask = np.ones((3, 4), bool)
    mask[1, 3] = False
    found = ModelPoints(Detects(), MutualNearestMatcher(), 9).points(np.zeros((3, 4, 3), np.uint8), mask)
    assert found.xy_px.tolist() == xy_px[[0, 2]].tolist() and found.scores.tolist() == [0.0, 2.0]
    assert found.descriptors.tolist() == [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]


def test_the_baseline_locates_an_identical_image() -> None:
    """With the same image on both sides SIFT must succeed; a baseline that fails here would be an unfair comparison."""
    ground, r, p = texture(3, 420.0), rotation(35.0, 3.0, -2.0), np.array([12.0, -20.0, 100.0])
    baseline = Peer(methods(None)[0][SIFT], PINHOLE, FlatMap(ground))  # type: ignore[arg-type]
    predicted = Prediction(
        t_ns=0,
        frame_id=0,
        p_c_in_w_m=(-10.0, 5.0, 100.0),
        q_w_c=quat_from_rot(rotation(38.0, 3.0, -2.0)),
        cov=(0.0,) * 36,
        agl_m=98.0,
        agl_sigma_m=3.0,
        step_m=(0.0, 0.0),
        step_cov_m2=(0.0,) * 4,
    )
    found = baseline.locate(view(ground, PINHOLE, r, p), predicted)
    assert found == pytest.approx((12.0, -20.0), abs=1.5)
    assert baseline.locate(view(texture(50, 420.0), PINHOLE, r, p), predicted) is None
    times = baseline.times
    assert len(times.cpu_ms) == 2
    assert all(0.0 < kept_ms < all_ms for kept_ms, all_ms in zip(times.map_cpu_ms, times.cpu_ms, strict=True))
