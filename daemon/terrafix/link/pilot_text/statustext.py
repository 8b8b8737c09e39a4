"""STATUSTEXT messages for the pilot."""

from terrafix.messages import CalibrationFault, StatusText

CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6  # MAV_SEVERITY [spec: MAVLink MAV_SEVERITY]


def statustext(t_ns: int, severity: int, text: str) -> StatusText:
    return StatusText(t_ns=t_ns, severity=severity, text=f"Terrafix: {text}")


def fault_text(fault: CalibrationFault) -> str:
    """Text of 40 characters at most about a fault that a monitor found or ended."""
    if fault.quantity == "registration":
        return "the map is found nowhere: no fix" if fault.active else "the map is found again"
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
