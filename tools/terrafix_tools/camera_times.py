"""Rate, jitter and latency of the camera of a flight, from its record."""

from dataclasses import dataclass, field

import numpy as np

from terrafix.messages import CalibrationFault, Frame, LogLine, Message, NavEstimate

CAMERA_TIME = "camera time"  # quantity of the estimated time offset [spec: estimator/integrity/time_offset.py]
SIGMA_OF_MAD = 1.4826  # of a normal distribution [spec: Rousseeuw and Croux 1993]
SKIPPED = 1.5  # longer intervals, in medians, have a frame less [spec: between one and two]


@dataclass
class CameraTimes:
    """``take`` the messages of a record in any order."""

    _stamps_ns: dict[int, int] = field(default_factory=dict)  # by frame
    _at_hand_ns: list[int] = field(default_factory=list)  # from the stamp of a frame to its reception
    _estimated_ns: dict[int, int] = field(default_factory=dict)  # ... to that of its first estimate
    _sigma_s: float = 0.0
    _fault: CalibrationFault | None = None
    _exposures: str = ""

    def take(self, received_ns: int, message: Message) -> None:
        """``received_ns``: by the recorder; that of the message in a record without a clock."""
        if isinstance(message, Frame):
            self._stamps_ns[message.frame_id], self._sigma_s = message.t_ns, message.stamp_sigma_s
            self._at_hand_ns.append(received_ns - message.t_ns)
        elif isinstance(message, NavEstimate):
            self._estimated_ns.setdefault(message.frame_id, received_ns)
        elif isinstance(message, CalibrationFault) and message.quantity == CAMERA_TIME:
            self._fault = message
        elif isinstance(message, LogLine) and message.event.startswith("exposures of the autopilot"):
            self._exposures = f"{message.event}: {message.fields.get('which') or message.fields.get('why')}"

    def words(self) -> list[str]:
        """Lines; none of fewer than three frames."""
        stamps_s = np.sort(np.array(list(self._stamps_ns.values()))) * 1e-9
        if len(stamps_s) < 3 or (median_s := float(np.median(np.diff(stamps_s)))) <= 0:
            return []
        steps_s = np.diff(stamps_s)
        even = steps_s[steps_s < SKIPPED * median_s]
        jitter_ms = 1e3 * SIGMA_OF_MAD * float(np.median(np.abs(even - median_s)))
        gaps_s = steps_s[steps_s >= SKIPPED * median_s]
        lines = [
            f"{len(stamps_s)} frames, {1 / median_s:.3g} a second, jitter of the interval {jitter_ms:.1f} ms (1-sigma)"
            + (f", {len(gaps_s)} longer intervals, the longest {gaps_s.max():.2f} s" if len(gaps_s) else "")
        ]
        if any(self._at_hand_ns):
            frames = [i for i in self._estimated_ns if i in self._stamps_ns]
            estimated = [self._estimated_ns[i] - self._stamps_ns[i] for i in frames]
            lines.append(f"from the stamp to the image {_ms(self._at_hand_ns)}, to its first estimate {_ms(estimated)}")
        offset = f"stamps are of the exposure to {1e3 * self._sigma_s:.0f} ms (1-sigma)"
        if self._fault is not None and self._fault.factor is not None:
            offset += f"; estimated to be {1e3 * self._fault.factor:+.0f} ms late: {self._fault.detail}"
        return [*lines, offset, *([self._exposures] if self._exposures else [])]


def _ms(delays_ns: list[int]) -> str:
    if not delays_ns:
        return "unknown"
    median, high = np.percentile(np.array(delays_ns) * 1e-6, (50, 95))
    return f"{median:.0f} ms (median), {high:.0f} ms (95 %)"
