"""The GNSS judge: what it sees and how soon, when it trusts again, and what it may do about it."""

import math
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from autopilot_rig import FRAME, Rig, at_5_hz, real_fix
from gnss_rig import reading, right, watched
from link_rig import LAT, LON, MS, S, estimate
from link_wire import MemoryWire, heartbeat, packed
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.link.autopilot.gnss_receiver import reading_of
from terrafix.link.edge import MavlinkEdge
from terrafix.link.gnss.monitor import BACK_NS
from terrafix.link.mavlink.transport import Address
from terrafix.link.node import LinkNode
from terrafix.messages import GnssState
from terrafix_tools.sim.autopilot.parameters import BESIDE_A_RECEIVER, Kind
from terrafix_tools.sim.judge.flight import Vision, fly
from terrafix_tools.sim.judge.table import said, table


def verdicts(heard: list[m.Message]) -> list[tuple[float, GnssState]]:
    """(s, state) of every change."""
    found: list[tuple[float, GnssState]] = []
    for x in heard:
        if isinstance(x, m.GnssVerdict) and (not found or found[-1][1] is not x.state):
            found.append((x.t_ns / S, x.state))
    return found


def first(heard: list[m.Message], state: GnssState) -> float:
    return next(t for t, s in verdicts(heard) if s is state)


def test_a_receiver_that_agrees_is_trusted_after_ten_seconds() -> None:
    heard = watched(LinkNode(10.0), 20.0, right)
    assert first(heard, GnssState.TRUSTED) == pytest.approx(10.0, abs=1.0)
    assert not [x for x in heard if isinstance(x, m.StatusText) and "GPS" in x.text]


def test_a_jam_is_seen_within_two_seconds_with_and_without_a_word_of_it() -> None:
    node = LinkNode(10.0)
    watched(node, 20.0, right)
    jammed = watched(node, 5.0, lambda _: None, begin_s=20.0)
    assert first(jammed, GnssState.LOST) - 20.0 < 0.5
    silent = LinkNode(10.0)
    watched(silent, 20.0, right)
    heard: list[m.Message] = []
    for step in range(1000, 1200):
        heard += silent.tick(step * 20 * MS)
    assert first(heard, GnssState.LOST) - 20.0 < 2.0


def test_a_receiver_that_calls_itself_useless_is_lost() -> None:
    node = LinkNode(10.0)
    list(node.on(reading(S, (0.0, 0.0), horizontal_m=40.0)))
    heard = list(node.on(reading(2 * S, (0.0, 0.0), horizontal_m=40.0)))
    assert heard == [] or verdicts(heard)[-1][1] is GnssState.LOST


@pytest.mark.parametrize("away", [(60.0, 0.0), (0.0, -300.0), (2000.0, 2000.0)])
def test_a_sudden_spoofer_is_seen_within_a_second(away: tuple[float, float]) -> None:
    node = LinkNode(10.0)
    watched(node, 20.0, right)
    heard = watched(node, 5.0, lambda _: away, begin_s=20.0)
    assert first(heard, GnssState.SPOOFED) - 20.0 <= 1.0
    (text,) = [x for x in heard if isinstance(x, m.StatusText) and "off the map" in x.text]
    assert text.severity == 2
    assert text.text.startswith("Terrafix: GPS 1 is ")


@pytest.mark.parametrize("bearing_deg", range(0, 360, 45))
def test_a_drag_off_of_1_mps_is_seen_before_30_m(bearing_deg: int) -> None:
    east, north = math.sin(math.radians(bearing_deg)), math.cos(math.radians(bearing_deg))
    node = LinkNode(10.0)
    watched(node, 20.0, right, sigma_m=4.0)
    heard = watched(node, 40.0, lambda t: ((t - 20) * east, (t - 20) * north), begin_s=20.0, sigma_m=4.0)
    assert first(heard, GnssState.SPOOFED) - 20.0 < 30.0


