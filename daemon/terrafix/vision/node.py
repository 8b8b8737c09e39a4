"""Vision node: publishes one Odometry per Frame, with its verdict."""

from collections.abc import Iterable
from dataclasses import replace

import msgspec
import numpy as np

from terrafix.core.camera import CameraCalibration, Mount
from terrafix.core.errors import ModelError
from terrafix.core.node import Edge, FrameStore, NodeContext
from terrafix.messages import (
    OVERTAKEN,
    Frame,
    KeyframeLink,
    Message,
    ModelChange,
    ModelEvent,
    Odometry,
    Origin,
    Verdict,
)
from terrafix.vision.edge import make_edge as make_source_edge
from terrafix.vision.feature_tracker import FrameTracker, Motion
from terrafix.vision.learned_features import LearnedMatcher
from terrafix.vision.relocalization import RelocalizationSearch
from terrafix.vision.repeated_picture import PictureHistory, Repeat
from terrafix_engines.features import open_point_features
from terrafix_engines.runtime import ModelFileError, ModelRunError

SIFT = "sift"  # [vision] features without a model [spec: config/default.toml]


class VisionNode:
    """In: Origin, Frame. Out: Odometry, Relocalization, ModelEvent."""

    def __init__(
        self,
        frames: FrameStore,
        *,
        restarted: bool = False,
        learned: LearnedMatcher | None = None,
        not_opened: ModelEvent | None = None,
    ) -> None:
        """``restarted``: in flight. Fragments of the process before keep their numbers. ``learned``: features instead
        of SIFT; ``not_opened``: published at the start, where the configured ones could not be opened."""
        self._frames = frames
        self._restarted = restarted
        self._learned, self._model_event = learned, not_opened
        self._origin: Origin | None = None
        self._tracker: FrameTracker | None = None
        self._history = PictureHistory()
        self._search: RelocalizationSearch | None = None
        self._busy = False  # frames were dropped since the last one that was registered

    def on(self, message: Message) -> Iterable[Message]:
        match message:
            case Origin() if message != self._origin:  # published again after a restart of the source
                self._origin, self._tracker, self._search = message, None, None
                self._history = PictureHistory()
            case Frame():
                yield from self._process(message)
            case _:
                pass

    def tick(self, now_ns: int) -> Iterable[Message]:
        return ()

    def _process(self, frame: Frame) -> Iterable[Message]:
        image = None if frame.error else self._frames.get(frame.frame_id)
        if self._tracker is None and self._origin is not None:
            # Frame ids go on after a restart, and there were not more fragments than frames.
            self._tracker = self._new_tracker(self._origin, frame.frame_id if self._restarted else 0)
            self._search = RelocalizationSearch(
                CameraCalibration.of(self._origin.camera), Mount.of(self._origin.camera)
            )
        if self._model_event is not None:
            yield msgspec.structs.replace(self._model_event, t_ns=frame.t_ns)
            self._model_event = None
        self._busy = self._busy or frame.error == OVERTAKEN
        if image is None or self._tracker is None or self._search is None:
            yield _without_motion(frame, Verdict.OVERTAKEN if frame.error == OVERTAKEN else Verdict.BAD_IMAGE)
            return
        gray = self._tracker.working_copy(image)
        repeat = self._history.classify(gray)
        if repeat in (Repeat.IDENTICAL, Repeat.OLDER):  # a stale buffer does not show the current position
            yield _without_motion(frame, Verdict.STALLED)
            return
        try:
            motion = self._tracker.register(frame.frame_id, gray, image)
        except ModelRunError as error:
            assert self._origin is not None and self._learned is not None
            yield _given_up(frame.t_ns, self._learned.name, str(error))
            self._learned = None
            self._tracker = self._new_tracker(self._origin, frame.frame_id)
            motion = self._tracker.register(frame.frame_id, gray, image)
        if self._learned is not None:
            motion = replace(motion, view=None)  # relocalisation compares features of SIFT
        yield _odometry(frame, motion, static=repeat is Repeat.PREVIOUS)
        found = self._search.on_frame(frame, gray, motion, busy=self._busy)  # after the odometry, which must not wait
        self._busy = False
        if found is not None:
            yield found

    def _new_tracker(self, origin: Origin, first_fragment_id: int) -> FrameTracker:
        camera, mount = CameraCalibration.of(origin.camera), Mount.of(origin.camera)
        return FrameTracker(camera, first_fragment_id, mount, self._learned)


def _odometry(frame: Frame, motion: Motion, *, static: bool) -> Odometry:
    return Odometry(
        t_ns=frame.t_ns,
        frame_id=frame.frame_id,
        keyframe_id=motion.keyframe_id,
        verdict=motion.verdict,
        two_view=_pairs(motion.two_view),
        sigma_norm=motion.sigma_norm,
        inliers=motion.inliers,
        tracked=motion.tracked,
        becomes_keyframe=motion.becomes_keyframe,
        static=static,
        previous_keyframe_id=motion.previous_keyframe_id,
        three_view=[
            (float(a), float(b), float(c), float(d), float(e), float(f)) for a, b, c, d, e, f in motion.three_view
        ],
        three_view_sigma_norm=motion.three_view_sigma_norm,
        fragment_id=motion.fragment_id,
        links=[
            KeyframeLink(
                keyframe_id=link.keyframe_id,
                two_view=_pairs(link.two_view),
                sigma_norm=link.sigma_norm,
                inliers=link.inliers,
                tracked=link.tracked,
            )
            for link in motion.links
        ],
    )


def _pairs(two_view: np.ndarray) -> list[tuple[float, float, float, float]]:
    return [(float(a), float(b), float(c), float(d)) for a, b, c, d in two_view]


def _without_motion(frame: Frame, verdict: Verdict) -> Odometry:
    return Odometry(t_ns=frame.t_ns, frame_id=frame.frame_id, keyframe_id=frame.frame_id, verdict=verdict)


def _given_up(t_ns: int, model: str, reason: str) -> ModelEvent:
    detail = f"{reason}; odometry continues with SIFT"
    return ModelEvent(t_ns=t_ns, model=model, change=ModelChange.GIVEN_UP, provider="", detail=detail)


def make_node(ctx: NodeContext) -> VisionNode:
    """Opens the model of the features before take-off. Raises ModelError. After a restart in flight one that cannot be
    opened is replaced by SIFT."""
    name, restarted = ctx.config.vision.features, ctx.epoch_ns is not None
    if name == SIFT:
        return VisionNode(ctx.frames, restarted=restarted)
    try:
        learned = LearnedMatcher(*open_point_features(name, ctx.config.models.folder))
    except ModelFileError as error:
        if not restarted:
            raise ModelError(f"[vision] features: {error}") from None
        return VisionNode(ctx.frames, restarted=True, not_opened=_given_up(0, name, str(error)))
    return VisionNode(ctx.frames, restarted=restarted, learned=learned)


def make_edge(ctx: NodeContext) -> Edge:
    return make_source_edge(ctx)
