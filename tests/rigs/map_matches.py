"""Parts of a MapMatch for tests."""

from typing import Any

import msgspec

from terrafix.core.pnp import solved
from terrafix.messages import GroundPlane, MapMatch, MapPose, SearchResult, Vec3


def with_pose(match: MapMatch, **changes: Any) -> MapMatch:
    """``match`` with other fields of its pose."""
    assert match.pose is not None
    return msgspec.structs.replace(match, pose=msgspec.structs.replace(match.pose, **changes))


def with_search(match: MapMatch, **fields: Any) -> MapMatch:
    """``match`` with these fields of the search, the others as without a search."""
    return msgspec.structs.replace(match, search=SearchResult(**fields))


def pose_of(match: MapMatch) -> MapPose:
    """The pose of the matcher, or that of PnP."""
    pose = solved(match).pose
    assert pose is not None
    return pose


def position_of(match: MapMatch) -> Vec3:
    return pose_of(match).p_c_in_w_m


def plane(amsl_m: float, slope_e: float = 0.0, slope_n: float = 0.0, relief_m: float = 0.0) -> GroundPlane:
    return GroundPlane(amsl_m=amsl_m, slope_e=slope_e, slope_n=slope_n, relief_m=relief_m)