def test_a_vague_estimate_accuses_nobody() -> None:
    node = LinkNode(10.0)
    heard = watched(node, 60.0, lambda _: (40.0, 0.0), sigma_m=15.0)
    assert GnssState.SPOOFED not in [s for _, s in verdicts(heard)]


def test_trust_comes_back_after_a_minute_of_agreement_without_a_break() -> None:
    node = LinkNode(10.0)
    watched(node, 20.0, right)
    watched(node, 10.0, lambda _: (200.0, 0.0), begin_s=20.0)
    teasing = watched(node, 60.0, lambda t: (0.0, 0.0) if t < 85.0 else (25.0, 0.0), begin_s=30.0)
    assert verdicts(teasing)[-1][1] is GnssState.SPOOFED  # 55 s were right, and then it was not
    back = watched(node, 70.0, right, begin_s=90.0)
    assert first(back, GnssState.TRUSTED) - 90.0 == pytest.approx(60.0, abs=1.5)
    assert "Terrafix: GPS 1 agrees with the map again" in [x.text for x in back if isinstance(x, m.StatusText)]


def test_a_spoofer_does_not_hide_behind_a_jammer() -> None:
    node = LinkNode(10.0)
    watched(node, 20.0, right)
    watched(node, 5.0, lambda _: (200.0, 0.0), begin_s=20.0)
    jammed = watched(node, 5.0, lambda _: None, begin_s=25.0)
    assert {s for _, s in verdicts(jammed)} == {GnssState.SPOOFED}


def test_when_we_ourselves_have_just_moved_it_is_a_dispute() -> None:
    node = LinkNode(10.0)
    watched(node, 20.0, right, sigma_m=4.0)
    moved = watched(node, 9.0, right, begin_s=20.0, sigma_m=4.0, ours=lambda _: 27.0)
    assert GnssState.DISPUTED in [s for _, s in verdicts(moved)]
    assert GnssState.SPOOFED not in [s for _, s in verdicts(moved)]
    assert "Terrafix: GPS 1 and the map disagree" in [x.text for x in moved if isinstance(x, m.StatusText)]


def test_before_the_first_map_fix_nobody_is_accused_and_nobody_trusted() -> None:
    """The start coordinate may be that of another start: a computer that was started again in flight."""
    heard = watched(LinkNode(10.0), 60.0, lambda _: (2000.0, 0.0), anchor_age_ms=-1)
    assert {s for _, s in verdicts(heard)} == {GnssState.UNKNOWN}


# --- what follows ---


def test_off_says_nothing_and_advise_never_switches() -> None:
    for mode, count in (("off", 0), ("advise", 1)):
        node = LinkNode(10.0, mode)  # type: ignore[arg-type]
        heard = watched(node, 20.0, right) + watched(node, 20.0, lambda _: (200.0, 0.0), begin_s=20.0)
        assert len([x for x in heard if isinstance(x, m.StatusText) and "off the map" in x.text]) == count
        assert not [x for x in heard if isinstance(x, m.PositionSource)]


def test_act_switches_once_when_ours_is_good_and_back_with_trust() -> None:
    node = LinkNode(10.0, "act")
    watched(node, 20.0, right)
    heard = watched(node, 10.0, lambda t: (200.0, 0.0) if int(t) % 4 else None, begin_s=20.0)
    (there,) = [x for x in heard if isinstance(x, m.PositionSource)]
    assert there.vision
    assert there.t_ns / S - 20.0 < 1.5
    back = [x for x in watched(node, 100.0, right, begin_s=30.0) if isinstance(x, m.PositionSource)]
    assert [(x.vision, x.receiver) for x in back] == [(False, 0)]
    assert back[0].t_ns / S - 30.0 >= 59.0
    assert back[0].t_ns - there.t_ns >= BACK_NS


def test_nobody_is_switched_onto_an_estimate_that_has_no_fix() -> None:
    node = LinkNode(10.0, "act")
    watched(node, 20.0, right)
    heard: list[m.Message] = []
    for step in range(1200, 2000):  # no estimate any more: fix type 1
        heard += node.on(reading(step * 20 * MS, None)) if step % 10 == 0 else []
        heard += node.tick(step * 20 * MS)
    assert not [x for x in heard if isinstance(x, m.PositionSource)]


