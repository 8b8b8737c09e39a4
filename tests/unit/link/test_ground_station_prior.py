"""A hint from the ground: what is taken as one, what is answered; and when the operator is asked for one."""

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_rig import S, covariance, estimate, every, fly, texts
from link_wire import MemoryWire, attitude, heartbeat, packed
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.core.initial_position import SEARCHED_START_M
from terrafix.link.edge import MavlinkEdge
from terrafix.link.ground_station.position_prior import LEAST_RADIUS_M, RADIUS_M
from terrafix.link.ground_station.prior_request import AGAIN_NS, HINTED_NS, NOT_KNOWN_M, PriorRequest
from terrafix.link.node import LinkNode

LAT, LON = 48.1234567, 11.7654321
E7 = (round(LAT * 1e7), round(LON * 1e7))
STATION = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
OURS = (1, 197)
GCS = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)
ORIGIN_HERE = mavlink.MAVLink_set_gps_global_origin_message(1, *E7, 0)


class Side:
    """The link's edge on a wire in memory, and what it says of what a ground station sends."""

    def __init__(self, *, station: bool = True) -> None:
        """``station``: the sender has said in a heartbeat that it is a ground station."""
        self.wire = MemoryWire()
        self.edge = MavlinkEdge(LinkSection(), self.wire, lambda: 0)
        self.now_ns = S
        if station:
            self.receives(GCS)

    def receives(self, *messages: Any, sender: mavlink.MAVLink = STATION) -> list[m.PositionHint]:
        self.now_ns += S // 10
        self.wire.arrive(*(packed(x, sender) for x in messages))
        return [x for x in self.edge.poll(self.now_ns) if isinstance(x, m.PositionHint)]

    def answers(self) -> list[tuple[int, int]]:
        """(command, result) of every COMMAND_ACK to the ground station."""
        acks = [x for x in self.wire.take("COMMAND_ACK")]
        assert all((x.target_system, x.target_component) == (255, 190) for x in acks)
        return [(x.command, x.result) for x in acks]


def external(to: tuple[int, int] = OURS, place: tuple[int, int] = E7, sigma: float = 400.0, frame: int = 0) -> Any:
    command = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
    return mavlink.MAVLink_command_int_message(*to, frame, command, 0, 0, 5.0, 0.0, sigma, 0.0, *place, math.nan)


def test_a_command_to_our_component_is_a_hint_and_is_acknowledged() -> None:
    side = Side()
    (hint,) = side.receives(external())
    assert (hint.lat_deg, hint.lon_deg) == pytest.approx((LAT, LON), abs=1e-7)
    # 95 % of a round Gaussian: sqrt(-2 ln 0.05) of its sigma per axis
    assert hint.radius_m == pytest.approx(400.0 * math.sqrt(-2 * math.log(0.05)), rel=1e-4)
    assert (hint.source, hint.t_ns) == ("ground station 255", side.now_ns)
    assert side.answers() == [(mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, mavlink.MAV_RESULT_ACCEPTED)]


def test_the_long_form_of_custom_actions_is_taken_too() -> None:
    command = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
    (hint,) = Side().receives(mavlink.MAVLink_command_long_message(*OURS, command, 0, 0, 0, 0, 0, LAT, LON, 0))
    assert (hint.lat_deg, hint.lon_deg) == pytest.approx((LAT, LON), abs=1e-5)  # 32 bits: a metre
    assert hint.radius_m == RADIUS_M


@pytest.mark.parametrize("to", [(1, 1), (2, 197), (1, 191)])
def test_a_command_to_another_is_not_ours(to: tuple[int, int]) -> None:
    side = Side()
    assert side.receives(external(to)) == [] and side.answers() == []


@pytest.mark.parametrize(
    "bad",
    [
        external(place=(0, 0)),
        external(place=(910_000_000, 0)),
        external(place=(0, 1_810_000_000)),
        external(frame=mavlink.MAV_FRAME_LOCAL_NED),
    ],
)
def test_what_is_no_position_is_denied_and_said(bad: Any) -> None:
    side = Side()
    assert side.receives(bad) == []
    said = side.wire.take()
    assert [x.result for x in said if x.get_type() == "COMMAND_ACK"] == [mavlink.MAV_RESULT_DENIED]
    assert ["hint is no position" in x.text for x in said if x.get_type() == "STATUSTEXT"] == [True]


