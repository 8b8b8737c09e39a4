"""Anchor: the newest predicted frame against the map, through the belief, into 2D-3D matches and a pose."""

from collections.abc import Iterable

import msgspec
import numpy as np

from terrafix.anchor.belief import Belief, Mode, cell_for
from terrafix.anchor.map_features import Describer
from terrafix.anchor.map_package import LocalMap, MapPackage
from terrafix.anchor.matcher import Fix, FrameMatcher, View
from terrafix.core.camera import CameraCalibration
from terrafix.core.errors import ModelError
from terrafix.core.geodesy import LocalFrame, quat_from_rot, rot_from_quat
from terrafix.core.node import FrameStore, NodeContext
from terrafix.core.pose import tangent_to_world
from terrafix.core.signature import trusted_keys
from terrafix.messages import MapMatch, Message, Origin, Prediction, Vec3, Verdict
from terrafix_engines.features import open_describer
from terrafix_engines.runtime import ModelFileError

NEW_GROUND_SHARE = 0.35  # of the footprint: after this much motion a look counts as a new one
MIN_LOOK = 0.08  # a look at the same ground again still says this much
MODE_MASS = 0.9  # the belief hands a fix to the graph when one mode holds this much
# A pose on which many patches agree is evidence of its own: found at most right places, at hardly any wrong one.
POSE_LIKELIHOOD_RATIO = 20.0
MODE_TRIED = 0.5  # modes below this are not tried at all
COARSE_TILT_RAD = np.radians(10.0)  # a coarse fix says nothing of attitude: as good as unknown
COARSE_HEIGHT_M = 100.0  # ... nor of height
COARSE_SIGMA = 0.03  # of the height: buildings that lean and a scale that is not quite right shift the whole picture
COARSE_SCORE = 3.0  # standardised correlation that a coarse fix must have in this very frame
MIN_AGL_M = 30.0  # below this a frame shows a few roofs and cars
MODE_DRIFT = 0.35  # of the height: how far the pose may lie from the mode while the tilt is not yet known
START_SIGMA_FLOOR_M = 8.0  # an apparent position also carries the tilt that is not known yet
LOST_SCORE = 2.0  # standardised correlation in the mode; a frame at the right place scores 3 to 10
LOST_LOOKS = 4.0  # full looks below it before the search widens
WIDEN = 1.6
CE90_SIGMAS = 2.1460  # of a circular normal error: sqrt(-2 ln 0.1)


