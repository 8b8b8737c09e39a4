"""Consistency of the claimed covariance over flights with correct inputs: NEES, coverage, and the terms of the claim.

python -m terrafix_tools.bench.claims REPLAY [REPLAY ...] [--truth FILE] [--json FILE]

A REPLAY is an output folder of ``terrafix replay``; the truth is the ``truth.csv`` of the flight named in its summary,
or ``--truth`` (with one REPLAY). Errors and claims are those of the immediate estimates; the error of the truth
(``[truth] sigma_m``) is added to the claim. The map error is constant over a flight. Therefore flights have equal
weights, whatever their number of frames, and the standard error of NEES follows from the spread between flights. The
claimed variance is split into its terms: map, principal point, an upper bound of the time offset, and the rest (graph
and position hypotheses).

Simulated flights often use an exact map, while its package states an error. For these, the table has the NEES that is
expected with a map error as claimed: below 1, the rest of the claim is too wide."""

import argparse
import math
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import typer

from terrafix.core.camera import Mount
from terrafix.core.errors import EvaluationError, TerrafixError, UsageError
from terrafix.core.gate import CHI2_95
from terrafix.core.geodesy import rot_from_quat
from terrafix.estimator.integrity.time_offset import PRIOR_SIGMA_S
from terrafix.estimator.measurements.principal_point import PrincipalPointFilter
from terrafix.messages import CalibrationEstimate, Camera, LensEstimate, NavEstimate, Origin
from terrafix.recorder.reader import read_flight
from terrafix_tools.bench.result_file import write_result
from terrafix_tools.estimates import ESTIMATES, Row, read_rows
from terrafix_tools.evaluate import compare, mahalanobis2, read_summary, read_truth, truth_sigma_of

TRUTH = "truth.csv"
MEDIAN_SIGMAS = 1.1774  # median of a circular normal error, in its sigmas: sqrt(2 ln 2)


@dataclass(frozen=True)
class Claims:
    """One flight. Variances and squared errors are means over its frames, per horizontal axis [m^2]."""

    flight: str
    frames: int
    inside_95: float  # share of frames whose truth is in the claimed 95 % ellipse
    nees: float  # per degree of freedom: 1 if the claims are consistent
    nees_if_map_off: float  # expected NEES if an exact map had its claimed error
    median_error_m: float  # horizontal
    median_claim_m: float  # 1-sigma per horizontal axis
    error_m2: float
    bias_m2: float  # of the mean error of the flight
    claimed_m2: float  # includes truth_m2
    truth_m2: float
    map_m2: float
    principal_m2: float
    time_m2: float  # upper bound, from the prior of the time offset

    @property
    def rest_m2(self) -> float:
        return self.claimed_m2 - self.truth_m2 - self.map_m2 - self.principal_m2

    @property
    def ratio(self) -> float:
        """Claimed 1-sigma divided by the RMS error."""
        return _root(self.claimed_m2, self.error_m2)

    @property
    def median_ratio(self) -> float:
        """The same ratio of medians, which outliers among the claims do not affect."""
        return _root(self.median_claim_m**2, (self.median_error_m / MEDIAN_SIGMAS) ** 2)


@dataclass(frozen=True)
class Pool:
    """Several flights with equal weights. ``nees_sigma``: standard error of the mean, from the spread between them."""

    flights: int
    inside_95: float
    nees: float
    nees_if_map_off: float
    nees_sigma: float | None
    ratio: float
    median_ratio: float
    shares: dict[str, float]  # of the claimed variance


def claims_of(replay: Path, truth_path: Path | None = None) -> Claims:
    """-> the claims of one replay. ``truth_path``: default: truth.csv of its flight.

    Raises EvaluationError and SourceError: a file is missing or does not fit."""
    if truth_path is None:
        truth_path = _truth_beside(replay)
    truth_m2 = (truth_sigma_of(truth_path) or 0.0) ** 2
    located = [c for c in compare(read_rows(replay / ESTIMATES), read_truth(truth_path)) if c.error_m is not None]
    errors, claimed, nees, information = [], [], [], []
    for c in located:
        d2 = mahalanobis2(c.row, c.error_e_m or 0.0, c.error_n_m or 0.0, math.sqrt(truth_m2))
        if math.isfinite(d2) and c.row.sigma_e_m is not None and c.row.sigma_n_m is not None:
            nees.append(d2)
            errors.append((c.error_e_m, c.error_n_m))
            information.append(_information(c.row, truth_m2))
            claimed.append((c.row.sigma_e_m**2 + c.row.sigma_n_m**2) / 2.0 + truth_m2)
    if not nees:
        raise EvaluationError(f"{replay}: no frame has both a claim and truth; same flight? check {truth_path}")
    terms = _terms(replay)
    errors_m = np.array(errors, dtype=np.float64)
    return Claims(
        flight=replay.name,
        frames=len(nees),
        inside_95=float(np.mean(np.array(nees) <= CHI2_95)),
        nees=float(np.mean(nees)) / 2.0,
        nees_if_map_off=float(np.mean(nees) + terms[0] * np.mean(information)) / 2.0,
        median_error_m=float(np.median(np.hypot(errors_m[:, 0], errors_m[:, 1]))),
        median_claim_m=math.sqrt(float(np.median(claimed))),
        error_m2=float(np.mean(errors_m**2)),
        bias_m2=float(np.mean(errors_m.mean(0) ** 2)),
        claimed_m2=float(np.mean(claimed)),
        truth_m2=truth_m2,
        map_m2=float(terms[0]),
        principal_m2=float(terms[1]),
        time_m2=float(terms[2]),
    )


