"""A computer that heats up and cools down in flight: thermal bands, and what their switches do to the accuracy.

python -m terrafix_tools.bench.heat_cycle OUT [--seconds S] [--seed N] [--json FILE]

A copter flies the two legs of the fault matrix forth and back while the thermal zone in a simulated sysfs goes from 40
to 96 and back to 40 C, with a scatter of 1 C. From the record: the bands against those that the configuration asks for,
and the change of sigma (of the worst horizontal axis) from the estimate before a switch to the one after it, beside
that of all others. Between the two lies a frame, so that they have what it adds as well.
Exit code 1: another sequence of bands, or a step at a switch of more than MOST_STEP."""

import itertools
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from terrafix.core.config import HealthSection
from terrafix.messages import Health, NavEstimate, ThermalBand
from terrafix.recorder.reader import read_flight
from terrafix_tools.bench.result_file import write_result
from terrafix_tools.chaos.rig import COOL_MC, Rig
from terrafix_tools.chaos.scene import Scene
from terrafix_tools.chaos.shuttle import RUN, shuttle_in
from terrafix_tools.standalone import run_standalone

HOTTEST_MC = 96_000
SCATTER_MC = 1_000
LEAD_S = 15.0  # cool, for the first fixes
MOST_STEP = 0.10  # [spec: no step of sigma above 10 % from the switch itself]
PERIOD_S = 0.25  # of the changes of the zone
OTHER = 1  # exit code
BANDS = [ThermalBand.NORMAL, ThermalBand.HOT, ThermalBand.CRITICAL, ThermalBand.HOT, ThermalBand.NORMAL]


def temperature_mc(share: float, random: np.random.Generator) -> int:
    """``share`` of the cycle, 0 to 1: up, and down again."""
    rise = 1.0 - abs(2.0 * min(max(share, 0.0), 1.0) - 1.0)
    return round(COOL_MC + rise * (HOTTEST_MC - COOL_MC) + random.uniform(-SCATTER_MC, SCATTER_MC))


def measure(scene: Scene, out: Path, seconds: float, seed: int) -> dict[str, Any]:
    """Flies in ``out``, a new folder. Raises SourceError, OSError."""
    random = np.random.default_rng(seed)
    with Rig(scene, out, 0.0, seed=seed) as rig:
        rig.take_off()
        began_s = time.monotonic()
        while (elapsed_s := time.monotonic() - began_s) < LEAD_S + seconds + LEAD_S:
            rig.set_temperature(temperature_mc((elapsed_s - LEAD_S) / seconds, random))
            rig.check()
            time.sleep(PERIOD_S)
    health: list[Health] = []
    estimates: list[NavEstimate] = []
    for _, _, message in read_flight(rig.out):
        if isinstance(message, Health):
            health.append(message)
        elif isinstance(message, NavEstimate):
            estimates.append(message)
    return judged(health, estimates, HealthSection())


def judged(health: Sequence[Health], estimates: Sequence[NavEstimate], settings: HealthSection) -> dict[str, Any]:
    """The bands in order, the readings whose band is not the configured one, and the steps of the accuracy."""
    switches = [b for a, b in itertools.pairwise(health) if a.band is not b.band]
    bands = [health[0].band, *(message.band for message in switches)]
    pairs = [
        (b.t_ns, worst_sigma_m(b) / worst_sigma_m(a) - 1.0)
        for a, b in itertools.pairwise(sorted(estimates, key=lambda message: message.t_ns))
    ]
    at_switch = [next((step for t_ns, step in pairs if t_ns >= s.t_ns), math.nan) for s in switches]
    steps = [abs(step) for _, step in pairs]
    return {
        "bands": [str(band) for band in bands],
        "not_as_configured": sum(not as_configured(message, settings) for message in health),
        "switches_c": [switch.temperature_c for switch in switches],
        "steps_at_switches": at_switch,
        "step_median": float(np.median(steps)) if steps else math.nan,
        "step_p99": float(np.quantile(steps, 0.99)) if steps else math.nan,
    }


def worst_sigma_m(estimate: NavEstimate) -> float:
    """1-sigma of the position along the worst horizontal axis."""
    horizontal = np.array(estimate.cov).reshape(6, 6)[:2, :2]
    return math.sqrt(float(np.linalg.eigvalsh(horizontal)[1]))


def as_configured(message: Health, settings: HealthSection) -> bool:
    """Whether a band may have this temperature, on its way up or down."""
    low_c, high_c = {
        ThermalBand.NORMAL: (-math.inf, settings.hot_c),
        ThermalBand.HOT: (settings.hot_c - settings.hysteresis_c, settings.critical_c),
        ThermalBand.CRITICAL: (settings.critical_c - settings.hysteresis_c, math.inf),
    }[message.band]
    return message.temperature_c is not None and low_c <= message.temperature_c < high_c


def main(
    out: Annotated[Path, typer.Argument(help="New folder; the flight in it is generated.")],
    seconds: Annotated[float, typer.Option(help="Of the cycle.")] = 120.0,
    seed: Annotated[int, typer.Option(help="Seed of the place and of the noise.")] = 1,
    json_file: Annotated[Path | None, typer.Option("--json", help="JSON to write.")] = None,
) -> None:
    result = measure(shuttle_in(out, seed), out / RUN, seconds, seed)
    Console().print(result)
    write_result(json_file, result)
    good = result["bands"] == [str(band) for band in BANDS] and not result["not_as_configured"]
    raise typer.Exit(0 if good and max(map(abs, result["steps_at_switches"])) <= MOST_STEP else OTHER)


if __name__ == "__main__":
    run_standalone("bench.heat_cycle", main)