class AnchorNode:
    def __init__(
        self, frames: FrameStore, package: MapPackage | None, describer: Describer, map_sigma_m: float
    ) -> None:
        self._frames = frames
        self._package = package
        self._describer = describer
        self._map_sigma_m = map_sigma_m
        self._matcher: FrameMatcher | None = None
        self._map: LocalMap | None = None
        self._belief: Belief | None = None
        self._origin: Origin | None = None
        self._ground_m = 0.0
        self._since_look_m = np.inf  # motion since the last look at new ground
        self._poor_looks = 0.0
        self._variance_m2 = 0.0  # of the last prediction

    def on(self, message: Message) -> Iterable[Message]:
        match message:
            case Origin() if message != self._origin:  # said again after a restart of the source
                self._origin = message
                self._ground_m = message.ground_amsl_m or 0.0
                self._belief = None
                if self._package is not None:
                    self._map = self._package.bind(LocalFrame(message.lat_deg, message.lon_deg))
                    self._matcher = FrameMatcher(CameraCalibration.of(message.camera), self._map, self._describer)
            case Prediction():
                yield self._match(message)
            case _:
                pass

    def tick(self, now_ns: int) -> Iterable[Message]:
        return ()

    def _match(self, prediction: Prediction) -> MapMatch:
        answer = MapMatch(
            t_ns=prediction.t_ns,
            frame_id=prediction.frame_id,
            verdict=Verdict.OUTSIDE_MAP,
            matcher=self._describer.name,
            map_sigma_m=self._map_sigma_m,
        )
        image = self._frames.get(prediction.frame_id)
        if self._matcher is None:
            return answer
        belief = self._moved(prediction, cell_for(prediction.agl_m, self._matcher.look_cell_m(prediction.agl_m)))
        if image is None:
            return msgspec.structs.replace(answer, verdict=Verdict.BAD_IMAGE)
        view, ground, relief_m = self._view(prediction)
        answer = msgspec.structs.replace(answer, ground=ground, relief_m=relief_m)
        if view.agl_m < MIN_AGL_M:
            return msgspec.structs.replace(answer, verdict=Verdict.TOO_LOW)
        look = self._matcher.look(image, view, belief)
        if look.verdict is not Verdict.ACCEPTED:
            return msgspec.structs.replace(answer, verdict=look.verdict)
        weight = float(np.clip(self._since_look_m / (NEW_GROUND_SHARE * look.footprint_m), MIN_LOOK, 1.0))
        self._since_look_m = 0.0
        belief.update(look.surfaces, weight)
        mode = belief.mode()
        hypothesis, score = look.best_at(mode.e_m, mode.n_m)
        self._watch(belief, score, weight)
        ee, en, nn = belief.covariance()
        answer = msgspec.structs.replace(
            answer,
            margin=score,
            mode_mass=mode.mass,
            mode_e_m=mode.e_m,
            mode_n_m=mode.n_m,
            belief_cov_m2=(ee, en, en, nn),
        )
        if mode.mass < MODE_TRIED:
            return msgspec.structs.replace(answer, verdict=Verdict.AMBIGUOUS)
        fix = self._matcher.fix(image, view, hypothesis, mode.e_m, mode.n_m)
        answer = self._judged(answer, fix, view)
        if answer.verdict is Verdict.ACCEPTED:
            belief.confirm(mode, POSE_LIKELIHOOD_RATIO)
            mass = belief.mode().mass
            enough = Verdict.ACCEPTED if mass >= MODE_MASS else Verdict.AMBIGUOUS
            return msgspec.structs.replace(answer, verdict=enough, mode_mass=mass)
        if mode.mass < MODE_MASS:
            return msgspec.structs.replace(answer, verdict=Verdict.AMBIGUOUS)
        return self._coarse(answer, mode, belief, view) if score >= COARSE_SCORE else answer

    def _moved(self, prediction: Prediction, cell_m: float) -> Belief:
        step_m = float(np.hypot(*prediction.step_m))
        # Blind, the error of the position grows faster than the steps' own errors add up: with that of the velocity.
        variance = max(prediction.cov[0], prediction.cov[7])
        grown = variance - self._variance_m2
        self._variance_m2 = variance
        sigma_m = float(np.sqrt(max(prediction.step_cov_m2[0], prediction.step_cov_m2[3], grown)))
        if self._belief is None:
            e_m, n_m, _ = prediction.p_c_in_w_m
            start = float(np.sqrt(max(prediction.cov[0], prediction.cov[7])))
            tilt = prediction.agl_m * float(np.sqrt(max(prediction.cov[21], prediction.cov[28])))
            self._belief = Belief(e_m, n_m, float(np.hypot(max(start, START_SIGMA_FLOOR_M), tilt)), cell_m)
        else:
            self._belief.move(*prediction.step_m, sigma_m)
            self._belief.fit_window(0.0)
            if not 0.4 < cell_m / self._belief.cell_m < 2.5:  # an octave is left alone: no flicker at its edge
                self._belief.set_cell(cell_m)
        self._since_look_m += float(np.hypot(step_m, sigma_m))
        return self._belief

    def _view(self, prediction: Prediction) -> tuple[View, Vec3 | None, float]:
        """The predicted camera over the ground as the DEM has it, the plane of that ground (None: no DEM), and what the
        ground departs from it (rms)."""
        e_m, n_m, up_m = prediction.p_c_in_w_m
        ground, relief_m = self._plane(e_m, n_m, prediction.agl_m)
        agl_m = prediction.agl_m if ground is None else up_m - ground[0]
        view = View(
            e_m,
            n_m,
            rot_from_quat(prediction.q_w_c),
            agl_m,
            self._ground_m if ground is None else ground[0],
            float(np.sqrt(prediction.cov[35])),
            prediction.agl_sigma_m / max(agl_m, 1.0),
            float(np.sqrt(max(prediction.cov[21], prediction.cov[28]))),
        )
        return view, ground, relief_m

    def _plane(self, e_m: float, n_m: float, agl_m: float) -> tuple[Vec3 | None, float]:
        """Least squares over the ground that is seen: AMSL below the camera, slope east, slope north; and what is left
        (rms)."""
        if self._map is None:
            return None, 0.0
        axis = np.linspace(-0.7, 0.7, 7) * agl_m
        de, dn = (a.ravel() for a in np.meshgrid(axis, axis))
        up = self._map.elevation(e_m + de, n_m + dn)
        if up is None or np.isfinite(up).sum() < len(de) / 2:
            return None, 0.0
        known = np.isfinite(up)
        design = np.column_stack([np.ones(known.sum()), de[known], dn[known]])
        plane = np.linalg.lstsq(design, up[known], rcond=None)[0]
        relief_m = float(np.sqrt(np.mean((up[known] - design @ plane) ** 2)))
        return (float(plane[0]), float(plane[1]), float(plane[2])), relief_m

    def _watch(self, belief: Belief, score: float, weight: float) -> None:
        """A mode that no longer fits what is seen: look wider."""
        self._poor_looks = self._poor_looks + weight if score < LOST_SCORE else 0.0
        if self._poor_looks >= LOST_LOOKS:
            self._poor_looks = 0.0
            belief.fit_window(belief.half_m * WIDEN)

    def _coarse(self, answer: MapMatch, mode: Mode, belief: Belief, view: View) -> MapMatch:
        """The position of the mode, as a pose factor. What is seen is the place of the ground, so the camera's position
        goes with its tilt: p_e moves by +h, p_n by -h per radian of rotation about north and east."""
        lever = np.zeros((2, 2))
        lever[0, 1], lever[1, 0] = view.agl_m, -view.agl_m
        tilt = COARSE_TILT_RAD**2 * np.eye(2)
        cov = np.diag([0.0, 0.0, COARSE_HEIGHT_M**2, COARSE_TILT_RAD**2, COARSE_TILT_RAD**2, COARSE_TILT_RAD**2])
        sigma2 = mode.var_m2 + belief.cell_m**2 + (COARSE_SIGMA * view.agl_m) ** 2
        cov[:2, :2] = lever @ tilt @ lever.T + sigma2 * np.eye(2)
        cov[:2, 3:5] = lever @ tilt
        cov[3:5, :2] = cov[:2, 3:5].T
        return msgspec.structs.replace(
            answer,
            verdict=Verdict.ACCEPTED,
            coarse=True,
            p_c_in_w_m=(mode.e_m, mode.n_m, view.ground_m + view.agl_m),
            q_w_c=quat_from_rot(view.r_w_c),
            cov=tuple(float(v) for v in cov.ravel()),
        )

    def _judged(self, answer: MapMatch, fix: Fix | None, view: View) -> MapMatch:
        if fix is None:
            return msgspec.structs.replace(answer, verdict=Verdict.DEGENERATE)
        pnp = fix.pnp
        verdict = pnp.verdict
        if pnp.fit is None:
            return msgspec.structs.replace(answer, verdict=verdict, inliers=int(pnp.inliers.sum()))
        p = pnp.fit.p_c_in_w_m
        drift = np.array([p[0] - answer.mode_e_m, p[1] - answer.mode_n_m])
        if float(np.hypot(*drift)) > MODE_DRIFT * view.agl_m:
            verdict = Verdict.DEGENERATE
        matches = np.column_stack([fix.xy, fix.points_w_m, fix.weights])[pnp.inliers]
        cov = tangent_to_world(pnp.fit.cov, pnp.fit.r_w_c)
        return msgspec.structs.replace(
            answer,
            verdict=verdict,
            matches=[(float(a), float(b), float(c), float(d), float(e), float(f)) for a, b, c, d, e, f in matches],
            p_c_in_w_m=(float(p[0]), float(p[1]), float(p[2])),
            q_w_c=quat_from_rot(pnp.fit.r_w_c),
            cov=tuple(float(v) for v in cov.ravel()),
            inliers=int(pnp.inliers.sum()),
            reprojection_px=float(np.sqrt(np.mean(pnp.fit.residuals**2))) * view.agl_m / fix.cell_m,
        )


def make_node(ctx: NodeContext) -> AnchorNode:
    """Opens the map and the model, before take-off. Raises ConfigError, MapError, ModelError."""
    wanted = ctx.config.map
    trusted = trusted_keys(wanted.trusted_keys, required=wanted.require_signature)
    package = MapPackage.open(ctx.map_path, trusted=trusted) if ctx.map_path is not None else None
    try:
        describer = open_describer(ctx.config.models.xfeat)
    except ModelFileError as error:
        raise ModelError(str(error)) from None
    stated = None if package is None else package.manifest.ce90_m
    ce90_m = ctx.config.map.ce90_m if stated is None else stated
    return AnchorNode(ctx.frames, package, describer, ce90_m / CE90_SIGMAS)
