"""Messages of records that were written before their types and fields were renamed."""

from collections.abc import Callable

import msgspec

from terrafix.messages import (
    BeliefMode,
    BeliefSummary,
    CalibrationEstimate,
    EkfDeadReckoning,
    EkfStatus,
    GnssInitialPosition,
    GpsInput,
    GroundPlane,
    InitialPosition,
    MapMatch,
    MapPose,
    Mat2,
    Mat6,
    MatchPlace,
    Message,
    Odometry,
    Prediction,
    Quat,
    SearchResult,
    SearchStep,
    Vec2,
    Vec3,
    Verdict,
)

OLD_FORMAT = "terrafix-flight/1"  # of the header of these records

Decode = Callable[[bytes], Message]  # JSON of the old form; raises msgspec.MsgspecError


class _FlatMapMatch(msgspec.Struct, frozen=True, kw_only=True):
    """MapMatch of the old form: one level of fields."""

    t_ns: int
    frame_id: int
    verdict: Verdict
    matcher: str
    coarse: bool = False
    matches: list[tuple[float, float, float, float, float, float]] = []
    p_c_in_w_m: Vec3 | None = None
    q_w_c: Quat | None = None
    cov: Mat6 | None = None
    lens: float = 0.0
    inliers: int = 0
    reprojection_px: float = 0.0
    margin: float = 0.0
    mode_mass: float = 0.0  # 0: there is no mode
    mode_e_m: float = 0.0
    mode_n_m: float = 0.0
    modes: list[tuple[float, float, float, float]] = []  # empty: there is no posterior
    belief_m: Vec2 = (0.0, 0.0)
    belief_cov_m2: Mat2 = (0.0, 0.0, 0.0, 0.0)
    ground: Vec3 | None = None
    relief_m: float = 0.0
    map_sigma_m: float = 0.0
    step: SearchStep = SearchStep.NORMAL
    lost_sigma_m: float = 0.0
    found: bool = False


_flat_map_match = msgspec.json.Decoder(_FlatMapMatch)


def _map_match(data: bytes) -> MapMatch:
    old = _flat_map_match.decode(data)
    place = MatchPlace(e_m=old.mode_e_m, n_m=old.mode_n_m, mass=old.mode_mass)
    return MapMatch(
        t_ns=old.t_ns,
        frame_id=old.frame_id,
        verdict=old.verdict,
        matcher=old.matcher,
        inliers=old.inliers,
        reprojection_px=old.reprojection_px,
        matches=old.matches,
        radial_k1=old.lens,
        map_sigma_m=old.map_sigma_m,
        pose=_pose(old),
        place=place if old.mode_mass > 0.0 else None,
        belief=_belief(old) if old.modes else None,
        ground=_ground(old),
        search=SearchResult(step=old.step, sigma_m=old.lost_sigma_m, relocalized=old.found),
    )


def _pose(old: _FlatMapMatch) -> MapPose | None:
    if old.p_c_in_w_m is None or old.q_w_c is None or old.cov is None:
        return None
    return MapPose(p_c_in_w_m=old.p_c_in_w_m, q_w_c=old.q_w_c, cov=old.cov, position_only=old.coarse)


def _belief(old: _FlatMapMatch) -> BeliefSummary:
    modes = [BeliefMode(e_m=e_m, n_m=n_m, mass=mass, variance_m2=m2) for e_m, n_m, mass, m2 in old.modes]
    return BeliefSummary(mean_m=old.belief_m, cov_m2=old.belief_cov_m2, modes=modes, mode_score=old.margin)


def _ground(old: _FlatMapMatch) -> GroundPlane | None:
    if old.ground is None:
        return None
    amsl_m, slope_e, slope_n = old.ground
    return GroundPlane(amsl_m=amsl_m, slope_e=slope_e, slope_n=slope_n, relief_m=old.relief_m)


def _renamed(message_type: type[Message], **fields: str) -> Decode:
    """``fields``: new names by the old ones."""
    decoder = msgspec.json.Decoder(message_type)

    def decode(data: bytes) -> Message:
        old = msgspec.json.decode(data, type=dict[str, msgspec.Raw])
        renamed = {fields.get(name, name): value for name, value in old.items() if name != "type"}
        return decoder.decode(msgspec.json.encode({"type": message_type.__name__, **renamed}))

    return decode


# By the topic of the old record; a topic that is not here has not changed.
OLD_DECODERS: dict[str, Decode] = {
    # Until the names of preintegration and calibration:
    "/coasted": _renamed(EkfDeadReckoning, coast_s="duration_s", way_m="delta_p_m", gain_mps="delta_v_mps"),
    "/slow_errors": _renamed(CalibrationEstimate, error="state"),
    "/filter_status": _renamed(EkfStatus),
    # Until MapMatch had parts:
    "/map_match": _map_match,
    "/start": _renamed(InitialPosition),
    "/gnss_start": _renamed(GnssInitialPosition),
    "/prediction": _renamed(Prediction, lens="radial_k1", start_ns="prior_t_ns"),
    "/odometry": _renamed(
        Odometry,
        pairs="two_view",
        triples="three_view",
        before_id="previous_keyframe_id",
        triples_sigma_norm="three_view_sigma_norm",
    ),
    "/gps_input": _renamed(GpsInput, caution="degradation", reason="no_fix_reason"),
}