def test_before_arming_nothing_is_switched_and_a_start_without_fix_is_no_reason() -> None:
    disarmed = m.VehicleState(t_ns=0, source="mavlink", armed=False)
    node = LinkNode(10.0, "act")
    list(node.on(disarmed))
    assert not [x for x in watched(node, 20.0, lambda _: None) if isinstance(x, m.PositionSource)]
    starting = watched(LinkNode(10.0, "act"), 20.0, lambda t: right(t) if t > 1.0 else None)
    assert not [x for x in starting if isinstance(x, m.PositionSource)]


def test_one_honest_receiver_is_enough_to_stay() -> None:
    node = LinkNode(10.0, "act")
    heard: list[m.Message] = []
    for step in range(3000):
        now_ns = step * 20 * MS
        if step % 25 == 5:
            heard += node.on(estimate(now_ns - 100 * MS))
        if step % 10 == 0:
            heard += node.on(reading(now_ns, (1.0, 0.0)))
            heard += node.on(reading(now_ns, (300.0, 0.0) if step > 1500 else (0.0, 1.0), receiver=1))
        heard += node.tick(now_ns)
    assert {(x.receiver, x.state) for x in heard if isinstance(x, m.GnssVerdict)} >= {
        (0, GnssState.TRUSTED),
        (1, GnssState.SPOOFED),
    }
    assert not [x for x in heard if isinstance(x, m.PositionSource)]


# --- the wire ---


def gps_raw(**changes: Any) -> Any:
    fields = {"time_usec": 1, "fix_type": 3, "lat": 480_000_000, "lon": 110_000_000, "alt": 5, "eph": 80, "epv": 90}
    fields |= {"vel": 2000, "cog": 0, "satellites_visible": 14, "h_acc": 1300}
    return mavlink.MAVLink_gps_raw_int_message(**fields | changes)


def test_readings_have_units_and_know_what_is_not_known() -> None:
    known = reading_of(gps_raw(), 5)
    assert (known.receiver, known.fix_type, known.lat_deg, known.lon_deg) == (0, 3, 48.0, 11.0)
    assert (known.horizontal_m, known.speed_mps, known.satellites) == (1.3, 20.0, 14)
    blank = reading_of(gps_raw(fix_type=1, vel=65_535, satellites_visible=255, h_acc=0), 5)
    assert (blank.lat_deg, blank.horizontal_m, blank.speed_mps, blank.satellites) == (None, None, None, None)
    second = reading_of(mavlink.MAVLink_gps2_raw_message(1, 3, 1, 2, 3, 4, 5, 6, 7, 8, 0, 0), 5)
    assert second.receiver == 1


@pytest.mark.parametrize(("changes", "heard"), [({}, [1]), ({"gps_id": 1}, [0]), ({"outputs": ["odometry"]}, [0, 1])])
def test_the_receiver_that_is_we_ourselves_is_not_judged(changes: dict[str, Any], heard: list[int]) -> None:
    wire, autopilot = MemoryWire(), mavlink.MAVLink(None, 7, 1)
    edge = MavlinkEdge(msgspec.convert(changes, LinkSection), wire, lambda: 0)
    second = mavlink.MAVLink_gps2_raw_message(1, 3, 1, 2, 3, 4, 5, 6, 7, 8, 0, 0)
    wire.arrive(*(packed(message, autopilot) for message in (heartbeat(), gps_raw(), second)))
    assert [x.receiver for x in edge.poll(0) if isinstance(x, m.GnssReading)] == heard


