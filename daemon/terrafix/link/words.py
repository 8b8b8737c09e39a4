"""Words to the pilot: STATUSTEXT."""

from terrafix.messages import StatusText

CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6  # MAV_SEVERITY


def words(t_ns: int, severity: int, text: str) -> StatusText:
    return StatusText(t_ns=t_ns, severity=severity, text=f"Terrafix: {text}")
