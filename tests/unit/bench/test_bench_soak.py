"""The soak test: a flight forth and back without end, slopes, and what counts as growth."""

from pathlib import Path

import numpy as np
import pytest

from terrafix_tools.bench.soak import Samples, grows, growth, slope_per_h
from terrafix_tools.chaos.scene import Phase, Scene
from terrafix_tools.chaos.shuttle import TURN_S, ShuttleScene
from terrafix_tools.sim.autopilot.course import PeerState


def eastward(t_s: float) -> PeerState:
    """Hovers to 20 s, flies east at 10 m/s to 60 s, hovers."""
    east_m = 10.0 * min(max(t_s - 20.0, 0.0), 40.0)
    speed = 10.0 if 20.0 < t_s < 60.0 else 0.0
    return PeerState(48.0, 11.0 + east_m / 74_000.0, 600.0, 100.0, 0.0, 0.0, 0.0, 0.0, speed, 0.0)


def scene(tmp_path: Path) -> Scene:
    jpegs = [tmp_path / f"{i}.jpg" for i in range(160)]
    for i, path in enumerate(jpegs):
        path.write_bytes(str(i).encode())
    return Scene(tmp_path / "map.gpkg", jpegs, eastward, {Phase.LANDING: 70.0}, 80.0)


def test_the_shuttle_flies_back_the_way_it_came_with_the_images_of_the_place(tmp_path: Path) -> None:
    shuttle = ShuttleScene(scene(tmp_path))
    leg_s = shuttle._to_s - shuttle._from_s
    assert leg_s == 39.0, "from the first to the last half second in motion"
    period_s = 2.0 * (leg_s + TURN_S)
    there, back = shuttle.state(10.0), shuttle.state(period_s - TURN_S - 10.0)
    assert there.lon_deg == pytest.approx(back.lon_deg, abs=1e-9) and (there.ve_mps, back.ve_mps) == (10.0, -10.0)
    endless = shuttle.unfolded()
    assert endless.jpeg(10.0) == endless.jpeg(period_s - TURN_S - 10.0) == endless.jpeg(period_s + 10.0)
    assert endless.jpeg(10.0) != endless.jpeg(20.0)


def test_position_and_velocity_of_the_shuttle_have_no_jump_where_it_turns_round(tmp_path: Path) -> None:
    shuttle = ShuttleScene(scene(tmp_path))
    times_s = np.arange(0.0, 4.0 * (shuttle._to_s - shuttle._from_s + TURN_S), 0.01)
    folded = np.array([shuttle.folded(t_s) for t_s in times_s.tolist()])
    assert np.abs(np.diff(folded[:, 0])).max() <= 0.01 + 1e-9
    assert np.abs(np.diff(folded[:, 1])).max() < 1.01 * np.pi / TURN_S * 0.01
    assert np.gradient(folded[:, 0], 0.01) == pytest.approx(folded[:, 1], abs=0.01), "the rate is that of the second"
    assert (folded[:, 1].min(), folded[:, 1].max()) == (-1.0, 1.0)


def samples(mb_per_h: float, *, files: int = 0, away: bool = False) -> Samples:
    """Two hours of one process of 100 MB with a scatter of 0.2 MB, and of one that does not grow."""
    t_s = np.arange(0.0, 7200.0, 10.0)
    noise = np.random.default_rng(1).normal(0.0, 0.2, (2, len(t_s)))
    memory = 100.0 + mb_per_h * t_s / 3600.0 + noise[0]
    if away:
        memory[300:305] = np.nan
    opened = [20 + (files if t > 5400.0 else 0) for t in t_s.tolist()]
    return Samples(
        t_s.tolist(),
        {"vision": memory.tolist(), "link": (50.0 + noise[1]).tolist()},
        {"vision": opened, "link": [9] * len(opened)},
    )


def test_the_slope_is_that_of_the_line_with_its_uncertainty() -> None:
    t_s = np.arange(0.0, 3600.0, 10.0)
    slope, sigma = slope_per_h(t_s, 5.0 + 3.0 * t_s / 3600.0 + np.random.default_rng(2).normal(0.0, 0.1, len(t_s)))
    assert slope == pytest.approx(3.0, abs=4.0 * sigma) and 0.01 < sigma < 0.03
    assert slope_per_h(t_s[:2], t_s[:2])[1] == float("inf")


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (samples(0.0), []),
        (samples(1.0), []),  # 0.7 % of 150 MB
        (samples(3.0), ["memory by 1.9 % an hour"]),
        (samples(0.0, away=True), []),
        (samples(0.0, files=7), ["open files of vision by 7"]),
    ],
)
def test_growth_is_judged_by_all_processes_together_and_by_open_files(given: Samples, expected: list[str]) -> None:
    assert grows(growth(given)) == expected


def test_caches_that_fill_in_the_first_half_are_no_growth_and_what_grows_in_the_second_is() -> None:
    filling, late = samples(0.0), samples(0.0)
    t_s = np.array(filling.t_s)
    filling.memory_mb["vision"] = (np.array(filling.memory_mb["vision"]) + np.minimum(t_s / 60.0, 59.0)).tolist()
    late.memory_mb["vision"] = (np.array(late.memory_mb["vision"]) + np.maximum(t_s - 3600.0, 0.0) / 900.0).tolist()
    assert grows(growth(filling)) == []
    assert grows(growth(late)) == ["memory by 2.5 % an hour"]
