"""Hints from ground stations: which messages count as one, their replies, and when a hint is requested."""

import math
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_rig import S, covariance, estimate, every, fly, texts
from link_wire import WiredEdge, armed, attitude, heartbeat, station_heartbeat
from terrafix import messages as m
from terrafix.core.initial_position import SEARCH_START_SIGMA_M
from terrafix.link.ground_station.position_prior import DEFAULT_RADIUS_M, MIN_RADIUS_M
from terrafix.link.ground_station.prior_request import HOLD_OFF_NS, REPEAT_NS, UNKNOWN_POSITION_SIGMA_M, PriorRequest
from terrafix.link.node import LinkNode

LAT, LON = 48.1234567, 11.7654321
E7 = (round(LAT * 1e7), round(LON * 1e7))
STATION = (255, 190)
OURS = (1, 197)
GCS = station_heartbeat()
SET_ORIGIN = mavlink.MAVLink_set_gps_global_origin_message(1, *E7, 0)


class LinkSide:
    """The link's edge on a wire in memory, with messages from a ground station."""

    def __init__(self, *, station: bool = True) -> None:
        """``station``: the sender has sent the heartbeat of a ground station."""
        self._link = WiredEdge()
        self.wire, self.now_ns = self._link.wire, S
        if station:
            self.receives(GCS)

    def receives(self, *messages: Any, sender: tuple[int, int] = STATION) -> list[m.PositionHint]:
        """``sender``: system and component."""
        self.now_ns += S // 10
        published = self._link.receives(self.now_ns, *messages, sysid=sender[0], compid=sender[1])
        return [x for x in published if isinstance(x, m.PositionHint)]

    def replies(self) -> list[tuple[int, int]]:
        """(command, result) of every COMMAND_ACK to the ground station."""
        acks = self.wire.take("COMMAND_ACK")
        assert all((x.target_system, x.target_component) == (255, 190) for x in acks)
        return [(x.command, x.result) for x in acks]


def external(to: tuple[int, int] = OURS, place: tuple[int, int] = E7, sigma: float = 400.0, frame: int = 0) -> Any:
    command = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
    return mavlink.MAVLink_command_int_message(*to, frame, command, 0, 0, 5.0, 0.0, sigma, 0.0, *place, math.nan)


def test_a_position_command_to_our_component_is_a_hint_and_is_acknowledged() -> None:
    side = LinkSide()
    (hint,) = side.receives(external())
    assert (hint.lat_deg, hint.lon_deg) == pytest.approx((LAT, LON), abs=1e-7)
    # 95 % of a round Gaussian: sqrt(-2 ln 0.05) of its sigma per axis
    assert hint.radius_m == pytest.approx(400.0 * math.sqrt(-2 * math.log(0.05)), rel=1e-4)
    assert (hint.source, hint.t_ns) == ("ground station 255", side.now_ns)
    assert side.replies() == [(mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, mavlink.MAV_RESULT_ACCEPTED)]


def test_a_hint_as_command_long_of_a_custom_action_is_accepted() -> None:
    command = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
    (hint,) = LinkSide().receives(mavlink.MAVLink_command_long_message(*OURS, command, 0, 0, 0, 0, 0, LAT, LON, 0))
    assert (hint.lat_deg, hint.lon_deg) == pytest.approx((LAT, LON), abs=1e-5)  # float32: one metre
    assert hint.radius_m == DEFAULT_RADIUS_M


@pytest.mark.parametrize("to", [(1, 1), (2, 197), (1, 191)])
def test_a_position_command_to_another_component_is_ignored(to: tuple[int, int]) -> None:
    side = LinkSide()
    assert side.receives(external(to)) == [] and side.replies() == []


@pytest.mark.parametrize(
    "bad",
    [
        external(place=(0, 0)),
        external(place=(910_000_000, 0)),
        external(place=(0, 1_810_000_000)),
        external(frame=mavlink.MAV_FRAME_LOCAL_NED),
    ],
)
def test_a_hint_without_a_valid_position_is_denied_with_a_text(bad: Any) -> None:
    side = LinkSide()
    assert side.receives(bad) == []
    published = side.wire.take()
    assert [x.result for x in published if x.get_type() == "COMMAND_ACK"] == [mavlink.MAV_RESULT_DENIED]
    assert ["hint is no position" in x.text for x in published if x.get_type() == "STATUSTEXT"] == [True]


@pytest.mark.parametrize("sigma", [0.0, -3.0, math.nan, math.inf])
def test_a_hint_without_a_valid_accuracy_has_a_radius_of_five_kilometres(sigma: float) -> None:
    assert LinkSide().receives(external(sigma=sigma))[0].radius_m == DEFAULT_RADIUS_M


def test_the_radius_of_a_hint_has_a_lower_limit() -> None:
    assert LinkSide().receives(external(sigma=1.0))[0].radius_m == MIN_RADIUS_M


