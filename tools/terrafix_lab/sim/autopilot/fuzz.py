"""Fuzz test of the link on a bad wire: damaged, lost, duplicated and reordered packets, and random bytes between them.

A vehicle flies straight; its autopilot's telemetry reaches the link's edge and node over the bad wire, estimates over
a good one. Nothing may crash, and the sent positions must stay correct.

    python -m terrafix_lab.sim.autopilot.fuzz --bytes 10000000 --seconds 600
    python -m terrafix_lab.sim.autopilot.fuzz --seconds 3600 --loss 0.2 --double 0.1 --late 0.1
"""

import argparse
import json
import random
import sys
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path

from terrafix.core.config import LinkSection
from terrafix.link.edge import MavlinkEdge
from terrafix.link.integrity.output_predictor import distance_m, offset
from terrafix.link.node import TICK_HZ, LinkNode
from terrafix.messages import GpsInput, Message, NavEstimate, VehicleState
from terrafix_lab.sim.autopilot.fuzz_wire import (
    KEY,
    MS,
    PITCH,
    ROLL,
    UNIX_NS,
    YAW,
    BadWire,
    FuzzedAutopilot,
    add_garbage,
    split,
    transmit,
)
from terrafix_lab.sim.closed_loop.loopback import Loopback
from terrafix_lab.sim.true_messages import estimate
from terrafix_tools.in_process import InProcessShell

S = 1_000_000_000
STEP_NS = round(S / TICK_HZ)
LAT, LON, EAST_MPS = 48.0, 11.0, 20.0


@dataclass
class FuzzResult:
    """``wrong``: 3D fixes more than 5 m from the truth; ``false_states``: attitudes that were not sent."""

    bytes: int = 0
    packets_taken: int = 0
    bytes_skipped: int = 0
    refused: int = 0
    sent: int = 0
    sent_3d: int = 0
    wrong: int = 0
    worst_m: float = 0.0
    longest_gap_ms: float = 0.0
    states: int = 0
    false_states: int = 0
    seconds: float = 0.0
    wire: dict[str, float] = field(default_factory=dict)


def fuzz(wire: BadWire, seconds: float, *, seed: int = 1, signed: bool = False) -> FuzzResult:
    """Simulates a flight of ``seconds``."""
    with tempfile.TemporaryDirectory() as folder:
        key = Path(folder) / "key"
        key.touch(mode=0o600)
        key.write_bytes(KEY)
        loopback = Loopback()
        edge = MavlinkEdge(LinkSection(signing_key=str(key) if signed else ""), loopback, lambda: UNIX_NS)
    published: list[Message] = []
    shell = InProcessShell({"link": LinkNode(10.0)}, lambda _, message: published.append(message), edges={"link": edge})
    autopilot, rng = FuzzedAutopilot(signed), random.Random(seed)
    result = FuzzResult(seconds=seconds, wire=asdict(wire))
    steps = round(seconds * TICK_HZ)
    delayed: list[bytes] = []
    last_sent_ns: int | None = None
    for step in range(steps):
        now_ns = step * STEP_NS
        telemetry = autopilot.packets(step, now_ns, loopback.take())
        arriving, delayed = transmit(wire, telemetry, delayed, rng)
        garbage = wire.garbage_bytes * (step + 1) // steps - wire.garbage_bytes * step // steps
        chunk = add_garbage(arriving, garbage, autopilot.examples, rng)
        result.bytes += len(chunk)
        for piece in split(chunk, rng):
            loopback.to_companion(piece)
        if step % 25 == 5:
            shell.feed(_estimate(now_ns - 100 * MS, now_ns))
        shell.step(now_ns)
        for message in published:
            if isinstance(message, VehicleState):
                result.states += 1
                result.false_states += not _true_state(message)
            elif isinstance(message, GpsInput):
                _check_output(message, result)
                if last_sent_ns is not None:
                    result.longest_gap_ms = max(result.longest_gap_ms, (now_ns - last_sent_ns) / MS)
                last_sent_ns = now_ns
        published.clear()
    status = edge.status.snapshot(steps * STEP_NS)
    result.packets_taken, result.bytes_skipped, result.refused = status.received, status.bad, status.refused
    return result


def _estimate(t_ns: int, emitted_ns: int) -> NavEstimate:
    lat, lon = offset(LAT, LON, EAST_MPS * t_ns / S, 0.0)
    return estimate(
        t_ns, lat, lon, sigmas=(3.0, 3.0, 0.0), velocity_enu_mps=(EAST_MPS, 0.0, 0.0), emitted_at_ns=emitted_ns
    )


def _true_state(state: VehicleState) -> bool:
    attitude = (state.yaw_rad, state.pitch_rad, state.roll_rad)
    return all(a is not None and abs(a - b) < 1e-6 for a, b in zip(attitude, (YAW, PITCH, ROLL), strict=True))


def _check_output(output: GpsInput, result: FuzzResult) -> None:
    result.sent += 1
    if output.fix_type != 3:
        return
    result.sent_3d += 1
    error_m = distance_m(output.lat_deg, output.lon_deg, *offset(LAT, LON, EAST_MPS * output.t_ns / S, 0.0))
    result.wrong += not error_m < 5.0
    result.worst_m = max(result.worst_m, error_m)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--bytes", type=int, default=0, help="of garbage")
    parser.add_argument("--seconds", type=float, default=60.0)
    for name in ("loss", "double", "late"):
        parser.add_argument(f"--{name}", type=float, default=0.0, help="share of packets")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--signed", action="store_true", help="with MAVLink 2 signing")
    args = parser.parse_args()
    wire = BadWire(args.bytes, args.loss, args.double, args.late)
    result = fuzz(wire, args.seconds, seed=args.seed, signed=args.signed)
    sys.stdout.write(json.dumps(asdict(result), indent=2) + "\n")
    return int(result.wrong > 0 or (args.signed and result.false_states > 0))


if __name__ == "__main__":
    sys.exit(main())
