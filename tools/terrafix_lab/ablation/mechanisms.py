"""Integrity mechanisms, and what each does when it is replaced by one that does nothing."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

VARIABLE = "TERRAFIX_ABLATION"  # name of the mechanism that the processes of a command replace


@dataclass(frozen=True)
class Mechanism:
    """Class ``owner`` of ``module``, and its members that are replaced: methods, or properties."""

    module: str
    owner: str
    members: dict[str, Any]

    def replace(self) -> None:
        """In this process."""
        owner = getattr(importlib.import_module(self.module), self.owner)
        for name, member in self.members.items():
            if not hasattr(owner, name):
                raise AttributeError(f"{self.owner} has no {name}; correct the table of mechanisms")
            setattr(owner, name, member)


def _returns(value: Any = None) -> Callable[..., Any]:
    return lambda *_, **__: value


def _join(images: Any, frame: Any) -> None:
    frame.fragment.join()
    images.end()


def _confirm(fragment: Any, _t_s: float, _evidence: Any, *, by_duration: bool = True) -> None:
    fragment.frames += 1
    fragment.join()


_ANCHOR, _INTEGRITY = "terrafix.anchor.verification", "terrafix.estimator.integrity"
_MONITORS = "terrafix.estimator.monitors"
MECHANISMS: dict[str, Mechanism] = {
    "lock": Mechanism(f"{_ANCHOR}.lock_monitor", "LockMonitor", {"update": _returns()}),
    "probation": Mechanism(
        f"{_ANCHOR}.probation",
        "Probation",
        {"update": _returns(), "passed": property(_returns(True)), "wrong_probability": property(_returns(0.0))},
    ),
    "place": Mechanism(f"{_ANCHOR}.converged_place", "PlaceTest", {"update": lambda *_, dominant: dominant}),
    "map": Mechanism(
        f"{_INTEGRITY}.other_ground",
        "OtherGround",
        {"on_rejected": _returns(), "on_pose": _returns(), "on_nothing": _returns()},
    ),
    "alternative": Mechanism(
        f"{_INTEGRITY}.alternative_position",
        "AlternativePosition",
        {"spawn": _returns(), "switch": _returns()},
    ),
    "modes": Mechanism(f"{_INTEGRITY}.position_hypotheses", "PositionHypotheses", {"update_modes": _returns()}),
    "fragments": Mechanism(f"{_INTEGRITY}.fragments", "Fragment", {"add_frame": _confirm}),
    "hits": Mechanism(f"{_INTEGRITY}.fragments", "MapHitRate", {"update": _returns()}),
    "contradicted": Mechanism(f"{_INTEGRITY}.contradicted_images", "ContradictedImages", {"on_map_match": _join}),
    "correlation": Mechanism(f"{_INTEGRITY}.correlated_fixes", "CorrelatedFixes", {"information_share": _returns(1.0)}),
    "static": Mechanism(f"{_INTEGRITY}.static_picture", "StaticPicture", {"is_frozen": _returns(False)}),
    "signs": Mechanism(f"{_INTEGRITY}.signed_innovations", "SignedInnovations", {"add": _returns()}),
    "time": Mechanism(f"{_INTEGRITY}.time_offset", "TimeOffset", {"add": _returns()}),
    "telemetry": Mechanism(f"{_INTEGRITY}.innovation_gate", "InnovationGate", {"rejection": _returns()}),
    "registration": Mechanism(f"{_MONITORS}.registration", "Registration", {"add_attempt": _returns()}),
    "levelling": Mechanism(f"{_MONITORS}.levelling", "LevellingMonitor", {"add": _returns()}),
    "turns": Mechanism(f"{_MONITORS}.turns", "TurnMonitor", {"add": _returns()}),
    "inertial": Mechanism(f"{_MONITORS}.inertial", "InertialMonitor", {"compare": _returns()}),
    "offsets": Mechanism(f"{_MONITORS}.map_offsets", "OffsetMonitor", {"add": _returns()}),
}
