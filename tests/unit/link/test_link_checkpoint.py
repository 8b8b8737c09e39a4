"""The checkpoint of the link: after a restart in flight the autopilot is known before its heartbeat."""

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


def link(checkpoint_file: Path) -> tuple[MavlinkEdge, MemoryWire]:
    wire = MemoryWire()
    return MavlinkEdge(LinkSection(), wire, lambda: 0, checkpoint_writer=CheckpointWriter(checkpoint_file)), wire


def run_link(checkpoint_file: Path, *modes: int) -> None:
    """Runs a link that receives heartbeats with these base modes; it is not closed."""
    edge, wire = link(checkpoint_file)
    mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    for second, mode in enumerate(modes):
        wire.arrive(packed(heartbeat(mode), mav))
        list(edge.poll(second * S))


def test_a_restarted_link_publishes_the_attitude_before_the_next_heartbeat(tmp_path: Path) -> None:
    checkpoint_file = tmp_path / "link.checkpoint"
    run_link(checkpoint_file, 0, ARMED)
    edge, wire = link(checkpoint_file)
    mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    wire.arrive(packed(attitude(1000), mav))
    (state,) = states(edge.poll(9 * S))
    assert state.armed is True and state.yaw_rad is not None


def test_without_a_checkpoint_no_attitude_is_published_before_a_heartbeat(tmp_path: Path) -> None:
    edge, wire = link(tmp_path / "link.checkpoint")
    wire.arrive(packed(attitude(1000), mavlink.MAVLink(None, srcSystem=7, srcComponent=1)))
    assert not states(edge.poll(9 * S))


def test_a_restored_armed_state_expires_without_heartbeats(tmp_path: Path) -> None:
    checkpoint_file = tmp_path / "link.checkpoint"
    run_link(checkpoint_file, ARMED)
    edge, wire = link(checkpoint_file)
    list(edge.poll(9 * S))
    wire.arrive(packed(attitude(1000), mavlink.MAVLink(None, srcSystem=7, srcComponent=1)))
    assert [state.armed for state in states(edge.poll(30 * S))] == [None]


def test_the_checkpoint_is_deleted_when_the_autopilot_is_disarmed(tmp_path: Path) -> None:
    """It may have taken off since; a vehicle seen on the ground is assumed to be at the start of its flight."""
    checkpoint_file = tmp_path / "link.checkpoint"
    run_link(checkpoint_file, ARMED, 0)
    assert not checkpoint_file.exists()
    edge, wire = link(checkpoint_file)
    wire.arrive(packed(attitude(1000), mavlink.MAVLink(None, srcSystem=7, srcComponent=1)))
    assert not states(edge.poll(9 * S))


def test_an_unreadable_checkpoint_is_ignored(tmp_path: Path) -> None:
    for name, data in (("cut", b"\x85\xa8"), ("other", b'{"autopilot": 7}'), ("empty", b"")):
        (tmp_path / name).write_bytes(data)
        assert load_checkpoint(tmp_path / name) is None
        assert CheckpointWriter(tmp_path / name).restored is None
    assert load_checkpoint(tmp_path / "none") is None and load_checkpoint(None) is None


def test_a_checkpoint_that_cannot_be_written_does_not_raise(tmp_path: Path) -> None:
    """For example when shared memory is full."""
    checkpoint_writer = CheckpointWriter(tmp_path / "not there" / "link.checkpoint")
    checkpoint_writer.on_heartbeat(ArmedAutopilot(sysid=1, firmware=3, vehicle=1))
    checkpoint_writer.on_fix(None, 2.0)
    checkpoint_writer.on_heartbeat(None)
