"""Monitors an autopilot in flight: the GPS_INPUT that it receives, and its position error."""

import json
from collections import deque
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from terrafix.core.errors import OutputError
from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.autopilot.lockstep import SimAutopilot
from terrafix_lab.sim.autopilot.navigation.gps import GpsInputDriver
from terrafix_lab.sim.interfaces import State
from terrafix_tools.score import FALSE_FIX_SIGMAS, quantile

TRUTH_HISTORY_S = 1.0  # longer than the age of a fix


@dataclass
class PeerReport:
    """Shares refer to the time from the first GPS_INPUT to the end; errors are horizontal, against the truth."""

    duration_s: float = 0.0
    gps_input_received: int = 0
    other_instance: int = 0  # GPS_INPUT for a gps_id that is not a GPS of that type
    no_fix: int = 0  # below 3D: not passed to the filter
    accepted: int = 0  # fused by the position gate
    rejected: int = 0
    resets: int = 0  # hard resets onto the GPS position
    not_in_use: int = 0  # with a fix, while another GPS was in use
    velocity_rejected: int = 0
    waiting_for_alignment: int = 0  # 3D, but the checks before first use did not pass
    healthy_share: float = 0.0
    fix3_share: float = 0.0
    longest_without_fix3_s: float = 0.0
    longest_gap_ms: float | None = None
    interval_median_ms: float | None = None
    interval_p99_ms: float | None = None
    gps_error_median_m: float | None = None  # position in the message, at its time of validity
    gps_error_p95_m: float | None = None
    gps_error_max_m: float | None = None
    fixes_beyond_3_sigma: int = 0  # 3D fixes that were farther off than 3 times the accuracy in the message
    position_error_median_m: float | None = None  # of the navigation solution
    position_error_p95_m: float | None = None
    position_error_max_m: float | None = None
    position_error_final_m: float | None = None
    horiz_accuracy_median_m: float | None = None
    failsafes: int = 0
    glitches: int = 0
    companion_heartbeats: int = 0
    message_intervals_set: int = 0
    timesync_answers: int = 0  # to our own requests
    timesync_requests: int = 0
    bad_packets: int = 0
    status_texts: list[str] = field(default_factory=list)  # received from the companion
    autopilot_texts: list[str] = field(default_factory=list)  # sent by the autopilot, with seconds of the flight

    def write(self, path: Path) -> None:
        """Writes JSON. Raises OutputError."""
        try:
            path.write_text(json.dumps(asdict(self), indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from None


@dataclass(frozen=True)
class ReceivedFix:
    """A 3D fix of GPS_INPUT. ``received_s``: time of the autopilot; error of the position at its time of validity."""

    received_s: float
    error_m: float
    horizontal_m: float | None  # horiz_accuracy


class PeerMonitor:
    """Monitors an autopilot with knowledge of the truth. Call ``observe`` after every step."""

    def __init__(self, autopilot: SimAutopilot, frame: LocalFrame) -> None:
        self._autopilot, self.frame = autopilot, frame
        self._truths: deque[tuple[float, np.ndarray, np.ndarray]] = deque()
        self._start_s: float | None = None
        self._first_gps_s: float | None = None
        self._now_s = 0.0
        self._healthy_s = self._fix3_s = self._without_s = self._longest_without_s = 0.0
        self._glitching = False
        self._glitches = 0
        self.fixes: list[ReceivedFix] = []
        self.errors_m: list[float] = []  # error of the navigation solution since the first GPS_INPUT

    def watch(self, autopilot: SimAutopilot) -> None:
        """Goes on with the same vehicle's autopilot after its restart; its counts begin again."""
        self._autopilot = autopilot

    def observe(self, now_s: float, truth: State) -> None:
        self._start_s = now_s if self._start_s is None else self._start_s
        dt_s, self._now_s = now_s - self._now_s, now_s
        self._truths.append((now_s, truth.p_b_in_w_m[:2], truth.velocity_enu_mps[:2]))
        while now_s - self._truths[0][0] > TRUTH_HISTORY_S:
            self._truths.popleft()
        for fix in self._autopilot.gps_input_fixes:
            reported = np.array(self.frame.to_local(fix.lat_deg, fix.lon_deg))
            error_m = float(np.hypot(*(reported - self._truth_at(fix.t_s))))
            self.fixes.append(ReceivedFix(now_s, error_m, fix.horizontal_m))
        self._autopilot.gps_input_fixes.clear()
        if self._first_gps_s is None:
            if not self._autopilot.counts.received:
                return
            self._first_gps_s, dt_s = now_s, 0.0
        self._update_gps_times(now_s, dt_s)
        glitching = self._autopilot.status.glitching
        self._glitches += glitching and not self._glitching
        self._glitching = glitching
        navigation = self._autopilot.navigation()
        if navigation is not None:
            self.errors_m.append(float(np.hypot(*(navigation.p_b_in_w_m[:2] - truth.p_b_in_w_m[:2]))))

    def report(self) -> PeerReport:
        autopilot, traffic = self._autopilot, self._autopilot.wire.received
        counts = autopilot.counts
        served_s = max(1e-9, self._now_s - (self._now_s if self._first_gps_s is None else self._first_gps_s))
        gaps_ms = [1e3 * g for gps in autopilot.gps if isinstance(gps, GpsInputDriver) for g in gps.gaps_s]
        errors, gps_errors = self.errors_m, [fix.error_m for fix in self.fixes]
        accuracies = [fix.horizontal_m for fix in self.fixes if fix.horizontal_m is not None]
        return PeerReport(
            duration_s=self._now_s - (self._start_s or 0.0),
            gps_input_received=counts.received,
            other_instance=counts.other_instance,
            no_fix=counts.no_fix,
            accepted=counts.accepted,
            rejected=counts.rejected,
            resets=counts.resets,
            not_in_use=counts.not_in_use,
            velocity_rejected=autopilot.ekf.velocity_rejected if autopilot.ekf is not None else 0,
            waiting_for_alignment=counts.waiting_for_alignment,
            healthy_share=min(1.0, self._healthy_s / served_s),
            fix3_share=min(1.0, self._fix3_s / served_s),
            longest_without_fix3_s=self._longest_without_s,
            longest_gap_ms=max(gaps_ms, default=None),
            interval_median_ms=quantile(gaps_ms, 0.5),
            interval_p99_ms=quantile(gaps_ms, 0.99),
            gps_error_median_m=quantile(gps_errors, 0.5),
            gps_error_p95_m=quantile(gps_errors, 0.95),
            gps_error_max_m=max(gps_errors, default=None),
            fixes_beyond_3_sigma=sum(fix.error_m > FALSE_FIX_SIGMAS * (fix.horizontal_m or 0.0) for fix in self.fixes),
            position_error_median_m=quantile(errors, 0.5),
            position_error_p95_m=quantile(errors, 0.95),
            position_error_max_m=max(errors, default=None),
            position_error_final_m=errors[-1] if errors else None,
            horiz_accuracy_median_m=quantile(accuracies, 0.5),
            failsafes=autopilot.status.failsafes,
            glitches=self._glitches,
            companion_heartbeats=traffic.heartbeats,
            message_intervals_set=traffic.message_intervals_set,
            timesync_answers=traffic.timesync_answers,
            timesync_requests=traffic.timesync_requests,
            bad_packets=traffic.bad_packets,
            status_texts=[text for _, text in traffic.texts],
            autopilot_texts=[f"{t_s:.1f} s: {text}" for t_s, text in autopilot.wire.sent_texts],
        )

    def _update_gps_times(self, now_s: float, dt_s: float) -> None:
        gps = next((g for g in self._autopilot.gps if isinstance(g, GpsInputDriver)), None)
        fix3 = gps is not None and gps.has_fix()
        self._healthy_s += dt_s * (gps is not None and gps.healthy(now_s))
        self._fix3_s += dt_s * fix3
        self._without_s = 0.0 if fix3 else self._without_s + dt_s
        self._longest_without_s = max(self._longest_without_s, self._without_s)

    def _truth_at(self, t_s: float) -> np.ndarray:
        """Returns the true position (2,) east, north at a time of the last second."""
        at_s, position, velocity = min(self._truths, key=lambda sample: abs(sample[0] - t_s))
        return position + velocity * (t_s - at_s)
