"""Metrics of a false input ("lie") in the closed loop: errors of GPS_INPUT, and the deviation of the vehicle.

A false GPS_INPUT has a 3D fix with an error of more than 50 m and more than 3 times its stated accuracy. The deviation
("aside") is the distance from the trajectory of the same vehicle with GNSS, in the same wind and without the lie."""

from terrafix_lab.accept.false_inputs.integrity import RECOVERED_M, lie_of
from terrafix_lab.accept.measuring.evidence import Evidence, SentFix
from terrafix_lab.accept.measuring.results import Measured, Verdict
from terrafix_tools.score import FALSE_FIX_ERROR_M, FALSE_FIX_SIGMAS, late_from_s

STEADY_S = 1.0  # recovered: for this time without interruption

NOT_FLOWN = Measured(None, "no GPS_INPUT was sent", Verdict.BELOW)


def deviation_on_a_fix_m(e: Evidence) -> Measured:
    """Largest deviation with a 3D fix, from the start of the lie to the end of the flight."""
    lie = lie_of(e)
    sent = [s for s in e.sent if s.t_s >= lie.from_s]
    if not sent:
        return NOT_FLOWN
    with_fix = [s for s in sent if s.error_m is not None]
    if not with_fix:
        return Measured(0.0, "no 3D fix any more from its beginning on")
    worst = max(with_fix, key=lambda s: s.deviation_m)
    share = f"{len(with_fix)} of {len(sent)} GPS_INPUT with a 3D fix"
    return Measured(worst.deviation_m, f"{worst.t_s - lie.from_s:.1f} s after its beginning; {share}")


def deviation_at_withdrawal_m(e: Evidence) -> Measured:
    """Deviation at the first GPS_INPUT without a 3D fix since the start of the lie."""
    lie = lie_of(e)
    first = next((s for s in e.sent if s.t_s >= lie.from_s and s.error_m is None), None)
    if first is None:
        return Measured(None, "it is never withdrawn")
    return Measured(first.deviation_m, f"{first.t_s - lie.from_s:.1f} s after its beginning: {first.reason}")


def late_false_fixes_sent(e: Evidence) -> Measured:
    """False GPS_INPUT except in the first 3 s or 5 frames of the lie; those before and after the lie count."""
    if not e.sent:
        return NOT_FLOWN
    lie = lie_of(e)
    until_s = min(lie.to_s, late_from_s([f.t_s for f in e.frames], lie.from_s))
    wrong = [s for s in e.sent if is_false_gps_input(s)]
    late = [s for s in wrong if not lie.from_s <= s.t_s <= until_s]
    if not late:
        return Measured(0.0, f"of {len(wrong)}")
    return Measured(
        float(len(late)), f"of {len(wrong)}; {late[0].t_s - lie.from_s:.1f} s after its beginning the first"
    )


def false_fixes_sent(e: Evidence) -> Measured:
    if not e.sent:
        return NOT_FLOWN
    wrong = [s for s in e.sent if is_false_gps_input(s)]
    with_fix = [s for s in e.sent if s.error_m is not None]
    worst = max(with_fix, key=lambda s: s.error_m or 0.0, default=None)
    if worst is None:
        return Measured(0.0, "no 3D fix was sent")
    return Measured(
        float(len(wrong)),
        f"of {len(with_fix)} with a 3D fix; {worst.error_m:.0f} m off at a claim of {worst.accuracy_m:.0f} m at worst",
    )


def fix_again_s(e: Evidence) -> Measured:
    """From the end of the lie to a 3D fix of GPS_INPUT within 20 m and not false, which lasts for a second."""
    lie = lie_of(e)
    after = [s for s in e.sent if s.t_s > lie.to_s]
    if not after or after[-1].t_s - lie.to_s < STEADY_S:
        return Measured(None, "the flight ends with the lie")
    since_s: float | None = None
    for sent in after:
        if sent.error_m is None or sent.error_m > RECOVERED_M or is_false_gps_input(sent):
            since_s = None
            continue
        since_s = sent.t_s if since_s is None else since_s
        if sent.t_s - since_s >= STEADY_S:
            return Measured(since_s - lie.to_s)
    return Measured(None, "never", Verdict.BELOW)


def is_false_gps_input(sent: SentFix) -> bool:
    return sent.error_m is not None and sent.error_m > max(FALSE_FIX_ERROR_M, FALSE_FIX_SIGMAS * sent.accuracy_m)
