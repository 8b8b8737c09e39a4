"""Matching power of single frames: gradients, and the descriptors of each model, side by side.

A frame is looked for with a prior, by the code that flies: the correlation surfaces update the belief, and the patches
of the frame choose one of its modes or none, at a false-alarm rate of 1 in 1000 by the null model of the map. Each
frame is looked for mirrored, too: it cannot be on the map."""

import functools
import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from terrafix.anchor.matching.descriptor_cache import Describer
from terrafix.anchor.matching.frame_matcher import (
    FIX_GSD_PER_AGL,
    CorrelationResult,
    FrameMatcher,
    View,
    bounded_cells,
    hypotheses_of,
)
from terrafix.anchor.matching.point_mass_filter import MAX_HALF_CELLS, Belief, Mode, belief_cell_m
from terrafix.anchor.relocalization.position_prior import distance_outside_m
from terrafix.anchor.verification.single_frame import MAX_MODES, localize_single_frame
from terrafix.core.camera import CameraCalibration
from terrafix.core.errors import MapError, OutputError
from terrafix.core.geodesy import LocalFrame, local_rotation_up
from terrafix.core.node import Image
from terrafix.core.toml_file import read_toml
from terrafix.map.package import LocalMap, MapPackage
from terrafix.messages import Verdict
from terrafix.vision.sources import open_source
from terrafix_engines.features import open_describer
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_tools.evaluate import read_truth
from terrafix_tools.flight_map import package_of
from terrafix_tools.map_probe import reported_view
from terrafix_tools.mapping.check.sight import YAW_SIGMA_RAD
from terrafix_tools.models.known import as_model_errors
from terrafix_tools.models.two_dates import CAMERA, TwoDates

GRADIENTS = "gradients"
FALSE_ALARMS = 1e-3
NEAR_M = 10.0
APART = 0.25  # heights: two places within it are one, whose patches are the same
PRIOR_SIGMAS = 2.0  # largest distance of the truth from the centre of the prior, 1-sigmas
WHOLE_MAP = math.inf
SEED = 11


