"""Which of several vehicles carries the camera: the one whose attitude turns as the images do.

The comparison is that of the time offset (``TurnComparison``), for each vehicle. Several vehicles may turn alike for a
while (two planes that circle, a copy of the telemetry by a forger), so one is confirmed only where no other explains
the turns nearly as well. A vehicle alone is compared as well: once confirmed it stays so, whoever appears later."""

import math

import numpy as np

from terrafix.core.camera import Mount
from terrafix.estimator.integrity.turn_comparison import Turn, TurnComparison
from terrafix.estimator.measurements.telemetry_buffer import Attitude, Telemetry
from terrafix.estimator.monitors.visual_motion import image_turn
from terrafix.messages import Camera, CameraVehicle, CandidateAttitude, Odometry, ServedVehicle, VehicleState, Verdict

# Only what turns is compared: straight flight is the same for all.
TURN_SPAN_NS = 500_000_000  # shortest time over which turns between frames are summed [measured: docs/decisions/052]
MIN_TURN_RATE_RADPS = math.radians(4.0)  # of a turn that is compared [measured: docs/decisions/052]
# without a turn, after which the next one is another manoeuvre [measured: docs/decisions/052]
TURN_PAUSE_NS = 3_000_000_000
# An attitude turns as the images do: log of the likelihood ratio, all together and of a single turn (19 of 20 parts of
# their mean square are explained), and manoeuvres, of which two may coincide by chance. With a camera on a vehicle that
# is not on the link, of 120 vehicles there that turn otherwise 2 were confirmed in 300 s, both of them circling.
MIN_EVIDENCE = 12.0  # [measured: docs/decisions/052]
MIN_TURN_EVIDENCE = math.log(20.0)  # [measured: docs/decisions/052]
MIN_MANOEUVRES = 3  # [measured: docs/decisions/052]
# of the best evidence; another vehicle below it does not turn as the images do [measured: docs/decisions/052]
OTHER_SHARE = 0.5


class _Vehicle:
    """One vehicle: its attitude, and the comparison with the turns of the images. These are by the images and its tilt
    alone: the telemetry of another vehicle may have led the estimate astray."""

    def __init__(self) -> None:
        self.telemetry, self.comparison = Telemetry(), TurnComparison()
        self._manoeuvres = 0
        self._frame: tuple[int, int, int, float] | None = None  # newest: id, time [ns], keyframe, turn since that
        self._tilt_of_keyframe: dict[int, Attitude] = {}
        self._short: Turn | None = None  # sum of turns that is shorter than TURN_SPAN_NS so far
        self._newest: Turn | None = None  # that was compared

    def image_turn(self, odometry: Odometry, r_b_c: np.ndarray) -> Turn | None:
        """-> turn since the frame before, at time stamps of frames; None if not both were seen from one keyframe."""
        attitude, keyframe = self.telemetry.at(odometry.t_ns), odometry.keyframe_id
        if odometry.becomes_keyframe:
            self._tilt_of_keyframe = {k: a for k, a in self._tilt_of_keyframe.items() if k == keyframe}
            self._tilt_of_keyframe[odometry.frame_id] = attitude
        before, self._frame = self._frame, (odometry.frame_id, odometry.t_ns, keyframe, 0.0)
        if odometry.frame_id == keyframe:
            return None
        pairs, tilt = np.array(odometry.two_view).reshape(-1, 4), self._tilt_of_keyframe.get(keyframe, attitude)
        since_rad = image_turn(pairs, tilt, attitude, r_b_c)
        if odometry.verdict is not Verdict.ACCEPTED or since_rad is None:
            self._frame = None
            return None
        self._frame = (*self._frame[:3], since_rad)
        if before is None or keyframe not in (before[0], before[2]):
            return None
        seen_rad = 0.0 if keyframe == before[0] else before[3]
        return Turn(before[1], odometry.t_ns, math.remainder(since_rad - seen_rad, math.tau))

    def add(self, turn: Turn) -> None:
        """A turn between two frames. Turns are summed to TURN_SPAN_NS, then compared, if they are turns."""
        short, self._short = self._short, None
        if short is not None and short.t1_ns == turn.t0_ns:
            turn = Turn(short.t0_ns, turn.t1_ns, short.yaw_rad + turn.yaw_rad)
        if turn.t1_ns - turn.t0_ns < TURN_SPAN_NS:
            self._short = turn
        elif abs(turn.yaw_rad) >= MIN_TURN_RATE_RADPS * (turn.t1_ns - turn.t0_ns) * 1e-9:
            newest, self._newest = self._newest, turn
            if newest is None or turn.t0_ns - newest.t1_ns >= TURN_PAUSE_NS or newest.yaw_rad * turn.yaw_rad < 0.0:
                self._manoeuvres += 1
            self.comparison.add(turn, self.telemetry)
        else:
            self.comparison.compare(self.telemetry, turn.t1_ns)

    @property
    def agrees(self) -> bool:
        total, of_a_turn = self.comparison.evidence
        return total >= MIN_EVIDENCE and of_a_turn >= MIN_TURN_EVIDENCE and self._manoeuvres >= MIN_MANOEUVRES


