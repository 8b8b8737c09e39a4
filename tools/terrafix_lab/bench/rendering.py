"""Time to render a frame of the simulator's camera: python -m terrafix_lab.bench.rendering OUT."""

import json
import sys
import time
from pathlib import Path
from typing import Any

from terrafix_lab.sim.camera.render import Film, Renderer
from terrafix_lab.sim.flights.folder import CAMERA, plan_flight
from terrafix_lab.sim.world import place as world
from terrafix_tools.timing import spread

SEED, SIZE_M, FRAMES = 3, (1600.0, 1200.0), 40


def measure() -> dict[str, Any]:
    """-> processor time of all threads per frame of a flight, with the default image noise and blur (Film)."""
    place = world.generate(SEED, width_m=SIZE_M[0], height_m=SIZE_M[1])
    flight = plan_flight(place, place.render("autumn"), duration_s=FRAMES / 2)
    renderer = Renderer(flight.ground, CAMERA, film=Film(), seed=SEED)
    times_ms = []
    for i, t_s in enumerate(flight.frame_times_s().tolist()):
        pose = flight.camera_pose(flight.path.state(t_s))
        began_s = time.process_time()
        renderer.frame(*pose, i)
        times_ms.append((time.process_time() - began_s) * 1e3)
    return {"width_px": CAMERA.width, "height_px": CAMERA.height, "cpu_ms": spread(times_ms)}


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(json.dumps(measure()), encoding="utf-8")
