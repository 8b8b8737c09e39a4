"""State of a graph node, and the index of each component in its vectors and covariances.

A node k is one frame. It has three variables:
C_k  camera pose in the world (Pose3). Tangent order: rotation, translation, both in the axes of the camera.
B_k  calibration state, (CALIBRATION_SIZE,): quantities that change slowly.
V_k  motion state, (MOTION_SIZE,): velocity in the world; accelerations in axes of the heading (right, ahead, up)."""

from dataclasses import dataclass

import gtsam
import numpy as np

from terrafix.core.pose import HORIZONTAL as HORIZONTAL
from terrafix.core.pose import ROTATION as ROTATION
from terrafix.core.pose import TRANSLATION as TRANSLATION

# Axes of the world, and of a position or a velocity in it. [spec: east, north, up]
EAST, NORTH, UP = range(3)

POSE_SIZE = 6  # [spec: Pose3]
# Pose covariance in world axes, as core.pose.tangent_to_world returns it.
WORLD_POSITION, WORLD_ROTATION = slice(0, 3), slice(3, 6)  # [spec: core.pose, position first]
WORLD_TILT, WORLD_YAW = slice(3, 5), 5  # [spec: core.pose, rotation about east and north, and about up]

# B_k: mount tilt about the camera's x and y axes [rad]; heading bias [rad], positive where the reported heading is too
# far clockwise; height bias [m] of the seen height; first radial coefficient of the lens beyond its description;
# logarithm of reported over seen heights. [spec: layout of B_k]
MOUNT_TILT_X, MOUNT_TILT_Y, HEADING, HEIGHT, RADIAL_K1, LOG_HEIGHT_SCALE = range(6)
MOUNT_TILT = slice(0, 2)  # [spec: layout of B_k]
CALIBRATION_SIZE = 6  # [spec: layout of B_k]

# V_k: velocity [m/s]; unmodelled acceleration, a Gauss-Markov process [m/s^2]; steady acceleration error of the IMU,
# right and ahead [m/s^2].
VELOCITY, GAUSS_MARKOV_ACCEL, STEADY_ACCEL = slice(0, 3), slice(3, 6), slice(6, 8)  # [spec: layout of V_k]
ACCELERATIONS = slice(3, 8)  # [spec: both accelerations of V_k]
MOTION_SIZE = 8  # [spec: layout of V_k]

# Increment from one node to the next: change of position, then V_k at its end.
DELTA_P, DELTA_V, DELTA_P_V = slice(0, 3), slice(3, 6), slice(0, 6)  # [spec: layout of an increment]
DELTA_MOTION = slice(3, 11)  # [spec: V_k within an increment]
DELTA_GAUSS_MARKOV, DELTA_ACCELERATIONS = slice(6, 9), slice(6, 11)  # [spec: accelerations within an increment]
DELTA_SINGER, DELTA_STEADY = slice(0, 9), slice(9, 11)  # [spec: all but the steady acceleration; the steady one]
INCREMENT_SIZE = 3 + MOTION_SIZE  # [spec: position and V_k]


@dataclass(frozen=True)
class NodeState:
    """Estimate of one node."""

    pose: gtsam.Pose3
    calibration: np.ndarray  # (CALIBRATION_SIZE,) B_k
    motion: np.ndarray  # (MOTION_SIZE,) V_k

    @property
    def barometric_up_m(self) -> float:
        """AMSL height in seen units without the height bias. Differs from the height of C where no DEM gives the
        ground and C is a height above whatever ground is seen."""
        return float(self.pose.translation()[UP] + self.calibration[HEIGHT])
