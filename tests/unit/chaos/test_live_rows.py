"""Faults of streams and starts that only the fault matrix flies."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from simulated_flight import PLACE
from terrafix.core.errors import UsageError
from terrafix.messages import Frame
from terrafix.vision.sources import Shot
from terrafix_lab.chaos.camera import StreamedCamera, _Jpegs
from terrafix_lab.chaos.cli import chaos
from terrafix_lab.chaos.deck import CARRIED_S, CLEAR_M, DECK_MPS, SLOWING_S, from_deck
from terrafix_lab.chaos.scene import AFTER_S, LEAD_S, ChaosScene
from terrafix_lab.faults import pictures
from terrafix_lab.faults.edits import Span
from terrafix_lab.faults.fault import Phase
from terrafix_lab.faults.table import DECK_S
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.autopilot.peer import AutopilotPeer
from terrafix_lab.sim.camera.stream import FrameStream
from terrafix_lab.sim.flights.folder import Flight
from terrafix_lab.sim.flights.path import STEP_S, FlownPath
from terrafix_lab.sim.interfaces import State


def state(t_s: float) -> State:
    """Stands for 10 s, and climbs with 2 m/s."""
    up_m = 2.0 * max(0.0, t_s - 10.0)
    place, velocity = np.array([0.0, 0.0, 300.0 + up_m]), np.array([0.0, 0.0, 2.0 * (t_s > 10.0)])
    return State(t_s, place, velocity, 0.0, 0.0, 0.0, up_m, np.zeros(3), np.zeros(3), 0.0)


def test_a_start_on_a_deck_moves_with_it_and_comes_to_where_the_flight_was() -> None:
    path = FlownPath([state(k * STEP_S) for k in range(round(60.0 / STEP_S))])
    flat = SimpleNamespace(height_amsl_m=lambda e, n: np.full(np.shape(e), 300.0))
    flight = Flight(Kind.COPTER, PLACE, flat, None, path, None, (0.0, 0.0), 300.0, 60.0)  # type: ignore[arg-type]
    moved = from_deck(flight)
    first, off, ashore = (moved.path.state(t_s) for t_s in (5.0, DECK_S + 5.0, DECK_S + CARRIED_S + SLOWING_S + 1.0))
    assert first.velocity_enu_mps == pytest.approx([DECK_MPS, 0.0, 0.0]) and first.agl_m == 0.0
    assert first.p_b_in_w_m[2] == pytest.approx(300.0 + CLEAR_M)
    assert off.velocity_enu_mps == pytest.approx([DECK_MPS, 0.0, 2.0], abs=0.01) and off.agl_m > 9.0
    assert ashore.velocity_enu_mps == pytest.approx([0.0, 0.0, 2.0], abs=0.01)
    assert ashore.p_b_in_w_m[0] == pytest.approx(0.0, abs=0.1)
    placed_m = [moved.path.state(t_s).p_b_in_w_m[0] for t_s in (20.0, 20.5)]
    assert placed_m[1] - placed_m[0] == pytest.approx(0.5 * DECK_MPS), "position and velocity are of one motion"


def picture() -> np.ndarray:
    return cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (90, 160, 3), np.uint8), (0, 0), 3.0)


def test_open_water_is_dark_without_edges_and_another_in_each_picture() -> None:
    shots = [Shot(Frame(t_ns=t, frame_id=0, file="", width=0, height=0), (), picture()) for t in (1, 2, 3 * 10**9)]
    first, second, later = (shot.image for shot in pictures.water(Span(0.0, 1.0, "water"))(iter(shots)))
    assert first is not None and second is not None and first.shape == (90, 160, 3)
    assert 60 < first.mean() < 80 and first.std() < 8.0
    assert abs(np.corrcoef(first[..., 0].ravel(), second[..., 0].ravel())[0, 1]) < 0.2
    assert later is shots[2].image


def test_a_late_picture_is_one_of_the_time_before_the_fault_from_the_first_on() -> None:
    with FrameStream() as stream:
        jpeg = cv2.imencode(".jpg", picture())[1].tobytes()
        camera = StreamedCamera(stream, lambda _t_s: jpeg, lambda: 100.0)
        camera.past_s = 30.0
        past = camera._past(_Jpegs(decoded=True))
    assert len(past) == 60 and past[-1].frame.t_ns - past[-2].frame.t_ns == 500_000_000
    now = Shot(Frame(t_ns=past[-1].frame.t_ns + 500_000_000, frame_id=0, file="", width=0, height=0), (), picture())
    late = list(pictures.late_pictures(1.4)(iter([*past, now])))
    assert late[-1].image is past[-3].image, "1.5 s before"


def test_all_that_the_autopilot_sends_comes_a_second_time_so_much_later() -> None:
    sent: list[tuple[float, bytes]] = []
    peer, now_s = AutopilotPeer(), 0.0
    peer._autopilot = SimpleNamespace(transmit=lambda: b"%d" % round(10 * now_s))  # type: ignore[assignment]
    peer._now_s = lambda: now_s  # type: ignore[method-assign]
    peer._send_packets = lambda packets: sent.append((now_s, packets))  # type: ignore[method-assign]
    peer.again_after_s = 0.2
    for tenth in range(4):
        now_s = 0.1 * tenth
        peer._send()
    assert [packets for _, packets in sent] == [b"0", b"1", b"0", b"2", b"1", b"3"]


def test_a_long_fault_of_a_flight_in_the_air_begins_so_early_that_the_flight_goes_on_after_it() -> None:
    def begins(at_s: dict[Phase, float], lasts_s: float) -> float:
        return ChaosScene(None, [], None, at_s, 150.0).begin_s(Phase.CRUISE, lasts_s)  # type: ignore[arg-type]

    assert begins({Phase.CRUISE: 70.0}, 20.0) == 70.0
    assert begins({Phase.CRUISE: 70.0}, 60.0) == 150.0 - 60.0 - AFTER_S
    assert begins({Phase.CRUISE: 70.0}, 500.0) == LEAD_S
    assert begins({Phase.CRUISE: 70.0, Phase.LANDING: 120.0}, 60.0) == 70.0


def test_a_start_on_a_deck_is_flown_alone(tmp_path: object) -> None:
    with pytest.raises(UsageError, match="flight of its own"):
        chaos(out=tmp_path, fault=["start on a moving deck", "none"])  # type: ignore[arg-type]
