"""The checkpoint of the link: after a restart in flight the autopilot is known before its heartbeat."""

from pathlib import Path

from link_wire import WiredEdge, armed, attitude, heartbeat, states
from terrafix.estimator.prior import load_checkpoint
from terrafix.link.autopilot.checkpoint import ArmedAutopilot, LinkCheckpointWriter

S = 1_000_000_000


def restarted(file: Path, *heartbeats: object) -> WiredEdge:
    """-> a new link after one that has received these heartbeats and was not closed."""
    before = WiredEdge(checkpoint=file)
    for second, beat in enumerate(heartbeats):
        before.receives(second * S, beat)
    return WiredEdge(checkpoint=file)


def test_a_restarted_link_publishes_the_attitude_before_the_next_heartbeat(tmp_path: Path) -> None:
    link = restarted(tmp_path / "link.checkpoint", heartbeat(), armed())
    (state,) = states(link.receives(9 * S, attitude(1000)))
    assert state.armed is True and state.yaw_rad is not None


def test_without_a_checkpoint_no_attitude_is_published_before_a_heartbeat(tmp_path: Path) -> None:
    assert not states(restarted(tmp_path / "link.checkpoint").receives(9 * S, attitude(1000)))


def test_a_restored_armed_state_expires_without_heartbeats(tmp_path: Path) -> None:
    link = restarted(tmp_path / "link.checkpoint", armed())
    link.poll(9 * S)
    assert [state.armed for state in states(link.receives(30 * S, attitude(1000)))] == [None]


def test_the_checkpoint_is_deleted_when_the_autopilot_is_disarmed(tmp_path: Path) -> None:
    """It may have taken off since; a vehicle seen on the ground is assumed to be at the start of its flight."""
    link = restarted(tmp_path / "link.checkpoint", armed(), heartbeat())
    assert not (tmp_path / "link.checkpoint").exists()
    assert not states(link.receives(9 * S, attitude(1000)))


def test_an_unreadable_checkpoint_is_ignored(tmp_path: Path) -> None:
    for name, data in (("cut", b"\x85\xa8"), ("other", b'{"autopilot": 7}'), ("empty", b"")):
        (tmp_path / name).write_bytes(data)
        assert load_checkpoint(tmp_path / name) is None
        assert LinkCheckpointWriter(tmp_path / name).restored is None
    assert load_checkpoint(tmp_path / "none") is None and load_checkpoint(None) is None


def test_a_checkpoint_that_cannot_be_written_does_not_raise(tmp_path: Path) -> None:
    """For example when shared memory is full."""
    checkpoint_writer = LinkCheckpointWriter(tmp_path / "not there" / "link.checkpoint")
    checkpoint_writer.on_heartbeat(ArmedAutopilot(sysid=1, firmware=3, vehicle=1))
    checkpoint_writer.on_fix(None, 2.0)
    checkpoint_writer.on_heartbeat(None)
