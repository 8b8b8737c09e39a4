"""GNSS judge: what it detects and how soon, when a receiver is trusted again, and the switch of the source."""

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gnss_rig import accurate, feed_receiver, reading
from link_rig import LAT, LON, MS, SPEED_EAST, S, estimate
from link_wire import WiredEdge, heartbeat
from terrafix import messages as m
from terrafix.link.autopilot.gnss_receiver import gnss_reading
from terrafix.link.gnss.monitor import MIN_VISION_NS
from terrafix.link.integrity.output_predictor import offset
from terrafix.link.node import LinkNode
from terrafix.messages import GnssState
from terrafix_lab.sim.gnss_evaluation.flight import Vision, fly
from terrafix_lab.sim.gnss_evaluation.table import summary, table


def verdicts(published: list[m.Message]) -> list[tuple[float, GnssState]]:
    """-> (s, state) of every change of the state."""
    found: list[tuple[float, GnssState]] = []
    for x in published:
        if isinstance(x, m.GnssVerdict) and (not found or found[-1][1] is not x.state):
            found.append((x.t_ns / S, x.state))
    return found


def first(published: list[m.Message], state: GnssState) -> float:
    return next(t for t, s in verdicts(published) if s is state)


@pytest.fixture
def node() -> LinkNode:
    """A link that trusts its receiver after 20 s."""
    node = LinkNode(10.0)
    feed_receiver(node, 20.0, accurate)
    return node


def test_a_receiver_that_agrees_for_ten_seconds_is_trusted() -> None:
    published = feed_receiver(LinkNode(10.0), 20.0, accurate)
    assert first(published, GnssState.TRUSTED) == pytest.approx(10.0, abs=1.0)
    assert not [x for x in published if isinstance(x, m.StatusText) and "GPS" in x.text]


def test_jamming_is_detected_within_half_a_second(node: LinkNode) -> None:
    jammed = feed_receiver(node, 5.0, lambda _: None, begin_s=20.0)
    assert first(jammed, GnssState.LOST) - 20.0 < 0.5


def test_silence_is_detected_within_two_seconds(node: LinkNode) -> None:
    published = [x for step in range(1000, 1200) for x in node.tick(step * 20 * MS)]
    assert first(published, GnssState.LOST) - 20.0 < 2.0


def test_a_receiver_that_claims_a_bad_accuracy_is_lost() -> None:
    node = LinkNode(10.0)
    list(node.on(reading(S, (0.0, 0.0), horizontal_m=40.0)))
    published = list(node.on(reading(2 * S, (0.0, 0.0), horizontal_m=40.0)))
    assert published == [] or verdicts(published)[-1][1] is GnssState.LOST


@pytest.mark.parametrize("error_m", [(60.0, 0.0), (0.0, -300.0), (2000.0, 2000.0)])
def test_a_sudden_spoofing_is_detected_within_a_second(node: LinkNode, error_m: tuple[float, float]) -> None:
    published = feed_receiver(node, 5.0, lambda _: error_m, begin_s=20.0)
    assert first(published, GnssState.SPOOFED) - 20.0 <= 1.0
    (text,) = [x for x in published if isinstance(x, m.StatusText) and "off the map" in x.text]
    assert text.severity == 2
    assert text.text.startswith("Terrafix: GPS 1 is ")


@pytest.mark.parametrize("bearing_deg", range(0, 360, 45))
def test_a_drag_off_of_1_mps_is_detected_before_30_m(node: LinkNode, bearing_deg: int) -> None:
    east, north = math.sin(math.radians(bearing_deg)), math.cos(math.radians(bearing_deg))
    published = feed_receiver(node, 40.0, lambda t: ((t - 20) * east, (t - 20) * north), begin_s=20.0, sigma_m=4.0)
    assert first(published, GnssState.SPOOFED) - 20.0 < 30.0


def test_with_an_uncertain_estimate_no_receiver_is_called_spoofed() -> None:
    node = LinkNode(10.0)
    published = feed_receiver(node, 60.0, lambda _: (40.0, 0.0), sigma_m=15.0)
    assert GnssState.SPOOFED not in [s for _, s in verdicts(published)]


def test_a_spoofed_receiver_is_trusted_again_after_a_minute_of_uninterrupted_agreement(node: LinkNode) -> None:
    feed_receiver(node, 10.0, lambda _: (200.0, 0.0), begin_s=20.0)
    interrupted = feed_receiver(node, 60.0, lambda t: (0.0, 0.0) if t < 85.0 else (25.0, 0.0), begin_s=30.0)
    assert verdicts(interrupted)[-1][1] is GnssState.SPOOFED  # 55 s of agreement, then an error
    back = feed_receiver(node, 70.0, accurate, begin_s=90.0)
    assert first(back, GnssState.TRUSTED) - 90.0 == pytest.approx(60.0, abs=1.5)
    assert "Terrafix: GPS 1 agrees with the map again" in [x.text for x in back if isinstance(x, m.StatusText)]


