"""One more keyframe that shares ground with a frame: another two-view factor of its node (windowed bundle
adjustment)."""

from dataclasses import dataclass

import msgspec
import numpy as np

from terrafix.core.gate import GATE
from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.integrity.innovation import FusionVerdict, Innovation
from terrafix.estimator.models.plane_motion import RelativePose
from terrafix.messages import Odometry, Verdict

LINK_VERDICT = "link"  # in verdicts


@dataclass(frozen=True)
class LinkMeasurement:
    """A keyframe that both a frame and its ``parent`` are related to: ``motion`` of the frame since the keyframe, whose
    node is ``keyframe``, and ``known``, its motion since ``parent``."""

    frame_id: int  # of the keyframe
    keyframe: int
    motion: RelativePose
    parent: int
    known: RelativePose

    def innovation(self, state: FilterState) -> Innovation:
        """The camera by the link, less the camera by the parent, 6 degrees of freedom, tangent order."""
        first, second = state.graph.state(self.parent).pose, state.graph.state(self.keyframe).pose
        since_first, since_second = self.known.between, self.motion.between
        residual = first.compose(since_first).logmap(second.compose(since_second))
        by_poses = np.hstack([-since_first.inverse().AdjointMap(), since_second.inverse().AdjointMap()])
        cov = by_poses @ state.graph.joint_pose_covariance(self.parent, self.keyframe) @ by_poses.T
        return Innovation(residual, cov + self.known.cov + self.motion.cov, GATE[6])

    def verdict(self, state: FilterState) -> FusionVerdict:
        return self.innovation(state).verdict(LINK_VERDICT, f"keyframe {self.frame_id}")


def refused(odometry: Odometry, verdict: Verdict) -> FusionVerdict:
    """The verdict on a link that gives no motion."""
    return FusionVerdict(LINK_VERDICT, verdict, None, f"keyframe {odometry.keyframe_id}")


def by_link(odometry: Odometry, i: int) -> Odometry:
    """The odometry of the same frame against the keyframe of link ``i``, with the links after it."""
    link = odometry.links[i]
    return msgspec.structs.replace(
        odometry,
        keyframe_id=link.keyframe_id,
        two_view=link.two_view,
        sigma_norm=link.sigma_norm,
        inliers=link.inliers,
        tracked=link.tracked,
        previous_keyframe_id=-1,
        three_view=[],
        links=odometry.links[i + 1 :],
    )
