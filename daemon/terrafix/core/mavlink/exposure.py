"""Times of exposure in MAVLink messages: CAMERA_FEEDBACK, CAMERA_IMAGE_CAPTURED, CAMERA_TRIGGER."""

from typing import Any

from terrafix.core.exposures import EXPOSURE_KINDS
from terrafix.core.mavlink.imu import boot_ns

EXPOSURE_MESSAGE_IDS = frozenset({180, 263, 112})  # [spec: MAVLink common.xml and ardupilotmega.xml]
NO_IMAGE = 0  # capture_result [spec: MAVLink common.xml]


def exposure_of(message: Any) -> tuple[str, int, int | None] | None:
    """-> kind, number, and time since boot [ns], None: the message has UNIX time. None: it reports no exposure."""
    kind = message.get_type()
    if kind not in EXPOSURE_KINDS or getattr(message, "capture_result", 1) == NO_IMAGE:
        return None
    number = {"CAMERA_FEEDBACK": "img_idx", "CAMERA_IMAGE_CAPTURED": "image_index", "CAMERA_TRIGGER": "seq"}[kind]
    return kind, int(getattr(message, number)), boot_ns(message)