def test_other_commands_to_our_component_are_unsupported_and_broadcast_commands_are_ignored() -> None:
    side = LinkSide()
    for component in (197, 0):
        side.receives(mavlink.MAVLink_command_long_message(1, component, 512, 0, *(0.0,) * 7))
    assert side.replies() == [(512, mavlink.MAV_RESULT_UNSUPPORTED)]


def test_an_origin_set_by_a_ground_station_is_a_hint() -> None:
    (hint,) = LinkSide().receives(GCS, SET_ORIGIN)
    assert (hint.lat_deg, hint.lon_deg) == pytest.approx((LAT, LON), abs=1e-7)
    assert hint.radius_m == DEFAULT_RADIUS_M


def test_an_origin_set_by_a_companion_or_for_another_vehicle_is_not_a_hint() -> None:
    side = LinkSide(station=False)
    assert side.receives(SET_ORIGIN) == []  # no heartbeat of a ground station before
    assert side.receives(GCS) == [] and side.receives(SET_ORIGIN, sender=(1, 191)) == []
    assert side.receives(mavlink.MAVLink_set_gps_global_origin_message(2, *E7, 0)) == []


def test_a_hint_from_a_sender_that_is_not_a_ground_station_is_denied() -> None:
    side = LinkSide(station=False)
    assert side.receives(external()) == []
    assert side.replies() == [(mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, mavlink.MAV_RESULT_DENIED)]


def test_an_origin_addressed_to_the_autopilot_s_system_id_is_a_hint() -> None:
    side = LinkSide()
    side.receives(heartbeat(), sender=(7, 1))
    assert len(side.receives(GCS, mavlink.MAVLink_set_gps_global_origin_message(7, *E7, 0))) == 1


def test_a_repeated_hint_counts_once_and_is_acknowledged_twice() -> None:
    side = LinkSide()
    assert len(side.receives(external(), external())) == 1
    assert len(side.replies()) == 2
    side.now_ns += 4 * S
    assert len(side.receives(external())) == 1


# --- requests ---


def test_a_hint_is_requested_at_the_sigma_at_which_the_map_is_searched() -> None:
    assert UNKNOWN_POSITION_SIGMA_M == SEARCH_START_SIGMA_M


def requests(
    sigma_m: float, *, rate_hz: float = 2.0, until_s: int = 100, events: dict[int, m.Message] | None = None
) -> Any:
    """-> (second, text) of each request of a link that gets estimates with this sigma."""
    node, found = LinkNode(10.0), []
    feed = every(round(S / rate_hz), lambda t_ns: estimate(t_ns, cov=covariance(sigma_m)))
    for second in range(until_s):
        if events and second in events:
            list(node.on(events[second]))
        published = fly(node, second * S, (second + 1) * S, feed)
        found += [(second, text) for text in texts(published) if "hint" in text]
    return found


def test_no_hint_is_requested_while_the_position_is_known() -> None:
    assert requests(90.0) == []


def test_a_hint_is_requested_after_two_seconds_and_three_frames_and_then_every_thirty_seconds() -> None:
    found = requests(1000.0)
    assert [second for second, _ in found] == [2, 32, 62, 92]
    assert {text for _, text in found} == {"Terrafix: lost, send a position hint"}
    assert [second for second, _ in requests(1000.0, rate_hz=0.2, until_s=20)] == [10]  # the third frame


def test_the_request_states_that_the_whole_map_was_searched() -> None:
    step = m.SearchState(t_ns=0, step=m.SearchStep.ASK)
    assert requests(1000.0, until_s=5, events={0: step})[0][1] == "Terrafix: whole map searched, send a hint"


def verdict(t_ns: int, kind: m.Verdict = m.Verdict.ACCEPTED) -> m.HintVerdict:
    return m.HintVerdict(t_ns=t_ns, hint_t_ns=t_ns, verdict=kind, distance_m=1.0, sigma_m=1.0, text="hint taken")


def test_no_hint_is_requested_for_a_minute_after_an_accepted_hint() -> None:
    seconds = [second for second, _ in requests(1000.0, events={10: verdict(10 * S)}, until_s=120)]
    assert seconds == [2, 70, 100]
    assert (HOLD_OFF_NS, REPEAT_NS) == (60 * S, 30 * S)


def test_the_verdict_on_a_hint_is_reported_to_the_pilot() -> None:
    node = LinkNode(10.0)
    (published,) = node.on(verdict(S))
    assert isinstance(published, m.StatusText) and (published.text, published.severity) == ("Terrafix: hint taken", 6)
    (published,) = node.on(verdict(S, m.Verdict.INNOVATION))
    assert isinstance(published, m.StatusText) and published.severity == 4


def test_no_hint_is_requested_while_the_vehicle_is_disarmed() -> None:
    standing = m.VehicleState(t_ns=0, source="mavlink", armed=False)
    assert requests(1000.0, until_s=10, events={0: standing}) == []


