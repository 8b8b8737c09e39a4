"""Words to the pilot: STATUSTEXT."""

from terrafix.messages import CalibrationFault, StatusText

CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6  # MAV_SEVERITY


def statustext(t_ns: int, severity: int, text: str) -> StatusText:
    return StatusText(t_ns=t_ns, severity=severity, text=f"Terrafix: {text}")


def fault_words(fault: CalibrationFault) -> str:
    """At most 40 characters of a monitor's finding."""
    if fault.quantity == "registration":
        return "the map is found nowhere: no fix" if fault.active else "the map is found again"
    if not fault.active:
        return f"{fault.quantity} is plausible again"
    if fault.factor is None:
        return f"{fault.quantity}: no fix"
    if fault.quantity == "scale":
        return f"height/focal seems x{fault.factor:.2f} off: no fix"
    return f"{fault.quantity} off by {fault.factor:.0f} deg: no fix"
