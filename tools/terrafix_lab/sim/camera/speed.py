"""Run time of a simulated frame, for `terrafix bench`."""

import math
import time

import numpy as np

from terrafix import messages as m
from terrafix.core.camera import Mount
from terrafix.core.geodesy import LocalFrame, rot_w_b
from terrafix_lab.sim.camera.render import Film, Renderer
from terrafix_lab.sim.world import place as world

CAMERA = m.Camera(width=960, height=540, fx=560.0, fy=560.0, cx=479.5, cy=269.5)
SIZE_M, REACH_M = 6000.0, 2200.0  # of the world; of the circle that is flown
AGL_M, STEP_M, BANK_RAD = 120.0, 10.0, 0.1  # 20 m/s at 2 Hz


def frame_costs(frames: int, *, seed: int = 1, season: str = "autumn") -> list[tuple[float, float]]:
    """Returns (wall ms, CPU ms of this process) of each frame of a flight over uncached ground; default film."""
    place = world.generate(seed, width_m=SIZE_M, height_m=SIZE_M)
    ground = place.ground(season, LocalFrame(*place.wgs84(SIZE_M / 2, SIZE_M / 2)))
    renderer = Renderer(ground, CAMERA, film=Film(), seed=seed)
    costs = []
    for index in range(frames):
        turn = index * STEP_M / REACH_M
        e_m, n_m = REACH_M * math.sin(turn), REACH_M * math.cos(turn)
        amsl_m = float(ground.height_amsl_m(np.array(e_m), np.array(n_m))) + AGL_M
        r_w_c = rot_w_b(turn + math.pi / 2, 0.0, BANK_RAD) @ Mount().r_b_c()
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        renderer.frame(np.array([e_m, n_m, amsl_m]), r_w_c, index)
        costs.append((1e3 * (time.perf_counter() - wall_s), 1e3 * (time.process_time() - cpu_s)))
    return costs