def test_source_sets_are_asked_for_until_the_autopilot_agrees() -> None:
    wire, autopilot = MemoryWire(), mavlink.MAVLink(None, 7, 1)
    edge = MavlinkEdge(LinkSection(outputs=["odometry"]), wire, lambda: 0)
    wire.arrive(packed(heartbeat(), autopilot))
    list(edge.poll(0))
    edge.heard(m.PositionSource(t_ns=0, vision=True, receiver=0))

    def asked(second: int) -> list[float]:
        wire.arrive(packed(heartbeat(), autopilot))
        list(edge.poll(second * S))
        command = mavlink.MAV_CMD_SET_EKF_SOURCE_SET
        return [x.param1 for x in wire.take("COMMAND_LONG") if x.command == command]

    assert [asked(1), asked(2)] == [[2.0], [2.0]]
    wire.arrive(packed(mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 0), autopilot))
    list(edge.poll(2 * S + 1))
    assert [asked(3), asked(4)] == [[], []]
    edge.heard(m.PositionSource(t_ns=0, vision=False, receiver=0))
    assert [asked(second)[:1] for second in range(5, 10)] == [[1.0]] * 5  # and nobody answers
    wire.arrive(packed(heartbeat(), autopilot))
    (status,) = [x for x in edge.poll(11 * S) if isinstance(x, m.LinkStatus)]
    assert "did not switch" in status.detail


class RigWire(MemoryWire):
    """Between the real edge and the simulated autopilot, whose words the rig takes, too."""

    def __init__(self, rig: Rig) -> None:
        super().__init__()
        self._rig, transmit = rig, rig.autopilot.transmit

        def tapped() -> bytes:
            said = transmit()
            self.arrive(said)
            return said

        rig.autopilot.transmit = tapped  # type: ignore[method-assign]

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        self._rig.autopilot.receive(packet, self._rig.t_s)
        return True


def test_a_spoofed_autopilot_is_led_back_onto_the_map() -> None:
    """Two GPS: the real one jumps 20 m in flight, which the filter would take. GPS_INPUT is GPS2."""
    spoofed_at_s = 15.0
    away = FRAME.to_wgs84(0.0, 20.0)
    rig = Rig(
        Kind.COPTER,
        parameters=BESIDE_A_RECEIVER | {"GPS1_TYPE": 1.0, "GPS1_DELAY_MS": 5.0},
        real_gps=at_5_hz(lambda t: real_fix(*away) if t > spoofed_at_s else real_fix()),
    )
    edge = MavlinkEdge(LinkSection(gps_id=1, gnss="act"), RigWire(rig), lambda: 0)
    node = LinkNode(10.0, "act")
    heard: list[m.Message] = []
    for step in range(22 * 50):
        rig.fly(0.02)
        now_ns = round(rig.t_s * S)
        messages = list(edge.poll(now_ns))
        if step % 25 == 0:
            still = estimate(now_ns, velocity_enu_mps=(0.0, 0.0, 0.0), sigma_m=1.5)
            messages.append(msgspec.structs.replace(still, lat_deg=LAT, lon_deg=LON))
        for message in messages:
            for answer in node.on(message):
                heard.append(answer)
                edge.heard(answer)
        for answer in node.tick(now_ns):
            heard.append(answer)
            edge.heard(answer)
    assert rig.autopilot.used_gps == 1
    assert rig.autopilot.parameters["GPS_AUTO_SWITCH"] == 0.0
    assert rig.error_m() < 8.0
    assert [x.vision for x in heard if isinstance(x, m.PositionSource)] == [True]


# --- flights as messages ---


def test_honest_flights_give_no_alarm() -> None:
    told = fly(400.0, Vision(sigma_m=4.0, wander_s=20.0), (), seed=3)
    assert {state for _, state in told.states} <= {GnssState.UNKNOWN, GnssState.TRUSTED}


def test_the_table_counts() -> None:
    result = table(5, 6.0, seed=7)
    assert dict(result.flights) == {"clean": 1, "outage": 1, "jam": 1, "jump": 1, "drag": 1}
    rows = said(result)
    assert result.missed.total() == 0
    assert rows["jump_seconds"]["worst"] <= 1.0  # type: ignore[index]
    assert rows["outage_seconds"]["worst"] <= 2.0  # type: ignore[index]