@pytest.mark.parametrize("sigma", [0.0, -3.0, math.nan, math.inf])
def test_an_accuracy_that_says_nothing_is_five_kilometres(sigma: float) -> None:
    assert Side().receives(external(sigma=sigma))[0].radius_m == RADIUS_M


def test_a_hint_is_never_better_than_a_finger_on_a_map() -> None:
    assert Side().receives(external(sigma=1.0))[0].radius_m == LEAST_RADIUS_M


def test_other_commands_to_our_component_are_refused_and_those_to_all_are_left_alone() -> None:
    side = Side()
    for component in (197, 0):
        side.receives(mavlink.MAVLink_command_long_message(1, component, 512, 0, *(0.0,) * 7))
    assert side.answers() == [(512, mavlink.MAV_RESULT_UNSUPPORTED)]


def test_an_origin_set_by_a_ground_station_is_a_hint() -> None:
    (hint,) = Side().receives(GCS, ORIGIN_HERE)
    assert (hint.lat_deg, hint.lon_deg) == pytest.approx((LAT, LON), abs=1e-7)
    assert hint.radius_m == RADIUS_M


def test_an_origin_set_by_a_companion_or_for_another_vehicle_is_none() -> None:
    side = Side(station=False)
    assert side.receives(ORIGIN_HERE) == []  # nobody said to be a ground station
    companion = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    assert side.receives(GCS) == [] and side.receives(ORIGIN_HERE, sender=companion) == []
    assert side.receives(mavlink.MAVLink_set_gps_global_origin_message(2, *E7, 0)) == []


def test_a_command_of_one_that_is_no_ground_station_is_denied() -> None:
    side = Side(station=False)
    assert side.receives(external()) == []
    assert side.answers() == [(mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, mavlink.MAV_RESULT_DENIED)]


def test_an_origin_for_the_autopilot_s_id_is_ours_too() -> None:
    side = Side()
    side.receives(heartbeat(), sender=mavlink.MAVLink(None, srcSystem=7, srcComponent=1))
    assert len(side.receives(GCS, mavlink.MAVLink_set_gps_global_origin_message(7, *E7, 0))) == 1


def test_the_same_hint_sent_again_is_one_hint_and_two_acknowledgements() -> None:
    side = Side()
    assert len(side.receives(external(), external())) == 1
    assert len(side.answers()) == 2
    side.now_ns += 4 * S
    assert len(side.receives(external())) == 1


# --- asking ---


def test_it_asks_beyond_what_is_searched_on_the_map() -> None:
    assert NOT_KNOWN_M == SEARCHED_START_M


def asked_s(
    sigma_m: float, *, rate_hz: float = 2.0, until_s: int = 100, events: dict[int, m.Message] | None = None
) -> Any:
    """Seconds at which a link that hears such estimates asks, with the words."""
    node, found = LinkNode(10.0), []
    feed = every(round(S / rate_hz), lambda t_ns: estimate(t_ns, cov=covariance(sigma_m)))
    for second in range(until_s):
        if events and second in events:
            list(node.on(events[second]))
        said = fly(node, second * S, (second + 1) * S, feed)
        found += [(second, text) for text in texts(said) if "hint" in text]
    return found


def test_who_knows_its_place_does_not_ask() -> None:
    assert asked_s(90.0) == []


def test_who_does_not_asks_after_two_seconds_and_three_frames_and_seldom_again() -> None:
    found = asked_s(1000.0)
    assert [second for second, _ in found] == [2, 32, 62, 92]
    assert {text for _, text in found} == {"Terrafix: lost, send a position hint"}
    assert [second for second, _ in asked_s(1000.0, rate_hz=0.2, until_s=20)] == [10]  # the third frame


def test_when_the_whole_map_was_searched_it_says_so() -> None:
    step = m.SearchState(t_ns=0, step=m.SearchStep.ASK)
    assert asked_s(1000.0, until_s=5, events={0: step})[0][1] == "Terrafix: whole map searched, send a hint"


