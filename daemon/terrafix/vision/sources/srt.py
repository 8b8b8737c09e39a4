"""Telemetry in the subtitles of DJI's videos (VIDEO.SRT): height above take-off, and gimbal angles where there are any.

Forms: "[rel_alt: 1.2 abs_alt: 3.4]", "BAROMETER:1.2" or "BAROMETER(1.2M)", "H 1.2m"; angles "[gb_yaw: 1 gb_pitch: -90
gb_roll: 0]". "altitude" alone is above the sea in some firmware, and not read. Positions, "GPS(...)" or
"[latitude: ...]", are not read: they are GNSS."""

import re
from pathlib import Path

from terrafix.core.errors import SourceError
from terrafix.messages import VehicleState
from terrafix.vision.sources.xmp import body_angles_from_gimbal

_FIELD_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
_CUE = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{3})\s*-->")
_HEIGHT_FORMS = tuple(
    re.compile(form + _FIELD_NUMBER) for form in (r"rel_alt\s*:\s*", r"BAROMETER\s*[:(]\s*", r"\bH\s+")
)
_ANGLE_FORMS = tuple(re.compile(rf"gb_{axis}\s*:\s*{_FIELD_NUMBER}") for axis in ("yaw", "pitch", "roll"))


def read_srt(path: Path) -> list[VehicleState]:
    """A state for each subtitle that has a height or angles, in time order. Raises SourceError: it cannot be read, or
    has no subtitle of DJI."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    cues = list(_CUE.finditer(text))
    states: list[VehicleState] = []
    for cue, after in zip(cues, [*(cue.start() for cue in cues[1:]), len(text)], strict=True):
        hours, minutes, seconds, ms = map(int, cue.groups())
        block = text[cue.end() : after]
        height = next((found for form in _HEIGHT_FORMS if (found := form.search(block))), None)
        angles = [found for form in _ANGLE_FORMS if (found := form.search(block))]
        if height is None and len(angles) < len(_ANGLE_FORMS):
            continue
        yaw, pitch, roll = None, None, None
        if len(angles) == len(_ANGLE_FORMS):
            yaw, pitch, roll = body_angles_from_gimbal(*(float(found[1]) for found in angles))
        t_ns = (((hours * 60 + minutes) * 60 + seconds) * 1000 + ms) * 1_000_000
        agl_m = None if height is None else float(height[1])
        if states and t_ns <= states[-1].t_ns:
            continue
        states.append(VehicleState(t_ns=t_ns, source="srt", yaw_rad=yaw, pitch_rad=pitch, roll_rad=roll, agl_m=agl_m))
    if not states:
        raise SourceError(f"{path}: no subtitle of it has a height or gimbal angles of DJI; rename or remove it")
    return states