def test_a_spoofed_receiver_stays_spoofed_while_it_is_jammed(node: LinkNode) -> None:
    feed_receiver(node, 5.0, lambda _: (200.0, 0.0), begin_s=20.0)
    jammed = feed_receiver(node, 5.0, lambda _: None, begin_s=25.0)
    assert {s for _, s in verdicts(jammed)} == {GnssState.SPOOFED}


def test_after_a_step_of_the_estimate_a_disagreement_is_disputed(node: LinkNode) -> None:
    stepped = feed_receiver(node, 9.0, accurate, begin_s=20.0, sigma_m=4.0, ours=lambda _: 27.0)
    assert GnssState.DISPUTED in [s for _, s in verdicts(stepped)]
    assert GnssState.SPOOFED not in [s for _, s in verdicts(stepped)]
    assert "Terrafix: GPS 1 and the map disagree" in [x.text for x in stepped if isinstance(x, m.StatusText)]


def test_before_the_first_map_fix_every_receiver_is_unknown() -> None:
    """The start coordinate may belong to another flight, after a restart of the computer in flight."""
    published = feed_receiver(LinkNode(10.0), 60.0, lambda _: (2000.0, 0.0), anchor_age_ms=-1)
    assert {s for _, s in verdicts(published)} == {GnssState.UNKNOWN}


# --- switch of the source ---


def test_mode_off_publishes_nothing_and_mode_advise_does_not_switch() -> None:
    for mode, count in (("off", 0), ("advise", 1)):
        node = LinkNode(10.0, mode)  # type: ignore[arg-type]
        published = feed_receiver(node, 20.0, accurate) + feed_receiver(
            node, 20.0, lambda _: (200.0, 0.0), begin_s=20.0
        )
        assert len([x for x in published if isinstance(x, m.StatusText) and "off the map" in x.text]) == count
        assert not [x for x in published if isinstance(x, m.PositionSource)]


def test_mode_act_switches_to_vision_and_back_to_a_trusted_receiver() -> None:
    node = LinkNode(10.0, "act")
    feed_receiver(node, 20.0, accurate)
    published = feed_receiver(node, 10.0, lambda t: (200.0, 0.0) if int(t) % 4 else None, begin_s=20.0)
    (to_vision,) = [x for x in published if isinstance(x, m.PositionSource)]
    assert to_vision.vision
    assert to_vision.t_ns / S - 20.0 < 1.5
    back = [x for x in feed_receiver(node, 100.0, accurate, begin_s=30.0) if isinstance(x, m.PositionSource)]
    assert [(x.vision, x.receiver) for x in back] == [(False, 0)]
    assert back[0].t_ns / S - 30.0 >= 59.0
    assert back[0].t_ns - to_vision.t_ns >= MIN_VISION_NS


def test_there_is_no_switch_to_vision_without_a_3d_fix() -> None:
    node = LinkNode(10.0, "act")
    feed_receiver(node, 20.0, accurate)
    published: list[m.Message] = []
    for step in range(1200, 2000):  # estimates have stopped: fix type 1
        published += node.on(reading(step * 20 * MS, None)) if step % 10 == 0 else []
        published += node.tick(step * 20 * MS)
    assert not [x for x in published if isinstance(x, m.PositionSource)]


def test_there_is_no_switch_before_arming_nor_for_a_receiver_that_never_had_a_fix() -> None:
    disarmed = m.VehicleState(t_ns=0, source="mavlink", armed=False)
    node = LinkNode(10.0, "act")
    list(node.on(disarmed))
    assert not [x for x in feed_receiver(node, 20.0, lambda _: None) if isinstance(x, m.PositionSource)]
    without_fix = feed_receiver(LinkNode(10.0, "act"), 20.0, lambda t: accurate(t) if t > 1.0 else None)
    assert not [x for x in without_fix if isinstance(x, m.PositionSource)]