def unanchored_request_s(anchored_s: int, *, speed_mps: float = 20.0, until_s: int = 600) -> tuple[int | None, str]:
    """A flight of accurate estimates, one a second, whose map fixes end at ``anchored_s``. -> seconds from there to
    the first request, and its text."""
    request = PriorRequest()
    for second in range(until_s):
        age_ms = 1000 * max(second - anchored_s, 0) if anchored_s >= 0 else -1
        known = estimate(second * S, frame_id=second, cov=covariance(5.0), anchor_age_ms=age_ms)
        request.on_estimate(msgspec.structs.replace(known, velocity_enu_mps=(0.6 * speed_mps, 0.8 * speed_mps, 1.0)))
        if text := request.due(second * S):
            return second - max(anchored_s, 0), text
    return None, ""


@pytest.mark.parametrize(("anchored_s", "after_s"), [(12, 5), (36, 9), (200, 50), (-1, 5), (1000, None)])
def test_a_hint_is_requested_after_a_fifth_of_the_route_without_a_map_fix(anchored_s: int, after_s: int | None) -> None:
    asked_s, text = unanchored_request_s(anchored_s)
    assert asked_s == after_s
    assert text == ("" if after_s is None else f"dead reckoning for {0.02 * after_s:.1f} km, send a hint")


def test_a_hint_is_requested_after_two_kilometres_without_a_map_fix_on_any_route() -> None:
    assert unanchored_request_s(3000, until_s=4000)[0] == 100
    assert unanchored_request_s(3000, speed_mps=10.0, until_s=4000)[0] == 200


def test_rounding_of_the_age_of_a_map_fix_is_not_taken_for_a_new_one() -> None:
    request, asked_s = PriorRequest(), None
    for frame in range(3000):
        t_ns = round(frame * S / 7.29)
        fixed_ns = min(t_ns, 200 * S)
        known = estimate(t_ns, frame_id=frame, cov=covariance(5.0), anchor_age_ms=(t_ns - fixed_ns) // 1_000_000)
        request.on_estimate(known)
        asked_s = asked_s or (t_ns / S if request.due(t_ns) else None)
    assert asked_s == pytest.approx(250.0, abs=0.3)  # a fifth of the route at a constant speed


def test_no_hint_is_requested_before_a_vehicle_has_moved() -> None:
    assert unanchored_request_s(5, speed_mps=0.0) == (None, "")


def test_no_hint_is_requested_when_estimates_have_stopped() -> None:
    request = PriorRequest()
    for frame in range(4):
        request.on_estimate(estimate(frame * S, cov=covariance(1000.0)))
    assert request.due(4 * S) and not request.due(4 * S)
    assert request.due(40 * S) == ""


# --- restart in flight ---


def position(boot_ms: int, lat_deg: float, lon_deg: float, above_m: float = 100.0) -> Any:
    place = (round(lat_deg * 1e7), round(lon_deg * 1e7))
    return mavlink.MAVLink_global_position_int_message(boot_ms, *place, 600_000, round(above_m * 1e3), 0, 0, 0, 0)


class Restarted:
    """Edge and node that start while the autopilot is in the air, with its position at LAT, LON."""

    def __init__(self, *, flies: bool = True) -> None:
        self._link, self._node = WiredEdge(), LinkNode(10.0)
        self._beat = armed() if flies else heartbeat()
        self._seconds = 0

    def hints(self, seconds: int, *, anchor_age_ms: int | None = -1, above_m: float = 100.0) -> list[m.PositionHint]:
        """-> hints in the next ``seconds``. ``anchor_age_ms``: of estimates every half second; None: no estimates."""
        found: list[m.PositionHint] = []
        for step in range(self._seconds * 50, (self._seconds + seconds) * 50):
            now_ns, telemetry = step * S // 50, list[Any]()
            if step % 25 == 0:
                boot_ms = now_ns // 10**6
                telemetry = [self._beat, attitude(boot_ms), position(boot_ms, LAT, LON, above_m)]
                if anchor_age_ms is not None:
                    list(self._node.on(estimate(now_ns, late_ns=0, anchor_age_ms=anchor_age_ms)))
            for message in self._link.receives(now_ns, *telemetry, sysid=1):
                list(self._node.on(message))
                found += [message] if isinstance(message, m.PositionHint) else []
            for message in self._node.tick(now_ns):
                self._link.edge.on_message(message)
        self._seconds += seconds
        return found


def test_after_a_restart_in_flight_the_position_of_the_autopilot_is_a_hint() -> None:
    flying = Restarted()
    assert flying.hints(5, anchor_age_ms=None) == []  # the other processes are still starting
    (hint,) = flying.hints(10)
    assert (hint.lat_deg, hint.lon_deg, hint.radius_m) == pytest.approx((LAT, LON, 300.0), abs=1e-7)
    assert hint.source == "autopilot"
    assert len(flying.hints(120)) == 2  # three in total


def test_no_hint_from_the_autopilot_with_a_map_fix_or_disarmed_or_near_the_ground() -> None:
    assert Restarted().hints(10, anchor_age_ms=0) == []  # only the link was restarted
    assert Restarted(flies=False).hints(10) == []
    assert Restarted().hints(10, above_m=5.0) == []
