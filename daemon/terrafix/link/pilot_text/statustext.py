"""STATUSTEXT messages for the pilot."""

from terrafix.messages import GIMBAL_FAULTS, TOO_SLOW, CalibrationFault, StatusText

CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6  # MAV_SEVERITY [spec: MAVLink MAV_SEVERITY]
TWO_SENDERS = "telemetry of two senders"
TIME_JUMPS, ATTITUDE_JUMPS = "autopilot rebooted, or its time jumps", "attitude jumps without gyros"
# Faults that leave out frames or telemetry, by quantity: texts of their beginning and their end.
LINK_FAULTS = {
    TOO_SLOW: (f"{TOO_SLOW}: {{}}", "computer keeps up again"),
    TWO_SENDERS: (f"{TWO_SENDERS}, one ignored", "telemetry of one sender again"),
    TIME_JUMPS: (TIME_JUMPS, "the autopilot's time is steady again"),
    ATTITUDE_JUMPS: (f"{ATTITUDE_JUMPS}, ignored", "the attitude is steady again"),
    **{kind: (f"{kind}: level assumed", "the gimbal's reports are used again") for kind in GIMBAL_FAULTS},
}


def statustext(t_ns: int, severity: int, text: str) -> StatusText:
    return StatusText(t_ns=t_ns, severity=severity, text=f"Terrafix: {text}")


def fault_text(fault: CalibrationFault) -> str:
    """Text of 40 characters at most about a fault that a monitor found or ended."""
    if fault.quantity in LINK_FAULTS:
        begins, ends = LINK_FAULTS[fault.quantity]
        return begins.format(fault.detail) if fault.active else ends
    if fault.quantity == "registration":
        return "the map is found nowhere: no fix" if fault.active else "the map is found again"
    if fault.quantity == "start":
        return "take-off moved: no fix before the map" if fault.active else "the map has placed the start"
    if fault.quantity == "camera time" and fault.factor is not None:
        if not fault.active:
            return f"camera {fault.factor:.1f} s late: corrected" if fault.factor else "camera time is right again"
        late, which = abs(fault.factor), "camera" if fault.factor > 0.0 else "telemetry"
        return f"{which} {late:.1f} s late: check its buffers"
    if fault.quantity == "focal length" and fault.active and fault.factor is not None:
        return f"focal or ground height seems x{fault.factor:.2f} off"
    if fault.quantity == "picture not on the map":
        return fault.quantity if fault.active else "the picture is on the map again"
    if fault.quantity.startswith("picture"):
        turned = "" if fault.factor is None else f" by {fault.factor:.0f} deg"
        return f"{fault.quantity}{turned}: not used" if fault.active else "the picture is right again"
    if not fault.active:
        return f"{fault.quantity} is plausible again"
    if fault.factor is None:
        return f"{fault.quantity}: no fix"
    if fault.quantity == "aspect ratio":
        axis, by = ("x", 1.0 / fault.factor) if fault.factor < 1.0 else ("y", fault.factor)
        return f"picture squeezed by {by:.2f} in {axis}: no fix"
    if fault.quantity == "scale":
        return f"height/focal seems x{fault.factor:.2f} off: no fix"
    return f"{fault.quantity} off by {fault.factor:.0f} deg: no fix"
