"""What the autopilot peer noted about the GPS_INPUT that it was given."""

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path

from terrafix.core.errors import OutputError


@dataclass
class PeerReport:
    """Shares are of the time from the first GPS_INPUT to the stop; errors are against the true course, horizontal."""

    duration_s: float = 0.0
    gps_input_received: int = 0
    other_instance: int = 0  # GPS_INPUT for a gps_id that is not this GPS
    no_fix: int = 0  # below 3D: not offered to the filter
    accepted: int = 0  # fused by the position gate
    rejected: int = 0
    resets: int = 0  # hard resets onto the GPS position
    velocity_rejected: int = 0
    waiting_for_alignment: int = 0  # 3D, but the checks before first use did not hold
    healthy_share: float = 0.0
    fix3_share: float = 0.0
    longest_without_fix3_s: float = 0.0
    longest_gap_ms: float | None = None
    interval_median_ms: float | None = None
    interval_p99_ms: float | None = None
    gps_error_median_m: float | None = None  # the position in the message, at the time it names
    gps_error_p95_m: float | None = None
    position_error_median_m: float | None = None  # the peer's own filter
    position_error_p95_m: float | None = None
    position_error_max_m: float | None = None
    position_error_final_m: float | None = None
    horiz_accuracy_median_m: float | None = None
    companion_heartbeats: int = 0
    message_intervals_set: int = 0
    timesync_answers: int = 0  # to our own requests
    timesync_requests: int = 0
    bad_packets: int = 0
    status_texts: list[str] = field(default_factory=list)

    def write(self, path: Path) -> None:
        """As JSON. Raises OutputError."""
        try:
            path.write_text(json.dumps(asdict(self), indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from None


def quantile(values: list[float], share: float) -> float | None:
    """Nearest rank; None without values."""
    if not values:
        return None
    return sorted(values)[max(0, math.ceil(share * len(values)) - 1)]