def pool(flights: list[Claims]) -> Pool:
    nees = [f.nees for f in flights]
    claimed_m2 = sum(f.claimed_m2 for f in flights)
    names = ("map", "principal", "rest", "truth")
    return Pool(
        flights=len(flights),
        inside_95=float(np.mean([f.inside_95 for f in flights])),
        nees=float(np.mean(nees)),
        nees_if_map_off=float(np.mean([f.nees_if_map_off for f in flights])),
        nees_sigma=float(np.std(nees, ddof=1)) / math.sqrt(len(nees)) if len(nees) > 1 else None,
        ratio=_root(claimed_m2, sum(f.error_m2 for f in flights)),
        median_ratio=_root(
            sum(f.median_claim_m**2 for f in flights),
            sum(f.median_error_m**2 for f in flights) / MEDIAN_SIGMAS**2,
        ),
        shares={name: sum(getattr(f, f"{name}_m2") for f in flights) / claimed_m2 for name in names},
    )


def table(flights: list[Claims]) -> list[str]:
    """-> rows of a Markdown table (metres per axis), and one line for the pool."""
    lines = [
        "| flight | frames | inside 95 % | NEES / dof | ... if the map is off | error, rms | shared by the flight "
        "| claimed | map | principal point | time offset, at most | rest | claimed / error | ... of medians |",
        "|---" * 14 + "|",
    ]
    for f in flights:
        parts = (f.error_m2, f.bias_m2, f.claimed_m2, f.map_m2, f.principal_m2, f.time_m2, f.rest_m2)
        metres = " | ".join(f"{math.sqrt(max(m2, 0.0)):.1f} m" for m2 in parts)
        lines.append(
            f"| {f.flight} | {f.frames} | {f.inside_95:.0%} | {f.nees:.2f} "
            f"| {f.nees_if_map_off:.2f} | {metres} "
            f"| {f.ratio:.1f} | {f.median_ratio:.1f} |"
        )
    p = pool(flights)
    sigma = "" if p.nees_sigma is None else f" +- {p.nees_sigma:.2f}"
    shares = ", ".join(f"{name} {share:.0%}" for name, share in p.shares.items())
    lines += [
        "",
        f"{p.flights} flights: inside {p.inside_95:.1%}, NEES / dof {p.nees:.2f}{sigma}, "
        f"{p.nees_if_map_off:.2f} if maps are off, claimed / error {p.ratio:.1f}, of medians {p.median_ratio:.1f}; "
        f"of the claimed variance {shares}",
    ]
    return lines


def _information(row: Row, truth_m2: float) -> float:
    """-> trace of the inverse of the claimed covariance (2, 2) of a row [1/m^2]."""
    ee, nn = (row.sigma_e_m or 0.0) ** 2 + truth_m2, (row.sigma_n_m or 0.0) ** 2 + truth_m2
    return (ee + nn) / (ee * nn - (row.cov_en_m2 or 0.0) ** 2)


def _root(claimed_m2: float, error_m2: float) -> float:
    return math.sqrt(claimed_m2 / error_m2) if error_m2 > 0.0 else math.inf


def _truth_beside(replay: Path) -> Path:
    source = read_summary(replay).get("source")
    path = Path(str(source)) / TRUTH
    if source is None or not path.is_file():
        raise EvaluationError(f"{replay}: its flight has no {TRUTH} ({path}); give one with --truth")
    return path


def _terms(replay: Path) -> np.ndarray:
    """-> (3,) m^2 per axis, means over the frames: contributions of map, principal point and time offset (upper bound)
    to the claimed variance."""
    camera: Camera | None = None
    lens: LensEstimate | None = None
    last: dict[int, tuple[float, float, float]] = {}  # of the last estimate of a frame, which is the one in the table
    for _, _, message in read_flight(replay):
        if isinstance(message, Origin):
            camera = message.camera
        elif isinstance(message, CalibrationEstimate):
            lens = message.lens
        elif isinstance(message, NavEstimate) and camera is not None:
            speed2 = message.velocity_enu_mps[0] ** 2 + message.velocity_enu_mps[1] ** 2
            last[message.frame_id] = (
                message.map_sigma_m**2,
                _principal_m2(message, camera, lens),
                PRIOR_SIGMA_S**2 * speed2 / 2.0,
            )
    return np.mean(list(last.values()), axis=0) if last else np.zeros(3)


def _principal_m2(estimate: NavEstimate, camera: Camera, lens: LensEstimate | None) -> float:
    """-> variance of the position from the principal point, per axis [m^2]."""
    jacobian = estimate.agl_m * (rot_from_quat(estimate.q_w_b) @ Mount.of(camera).r_b_c())[:2, :2]
    return float(np.trace(PrincipalPointFilter(camera, lens).shift(jacobian)[1])) / 2.0


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="claims", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("replays", type=Path, nargs="+", metavar="REPLAY")
    parser.add_argument("--truth", type=Path, help="truth.csv, of the only REPLAY")
    parser.add_argument("--json", type=Path, dest="json_path")
    given = parser.parse_args(arguments)
    try:
        if given.truth and len(given.replays) > 1:
            raise UsageError("--truth is that of one flight; give one REPLAY with it")
        flights = [claims_of(replay, given.truth) for replay in given.replays]
        write_result(given.json_path, {"flights": [asdict(f) for f in flights], "pool": asdict(pool(flights))})
    except TerrafixError as error:
        typer.echo(f"claims: {error}", err=True)
        sys.exit(error.exit_code)
    for line in table(flights):
        typer.echo(line)


if __name__ == "__main__":
    main()