class CameraVehicleTest:
    """``confirmed``: system id of the vehicle that carries the camera; 0: not known."""

    def __init__(self, known: CameraVehicle | None = None) -> None:
        """``known``: of the process before this one in the same flight."""
        self.confirmed = 0 if known is None else known.sysid
        self._served = 0
        self._compares = False  # only while the confirmed vehicle, if any, is not there
        self._vehicles: dict[int, _Vehicle] = {}

    def on_served(self, served: ServedVehicle) -> CameraVehicle | None:
        """-> what is known already, where the link does not know it."""
        if not served.sysid:
            return None
        candidates = served.candidates or [served.sysid]
        self.confirmed = served.sysid if served.confirmed else self.confirmed
        self._served = 0 if served.candidates else served.sysid
        self._compares = self.confirmed not in candidates
        self._vehicles = {
            sysid: vehicle for sysid, vehicle in self._vehicles.items() if sysid in candidates and self._compares
        }
        known = self.confirmed and not served.confirmed
        return CameraVehicle(t_ns=served.t_ns, sysid=self.confirmed) if known else None

    def on_vehicle_state(self, state: VehicleState) -> None:
        """Attitude of the vehicle that is served."""
        if self._served and self._compares:
            self._vehicles.setdefault(self._served, _Vehicle()).telemetry.add(state)

    def on_candidate(self, attitude: CandidateAttitude) -> None:
        if self._compares:
            state = VehicleState(
                t_ns=attitude.t_ns,
                source="mavlink",
                yaw_rad=attitude.yaw_rad,
                pitch_rad=attitude.pitch_rad,
                roll_rad=attitude.roll_rad,
            )
            self._vehicles.setdefault(attitude.sysid, _Vehicle()).telemetry.add(state)

    def on_odometry(self, odometry: Odometry, camera: Camera) -> CameraVehicle | None:
        """-> the vehicle that is confirmed by this frame, if any."""
        if not self._vehicles:
            return None
        r_b_c = Mount.of(camera).r_b_c()
        for vehicle in self._vehicles.values():
            if (turn := vehicle.image_turn(odometry, r_b_c)) is not None:
                vehicle.add(turn)
        return self.decide(odometry.t_ns)

    def on_turn(self, turn: Turn) -> CameraVehicle | None:
        """As ``on_odometry``, by a turn that the images show."""
        for vehicle in self._vehicles.values():
            vehicle.add(turn)
        return self.decide(turn.t1_ns)

    def decide(self, t_ns: int) -> CameraVehicle | None:
        """-> the vehicle that turns as the images do, if there is exactly one. After that nothing is compared."""
        evidence = {sysid: vehicle.comparison.evidence[0] for sysid, vehicle in self._vehicles.items()}
        best = max(evidence, key=lambda sysid: evidence[sysid], default=0)
        if not best or not self._vehicles[best].agrees:
            return None
        if any(other > OTHER_SHARE * evidence[best] for sysid, other in evidence.items() if sysid != best):
            return None
        self.confirmed, self._compares = best, False
        self._vehicles.clear()
        return CameraVehicle(t_ns=t_ns, sysid=best, evidence=evidence)
