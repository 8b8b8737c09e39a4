"""Edge of the estimator process: log lines of the pose estimation, and the checkpoint (RS-1, ON-8)."""

from collections.abc import Iterable
from pathlib import Path

from terrafix.core import logs
from terrafix.estimator.pose_estimator import covariance_mode
from terrafix.estimator.prior import CheckpointWriter
from terrafix.messages import (
    CovarianceMode,
    Health,
    MapMatch,
    Message,
    NavEstimate,
    Origin,
    PoseSolution,
    SourceLabel,
    Verdict,
)


class EstimatorEdge:
    def __init__(self, estimator: str, checkpoint: Path | None) -> None:
        """``estimator``: name of the PoseEstimator of the node."""
        self._log = PoseLog(estimator)
        self._checkpoint = None if checkpoint is None else CheckpointWriter(checkpoint)

    def poll(self, now_ns: int) -> Iterable[Message]:
        return ()

    def on_message(self, message: Message) -> None:
        self._log.on_message(message)
        if self._checkpoint is not None:
            self._checkpoint.on_message(message)

    def close(self) -> None:
        pass


class PoseLog:
    """Logs what the messages of the estimator say of its poses. ERROR: a match that the anchor has accepted gives no
    pose; WARN: thermal throttle begins or ends; INFO: a flight begins; DEBUG: the pose of each match."""

    def __init__(self, estimator: str) -> None:
        self._estimator = estimator
        self._mode = CovarianceMode.MARGINALS
        self._accepted_id: int | None = None  # frame of the newest match, if the anchor has accepted it
        self._tracked = True  # the newest frame has odometry

    def on_message(self, message: Message) -> None:
        match message:
            case Origin():
                logs.get().info("pose estimator ready", estimator=self._estimator, covariance_mode=self._mode)
            case Health():
                self._on_health(message)
            case MapMatch():
                self._accepted_id = message.frame_id if message.verdict is Verdict.ACCEPTED else None
            case NavEstimate():
                self._tracked = message.source_label is not SourceLabel.DEAD_RECKONED
            case PoseSolution():
                self._on_solution(message)
            case _:
                pass

    def _on_health(self, health: Health) -> None:
        before, self._mode = self._mode, covariance_mode(health)
        if self._mode is before:
            return
        entered = self._mode is CovarianceMode.JACOBIAN
        logs.get().warning(
            "thermal throttle entered" if entered else "thermal throttle left",
            covariance_mode=self._mode,
            temperature_c=health.temperature_c,
            clock_mhz=health.clock_mhz,
            cause=health.cause,
        )

    def _on_solution(self, solution: PoseSolution) -> None:
        about = {"frame_id": solution.frame_id, "covariance_mode": solution.covariance_mode}
        logs.get().debug(
            "pose", method=solution.method, inliers=solution.inliers, residual_px=solution.residual_px, **about
        )
        if solution.frame_id == self._accepted_id and solution.verdict is not Verdict.ACCEPTED:
            fallback = SourceLabel.VISUAL_PROPAGATED if self._tracked else SourceLabel.DEAD_RECKONED
            todo = "seldom: nothing; often: check camera calibration and map with terrafix report"
            logs.get().error("PnP failure", verdict=solution.verdict, fallback=fallback, todo=todo, **about)