def verdict(t_ns: int, kind: m.Verdict = m.Verdict.ACCEPTED) -> m.HintVerdict:
    return m.HintVerdict(t_ns=t_ns, hint_t_ns=t_ns, verdict=kind, distance_m=1.0, sigma_m=1.0, text="hint taken")


def test_a_hint_that_was_taken_gives_the_search_its_time() -> None:
    seconds = [second for second, _ in asked_s(1000.0, events={10: verdict(10 * S)}, until_s=120)]
    assert seconds == [2, 70, 100]
    assert (HINTED_NS, AGAIN_NS) == (60 * S, 30 * S)


def test_what_became_of_a_hint_is_read_by_the_pilot() -> None:
    node = LinkNode(10.0)
    (said,) = node.on(verdict(S))
    assert isinstance(said, m.StatusText) and (said.text, said.severity) == ("Terrafix: hint taken", 6)
    (said,) = node.on(verdict(S, m.Verdict.INNOVATION))
    assert isinstance(said, m.StatusText) and said.severity == 4


def test_a_vehicle_that_is_not_armed_is_not_lost() -> None:
    standing = m.VehicleState(t_ns=0, source="mavlink", armed=False)
    assert asked_s(1000.0, until_s=10, events={0: standing}) == []


def test_an_estimator_that_has_fallen_silent_is_another_matter() -> None:
    asking = PriorRequest()
    for frame in range(4):
        asking.estimate(estimate(frame * S, cov=covariance(1000.0)))
    assert asking.due(4 * S) and not asking.due(4 * S)
    assert asking.due(40 * S) == ""


# --- started again in flight ---


def position(boot_ms: int, lat_deg: float, lon_deg: float, above_m: float = 100.0) -> Any:
    place = (round(lat_deg * 1e7), round(lon_deg * 1e7))
    return mavlink.MAVLink_global_position_int_message(boot_ms, *place, 600_000, round(above_m * 1e3), 0, 0, 0, 0)


class Restarted:
    """Edge and node that begin beside an autopilot that is in the air, and believes to be at LAT, LON."""

    def __init__(self, *, armed: bool = True) -> None:
        self.wire, self.node = MemoryWire(), LinkNode(10.0)
        self.edge = MavlinkEdge(LinkSection(), self.wire, lambda: 0)
        self._autopilot = mavlink.MAVLink(None, 1, 1)
        self._beat = heartbeat()
        self._beat.base_mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
        self.seconds = 0

    def hints(self, seconds: int, *, anchor_age_ms: int | None = -1, above_m: float = 100.0) -> list[m.PositionHint]:
        """``anchor_age_ms`` of estimates every half second; None: there are none yet."""
        found: list[m.PositionHint] = []
        for step in range(self.seconds * 50, (self.seconds + seconds) * 50):
            now_ns = step * S // 50
            if step % 25 == 0:
                boot_ms = now_ns // 10**6
                said = (self._beat, attitude(boot_ms), position(boot_ms, LAT, LON, above_m))
                self.wire.arrive(*(packed(x, self._autopilot) for x in said))
                if anchor_age_ms is not None:
                    list(self.node.on(estimate(now_ns, late_ns=0, anchor_age_ms=anchor_age_ms)))
            for message in self.edge.poll(now_ns):
                list(self.node.on(message))
                found += [message] if isinstance(message, m.PositionHint) else []
            for message in self.node.tick(now_ns):
                self.edge.heard(message)
        self.seconds += seconds
        return found


def test_after_a_restart_in_flight_the_search_begins_where_the_autopilot_is() -> None:
    flying = Restarted()
    assert flying.hints(5, anchor_age_ms=None) == []  # the others are still starting, and would not hear it
    (hint,) = flying.hints(10)
    assert (hint.lat_deg, hint.lon_deg, hint.radius_m) == pytest.approx((LAT, LON, 300.0), abs=1e-7)
    assert hint.source == "autopilot"
    assert len(flying.hints(120)) == 2  # and no more than three


def test_no_hint_of_the_autopilot_when_it_is_not_needed() -> None:
    assert Restarted().hints(10, anchor_age_ms=0) == []  # the link alone was started again
    assert Restarted(armed=False).hints(10) == []
    assert Restarted().hints(10, above_m=5.0) == []