class MatchSet(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``camera`` and ``map``: images of one place at two dates, seen from ``agl_m``; or ``flight``: a folder with its
    map and truth.csv, every ``every``-th frame. Paths are relative to the data folder."""

    name: str
    camera: str = ""
    map: str = ""
    agl_m: float = 120.0
    flight: str = ""
    every: int = 1


@dataclass(frozen=True)
class Frame:
    """``predicted``: at the true place, with the heading and height that are reported."""

    image: Image
    predicted: View
    near_m: float


@dataclass(frozen=True)
class Ground:
    """A map with frames over it, at least one."""

    source: LocalMap
    camera: CameraCalibration
    frames: list[Frame]


@dataclass(frozen=True)
class Look:
    """``right``: the heaviest mode is; ``placed``: whether the chosen one is, None: none was chosen; ``lead_nats``: log
    ratio of the masses of the two heaviest modes; ``margin_sd``: standardised correlation at the right place less that
    of the best wrong one, NaN with several kinds of surfaces."""

    right: bool
    placed: bool | None
    lead_nats: float
    margin_sd: float
    cpu_ms: float


def measure_matching(
    sets_path: Path,
    data: Path,
    names: list[str],
    folder: str,
    *,
    only: list[str],
    priors_m: list[float],
    unknown_heading: bool,
    places: int,
    out: Path,
) -> None:
    """Prints a table per set, writes ``out``. Raises MapError, SourceError, ModelError, OutputError."""
    sets = [one for one in read_sets(sets_path) if not only or one.name in only]
    rows: list[dict[str, Any]] = []
    with as_model_errors():
        describers: dict[str, Describer] = {GRADIENTS: GradientDescriber()}
        describers |= {name: open_describer(name, folder) for name in names}
        for one in sets:
            ground = ground_of(one, data, places)
            for prior_m in priors_m:
                for yaw_known in (True, False) if unknown_heading else (True,):
                    rows += [
                        {"set": one.name, "prior_m": prior_m, "heading": "known" if yaw_known else "unknown", **row}
                        for row in _methods_on(ground, describers, prior_m, yaw_known=yaw_known)
                    ]
                    _show(rows[-len(describers) * 2 + 1 :])
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None


def read_sets(path: Path) -> list[MatchSet]:
    """The sets of a TOML list. Raises MapError."""
    try:
        return msgspec.convert(read_toml(path), dict[str, list[MatchSet]])["set"]
    except (OSError, KeyError, ValueError, msgspec.ValidationError) as error:
        raise MapError(f"{path}: no list of sets ({error}); docs/models.md shows one") from None


def ground_of(one: MatchSet, folder: Path, places: int) -> Ground:
    """Raises MapError, SourceError."""
    if not one.flight:
        dates = TwoDates(folder / one.camera, folder / one.map)
        source, _ = dates.open()
        rng = np.random.default_rng(SEED)
        frames = []
        for true in dates.draw(places, one.agl_m, SEED):
            yaw_rad = -true.heading_rad + rng.normal(0.0, YAW_SIGMA_RAD)
            e_m, n_m = (float(v) for v in true.place_m)
            predicted = replace(
                true.predicted,
                e_m=e_m,
                n_m=n_m,
                r_w_c=local_rotation_up(yaw_rad) @ true.predicted.r_w_c,
                yaw_sigma_rad=YAW_SIGMA_RAD,
            )
            frames.append(Frame(true.frame, predicted, max(NEAR_M, belief_cell_m(one.agl_m, source.gsd_m))))
        return Ground(source, CAMERA, frames)
    return _flight(folder / one.flight, one.every, places)


def _flight(folder: Path, every: int, places: int) -> Ground:
    opened = open_source(str(folder))
    origin, truth = opened.origin(), read_truth(folder / "truth.csv")
    stated = str(read_toml(folder / "flight.toml").get("map", ""))
    local = LocalFrame(origin.lat_deg, origin.lon_deg)
    source = MapPackage.open(package_of(folder / stated)).bind(local)
    frames: list[Frame] = []
    for i, shot in enumerate(opened.shots()):
        viewed = reported_view(shot, origin) if i % every == 0 else None
        if viewed is None or (true := truth.get(shot.frame.file)) is None or len(frames) >= places:
            continue
        image, view = viewed
        e_m, n_m = local.to_local(true.lat_deg, true.lon_deg)
        tilt_rad = math.radians(math.hypot(origin.attitude_sigma_deg, origin.camera.mount_tolerance_deg))
        view = replace(
            view,
            e_m=e_m,
            n_m=n_m,
            yaw_sigma_rad=math.radians(origin.yaw_sigma_deg),
            scale_sigma=origin.agl_sigma_m / view.agl_m,
            tilt_sigma_rad=tilt_rad,
        )
        # The place that a frame seems to be taken from is off by the error of the tilt.
        frames.append(Frame(image, view, math.hypot(NEAR_M, view.agl_m * tilt_rad)))
    return Ground(source, CameraCalibration.of(origin.camera), frames)


def _methods_on(
    ground: Ground, describers: dict[str, Describer], prior_m: float, *, yaw_known: bool
) -> Iterator[dict[str, Any]]:
    """A row of the table for each describer, and for each model together with the gradients."""
    matchers = {name: FrameMatcher(ground.camera, ground.source, one) for name, one in describers.items()}
    names = [(name,) for name in matchers] + [(GRADIENTS, name) for name in matchers if name != GRADIENTS]
    looks: dict[tuple[str, ...], list[Look]] = {name: [] for name in names}
    nulls: dict[tuple[str, ...], list[Look]] = {name: [] for name in names}
    rng = np.random.default_rng(SEED)
    for frame in ground.frames:
        view = frame.predicted if yaw_known else replace(frame.predicted, yaw_sigma_rad=math.pi)
        belief_at = _prior(view, prior_m, ground.source, rng, matchers[GRADIENTS])
        for mirrored in (False, True):
            image = np.ascontiguousarray(frame.image[:, ::-1]) if mirrored else frame.image
            seen = {n: _correlated(n, one, matchers[n], image, view, belief_at()) for n, one in describers.items()}
            for name in names:
                chosen = [seen[one] for one in name]
                place = functools.partial(_place, image, view, chosen[-1][0], matchers[GRADIENTS])
                (nulls if mirrored else looks)[name].append(_look(chosen, frame, belief_at(), place))
    for name in names:
        yield _summary("+".join(name), looks[name], nulls[name])


def _place(
    image: Image, view: View, found: CorrelationResult, matcher: FrameMatcher, modes: list[Mode]
) -> np.ndarray | None:
    """East and north of the place that the frame is given, with its stated tilt."""
    placed = localize_single_frame(image, view, found, modes, matcher, math.log(FALSE_ALARMS))
    if placed is None:
        return None
    fit = None if placed.fix is None else placed.place.fix.pnp.fit
    return np.array([placed.mode.e_m, placed.mode.n_m]) if fit is None else fit.p_c_in_w_m[:2]


def _prior(
    view: View, prior_m: float, source: LocalMap, rng: np.random.Generator, matcher: FrameMatcher
) -> Callable[[], Belief]:
    """The belief of a position that is known to ``prior_m`` (1-sigma), which includes the true one."""
    e_min, n_min, e_max, n_max = source.bounds_m
    half_m = 0.5 * max(e_max - e_min, n_max - n_min)
    sigma_m, (e_m, n_m) = min(prior_m, half_m), (0.5 * (e_min + e_max), 0.5 * (n_min + n_max))
    while prior_m < half_m:
        off_m = rng.normal(0.0, sigma_m, 2)
        e_m, n_m = view.e_m + float(off_m[0]), view.n_m + float(off_m[1])
        if math.hypot(*off_m) <= PRIOR_SIGMAS * sigma_m and distance_outside_m((e_m, n_m), source.bounds_m) == 0.0:
            break
    cell_m = belief_cell_m(view.agl_m, matcher.correlation_cell_m(view.agl_m))
    while 2.0 * sigma_m > MAX_HALF_CELLS * cell_m:
        cell_m *= 2.0
    return lambda: Belief(e_m, n_m, sigma_m, cell_m)


def _correlated(
    method: str, describer: Describer, matcher: FrameMatcher, image: Image, view: View, belief: Belief
) -> tuple[CorrelationResult, float]:
    """With its processor time, ms; the map's descriptors are there already, as for all frames but a flight's first."""
    began_s = time.process_time()
    if method == GRADIENTS:
        found = matcher.correlate(image, view, belief)
    else:
        gsd_m = matcher.cell_m(view.agl_m, FIX_GSD_PER_AGL[describer.name])
        gsd_m, pool = bounded_cells(gsd_m, describer.stride, belief)
        pyramid = matcher.pyramid(image, describer)
        found = matcher.correlate_on(pyramid, view, belief, hypotheses_of(view), gsd_m, pool, describer)
    return found, (time.process_time() - began_s) * 1e3


def _look(
    seen: list[tuple[CorrelationResult, float]],
    frame: Frame,
    belief: Belief,
    place: Callable[[list[Mode]], np.ndarray | None],
) -> Look:
    """The belief after all of ``seen``, which are of the same frame, and the place that ``place`` chooses."""
    used = [found for found, _ in seen if found.verdict is Verdict.ACCEPTED]
    for found in used:
        belief.update(found.surfaces, 1.0)
    modes = belief.modes(MAX_MODES)

    def is_right(e_m: float, n_m: float) -> bool:
        return math.hypot(e_m - frame.predicted.e_m, n_m - frame.predicted.n_m) <= frame.near_m

    chosen = place(modes) if used else None
    return Look(
        right=is_right(modes[0].e_m, modes[0].n_m),
        placed=None if chosen is None else is_right(float(chosen[0]), float(chosen[1])),
        lead_nats=math.log(modes[0].mass / max(modes[0].second_mass, 1e-12)),
        margin_sd=_margin_sd(seen[0][0], frame) if len(seen) == 1 else math.nan,
        cpu_ms=sum(cpu_ms for _, cpu_ms in seen),
    )


def _margin_sd(found: CorrelationResult, frame: Frame) -> float:
    """The right place's lead over the best wrong one of all surfaces, standard deviations."""
    right, wrong = -math.inf, -math.inf
    for surface in found.surfaces:
        z = np.nan_to_num(surface.z, nan=-9.0, neginf=-9.0)
        rows, columns = np.indices(z.shape, sparse=True)
        off_m = np.hypot(
            surface.e0_m + columns * surface.cell_m - frame.predicted.e_m,
            surface.n0_m - rows * surface.cell_m - frame.predicted.n_m,
        )
        near_m = max(frame.near_m, surface.cell_m)
        right = max(right, float(z.max(where=off_m <= near_m, initial=-9.0)))
        wrong = max(wrong, float(z.max(where=off_m > max(APART * frame.predicted.agl_m, near_m), initial=-9.0)))
    return right - wrong


def _summary(method: str, looks: list[Look], mirrored: list[Look]) -> dict[str, Any]:
    return {
        "method": method,
        "frames": len(looks),
        "placed": float(np.mean([one.placed is True for one in looks])),
        "wrong": sum(one.placed is False for one in looks),
        "mirrored": sum(one.placed is not None for one in mirrored),
        "right": float(np.mean([one.right for one in looks])),
        "lead_nats": float(np.median([one.lead_nats if one.right else -one.lead_nats for one in looks])),
        "margin_sd": float(np.median([one.margin_sd for one in looks])),
        "cpu_ms": float(np.median([one.cpu_ms for one in looks])),
    }


def _show(rows: list[dict[str, Any]]) -> None:
    head = rows[0]
    prior = "whole map" if math.isinf(head["prior_m"]) else f"prior {head['prior_m']:g} m"
    title = f"{head['set']}, {prior}, heading {head['heading']}, {head['frames']} frames"
    table = Table(title=title, title_justify="left", box=box.SIMPLE, pad_edge=False)
    for name in ("method", "placed", "wrong", "mirrored", "best is right", "leads by", "margin", "cpu"):
        table.add_column(name, justify="left" if name == "method" else "right", no_wrap=True)
    for row in rows:
        placed, right = (f"{100 * row[key]:.0f} %" for key in ("placed", "right"))
        sd = "-" if math.isnan(row["margin_sd"]) else f"{row['margin_sd']:.1f} sd"
        counts = (f"{row[key]}" for key in ("wrong", "mirrored"))
        lead, cpu = f"{row['lead_nats']:.1f} nats", f"{row['cpu_ms']:.0f} ms"
        table.add_row(row["method"], placed, *counts, right, lead, sd, cpu)
    Console(width=120).print(table)