@pytest.mark.parametrize(("autopilot_m", "switches"), [(None, False), (150.0, True), (250.0, False)])
def test_the_switch_to_the_map_is_a_step_of_200_m_at_most(autopilot_m: float | None, switches: bool) -> None:
    """``autopilot_m``: from our position to where the autopilot takes itself to be; None: it reports no position."""
    node, published = LinkNode(10.0, "act"), []

    def where(t_s: float) -> tuple[float, float]:
        if autopilot_m is not None:
            lat_deg, lon_deg = offset(LAT, LON, SPEED_EAST * t_s, autopilot_m)
            status = {"t_ns": round(t_s * S), "flags": 831, "position_ratio": 0.1, "velocity_ratio": 0.1}
            published.extend(node.on(m.EkfStatus(**status, lat_deg=lat_deg, lon_deg=lon_deg)))
        return accurate(t_s) if t_s < 20.0 else (300.0, 0.0)

    published += feed_receiver(node, 30.0, where)
    assert [x.vision for x in published if isinstance(x, m.PositionSource)] == [True] * switches
    texts = [x.text for x in published if isinstance(x, m.StatusText) and "not switched" in x.text]
    step_m = 300 if autopilot_m is None else autopilot_m
    assert texts == ([] if switches else [f"Terrafix: not switched: the map is {step_m:.0f} m off"])


def test_there_is_no_switch_while_one_receiver_is_trusted() -> None:
    node = LinkNode(10.0, "act")
    published: list[m.Message] = []
    for step in range(3000):
        now_ns = step * 20 * MS
        if step % 25 == 5:
            published += node.on(estimate(now_ns - 100 * MS))
        if step % 10 == 0:
            published += node.on(reading(now_ns, (1.0, 0.0)))
            published += node.on(reading(now_ns, (300.0, 0.0) if step > 1500 else (0.0, 1.0), receiver=1))
        published += node.tick(now_ns)
    assert {(x.receiver, x.state) for x in published if isinstance(x, m.GnssVerdict)} >= {
        (0, GnssState.TRUSTED),
        (1, GnssState.SPOOFED),
    }
    assert not [x for x in published if isinstance(x, m.PositionSource)]


# --- MAVLink ---


def gps_raw(**changes: Any) -> Any:
    fields = {"time_usec": 1, "fix_type": 3, "lat": 480_000_000, "lon": 110_000_000, "alt": 5, "eph": 80, "epv": 90}
    fields |= {"vel": 2000, "cog": 0, "satellites_visible": 14, "h_acc": 1300}
    return mavlink.MAVLink_gps_raw_int_message(**fields | changes)


def test_gnss_readings_are_converted_to_si_units_and_unknown_fields_are_none() -> None:
    known = gnss_reading(gps_raw(), 5)
    assert (known.receiver, known.fix_type, known.lat_deg, known.lon_deg) == (0, 3, 48.0, 11.0)
    assert (known.horizontal_m, known.speed_mps, known.satellites) == (1.3, 20.0, 14)
    blank = gnss_reading(gps_raw(fix_type=1, vel=65_535, satellites_visible=255, h_acc=0), 5)
    assert (blank.lat_deg, blank.horizontal_m, blank.speed_mps, blank.satellites) == (None, None, None, None)
    second = gnss_reading(mavlink.MAVLink_gps2_raw_message(1, 3, 1, 2, 3, 4, 5, 6, 7, 8, 0, 0), 5)
    assert second.receiver == 1


@pytest.mark.parametrize(
    ("changes", "receivers"), [({}, [1]), ({"gps_id": 1}, [0]), ({"outputs": ["odometry"]}, [0, 1])]
)
def test_our_own_gps_input_is_not_read_as_a_receiver(changes: dict[str, Any], receivers: list[int]) -> None:
    second = mavlink.MAVLink_gps2_raw_message(1, 3, 1, 2, 3, 4, 5, 6, 7, 8, 0, 0)
    published = WiredEdge(**changes).receives(0, heartbeat(), gps_raw(), second)
    assert [x.receiver for x in published if isinstance(x, m.GnssReading)] == receivers


# --- flights without images ---


def test_a_flight_without_spoofing_gives_no_alarm() -> None:
    flight = fly(400.0, Vision(sigma_m=4.0, wander_s=20.0), (), seed=3)
    assert {state for _, state in flight.states} <= {GnssState.UNKNOWN, GnssState.TRUSTED}


@pytest.mark.slow
def test_the_table_of_the_gnss_judge_counts_events_and_delays() -> None:
    result = table(5, 6.0, seed=7)
    assert dict(result.flights) == {"clean": 1, "outage": 1, "jam": 1, "jump": 1, "drag": 1}
    rows = summary(result)
    assert result.missed.total() == 0
    assert rows["jump_seconds"]["worst"] <= 1.0  # type: ignore[index]
    assert rows["outage_seconds"]["worst"] <= 2.0  # type: ignore[index]
