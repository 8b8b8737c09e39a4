"""Sends an operator's position prior to the processes on this computer over their bus, and returns the result."""

from terrafix.core.clock import now_ns
from terrafix.core.errors import LinkError, UsageError
from terrafix.messages import HintVerdict, PositionHint
from terrafix.processes import PROCESSES
from terrafix.runtime.cli_client import Operator
from terrafix_tools.run_choice import chosen_run

SUBSCRIBERS = [process.name for process in PROCESSES if PositionHint in process.subscribes]
SUBSCRIBE_TIMEOUT_S = (
    20.0  # time-out: the processes look for an operator several times a second, the anchor between two searches
)
ANSWER_S = 10.0  # time-out: the reply comes with the next frame
RADIUS_M = (100.0, 100_000.0)


def hint(
    lat_deg: float, lon_deg: float, radius_m: float, run: str = "", fix: tuple[int, float | None] = (-1, None)
) -> str:
    """Publishes the prior and returns the result as text. ``fix``: of a user fix, its frame and 1-sigma per axis [m].
    Raises UsageError; LinkError when no process runs or replies.
    """
    if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0):
        raise UsageError(f"{lat_deg:g}, {lon_deg:g} is no place; give latitude and longitude in degrees")
    if not RADIUS_M[0] <= radius_m <= RADIUS_M[1]:
        raise UsageError(f"--radius {radius_m:g}: choose {RADIUS_M[0]:.0f} to {RADIUS_M[1]:.0f} metres")
    run_dir = chosen_run(run)
    frame_id, sigma_m = fix
    prior = PositionHint(
        t_ns=now_ns(),
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        radius_m=radius_m,
        source="command line",
        frame_id=frame_id,
        sigma_m=sigma_m,
    )
    with Operator(run_dir, replies=HintVerdict, replier="anchor") as operator:
        if not operator.wait_for_subscribers(PositionHint, len(SUBSCRIBERS), SUBSCRIBE_TIMEOUT_S):
            raise LinkError(
                f"{run_dir.path}: {' and '.join(SUBSCRIBERS)} do not subscribe; is Terrafix still starting?"
            )
        operator.publish(prior)
        for answer in operator.replies(ANSWER_S):
            if isinstance(answer, HintVerdict) and answer.hint_t_ns == prior.t_ns:
                return answer.text
    return f"accepted; no frame arrived within {ANSWER_S:.0f} s, it applies to the next one"
