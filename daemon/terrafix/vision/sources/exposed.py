"""Frames at the times of exposure that the autopilot reports, live or in its log."""

from collections import deque
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from terrafix.core import logs
from terrafix.core.exposures import EXPOSURE_KINDS, Matched, match_exposures
from terrafix.messages import STAMP_SIGMA_S, Exposure, Fact, Frame

WINDOW = (
    60  # newest frames and reports that are compared: half a minute at 2 Hz [spec: MIN_EXPOSED_FRAMES and lost ones]
)
REPORTED_FRAMES = 20  # after which it is reported that nothing fits [spec: a third of WINDOW]
FOLDER_SIGMA_S = 1.0  # of the stamps in a table against the clock of its log [spec: EXIF has whole seconds]


def exposed_times(
    times_ns: Sequence[int], exposures_ns: Mapping[str, Sequence[int]], log_name: str
) -> tuple[list[int], list[Fact]]:
    """Times of the frames of a recording by the exposures of its log, of each kind, the preferred one first; with what
    was found, in words. Unchanged where none fits."""
    stamps_s, refused = np.array(times_ns) * 1e-9, []
    for kind, of_kind in exposures_ns.items():
        found = match_exposures(stamps_s, np.array(of_kind) * 1e-9, FOLDER_SIGMA_S, complete=True)
        if isinstance(found, Matched):
            times = [round(t_s * 1e9) for t_s in found.times_s.tolist()]
            if times[0] >= 0 and all(np.diff(times) > 0):
                return times, [Fact("exposure", f"by {kind} of {log_name}: {found.text()}")]
            found = f"exposures {found.text()}, would exchange frames"
        refused.append(Fact("exposure", f"{kind} of {log_name} is not used: {found}"))
    return list(times_ns), refused


class ReportedExposures:
    """``add`` reports as they come, and ``exposed`` with each frame of a camera, in order."""

    def __init__(self) -> None:
        self._reports: dict[str, deque[int]] = {}
        self._stamps: deque[int] = deque(maxlen=WINDOW)
        self._newest_ns = -1  # time that the newest frame was given
        self._reported = ""

    def add(self, exposure: Exposure) -> None:
        of_kind = self._reports.setdefault(exposure.kind, deque(maxlen=WINDOW))
        if not of_kind or exposure.t_ns > of_kind[-1]:
            of_kind.append(exposure.t_ns)

    def exposed(self, frame: Frame) -> Frame:
        """``frame`` at its exposure; as it is where no reports fit."""
        if not self._reports:
            return frame
        self._stamps.append(frame.t_ns)
        zero_ns, refused = self._stamps[0], ""
        stamps_s = (np.array(self._stamps) - zero_ns) * 1e-9
        for kind in sorted(self._reports, key=EXPOSURE_KINDS.index):
            reports_s = (np.array(self._reports[kind]) - zero_ns) * 1e-9
            found = match_exposures(stamps_s, reports_s, frame.stamp_sigma_s, complete=False)
            if isinstance(found, Matched):
                t_ns = zero_ns + round(float(found.times_s[-1]) * 1e9)
                if t_ns <= self._newest_ns:  # the frame before had its stamp, and the latency is longer than a frame
                    break
                self._log_change(f"by {kind}", f"{kind}: {found.text()}", fits=True)
                self._newest_ns = t_ns
                sigma_s = max(found.jitter_s, min(frame.stamp_sigma_s, STAMP_SIGMA_S))
                return msgspec.structs.replace(frame, t_ns=t_ns, buffered=False, stamp_sigma_s=sigma_s)
            refused = refused or f"{kind}: {found}"
        if len(self._stamps) >= REPORTED_FRAMES:
            self._log_change("none", refused or "their latency is longer than the time between two frames", fits=False)
        self._newest_ns = frame.t_ns
        return frame

    def _log_change(self, state: str, text: str, *, fits: bool) -> None:
        if state == self._reported:
            return
        self._reported = state
        if fits:
            logs.get().info("exposures of the autopilot are used", which=text)
        else:
            logs.get().warning("exposures of the autopilot do not fit the frames", why=text)
