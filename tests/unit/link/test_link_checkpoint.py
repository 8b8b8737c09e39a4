"""A link that is started in a flight knows the autopilot that the one before it served."""

from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_wire import MemoryWire, attitude, packed, states
from terrafix.core.config import LinkSection
from terrafix.estimator.prior import load_checkpoint
from terrafix.link.autopilot.checkpoint import ArmedAutopilot, CheckpointWriter
from terrafix.link.edge import MavlinkEdge

S = 1_000_000_000
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED


def heartbeat(mode: int) -> object:
    plane, ardupilot = mavlink.MAV_TYPE_FIXED_WING, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    return mavlink.MAVLink_heartbeat_message(plane, ardupilot, mode, 0, mavlink.MAV_STATE_ACTIVE, 3)


def link(kept: Path) -> tuple[MavlinkEdge, MemoryWire]:
    wire = MemoryWire()
    return MavlinkEdge(LinkSection(), wire, lambda: 0, keeper=CheckpointWriter(kept)), wire


def served(kept: Path, *modes: int) -> None:
    """One link hears these heartbeats, and is killed."""
    edge, wire = link(kept)
    mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    for second, mode in enumerate(modes):
        wire.arrive(packed(heartbeat(mode), mav))
        list(edge.poll(second * S))


def test_it_says_the_attitude_before_the_next_heartbeat(tmp_path: Path) -> None:
    kept = tmp_path / "link.checkpoint"
    served(kept, 0, ARMED)
    edge, wire = link(kept)
    mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    wire.arrive(packed(attitude(1000), mav))
    (state,) = states(edge.poll(9 * S))
    assert state.armed is True and state.yaw_rad is not None


def test_without_it_the_heartbeat_is_waited_for(tmp_path: Path) -> None:
    edge, wire = link(tmp_path / "link.checkpoint")
    wire.arrive(packed(attitude(1000), mavlink.MAVLink(None, srcSystem=7, srcComponent=1)))
    assert not states(edge.poll(9 * S))


def test_one_that_does_not_come_back_is_not_believed_for_long(tmp_path: Path) -> None:
    kept = tmp_path / "link.checkpoint"
    served(kept, ARMED)
    edge, wire = link(kept)
    list(edge.poll(9 * S))
    wire.arrive(packed(attitude(1000), mavlink.MAVLink(None, srcSystem=7, srcComponent=1)))
    assert [state.armed for state in states(edge.poll(30 * S))] == [None]


def test_an_autopilot_that_stands_is_not_kept(tmp_path: Path) -> None:
    """It may have taken off meanwhile; a vehicle that was seen on the ground is where its flight begins."""
    kept = tmp_path / "link.checkpoint"
    served(kept, ARMED, 0)
    assert not kept.exists()
    edge, wire = link(kept)
    wire.arrive(packed(attitude(1000), mavlink.MAVLink(None, srcSystem=7, srcComponent=1)))
    assert not states(edge.poll(9 * S))


def test_what_cannot_be_read_is_begun_without(tmp_path: Path) -> None:
    for name, data in (("cut", b"\x85\xa8"), ("other", b'{"autopilot": 7}'), ("empty", b"")):
        (tmp_path / name).write_bytes(data)
        assert load_checkpoint(tmp_path / name) is None
        assert CheckpointWriter(tmp_path / name).found is None
    assert load_checkpoint(tmp_path / "none") is None and load_checkpoint(None) is None


def test_nobody_dies_for_what_the_next_one_would_like_to_know(tmp_path: Path) -> None:
    """Shared memory is full."""
    keeper = CheckpointWriter(tmp_path / "not there" / "link.checkpoint")
    keeper.heard(ArmedAutopilot(sysid=1, firmware=3, vehicle=1))
    keeper.flies(None, 2.0)
    keeper.heard(None)
