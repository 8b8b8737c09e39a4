"""Wind: a constant part and Dryden turbulence at low altitude."""

import math
import random
from dataclasses import dataclass

FOOT_M = 0.3048
AGL_M = (3.0, 300.0)  # range of the low-altitude model, 10 to 1000 ft
MIN_AIRSPEED_MPS = 3.0  # least airspeed of the frozen turbulence field past a hovering vehicle
UPDATE_STEPS = 50  # update interval of lengths and intensities, which change slowly with height


@dataclass(frozen=True)
class Wind:
    """Velocity of the air, east and north; ``turbulence`` scales the gusts of this wind."""

    east_mps: float = 4.5
    north_mps: float = -3.0
    turbulence: float = 1.0

    def speed_mps(self) -> float:
        return math.hypot(self.east_mps, self.north_mps)


BREEZE = Wind()


class Gusts:
    """Turbulence along a flight. A function of seed and number of steps."""

    def __init__(self, wind: Wind, seed: int) -> None:
        self._gauss = random.Random(f"{seed} gusts").gauss
        self._sigma_w_mps = 0.1 * wind.speed_mps() * wind.turbulence
        self._u = self._v1 = self._v2 = self._w1 = self._w2 = 0.0
        self._count = 0
        self._decay = (0.0, 0.0, 0.0)  # u, v, w
        self._driving_sigma = (0.0, 0.0, 0.0)

    def step(self, dt_s: float, agl_m: float, airspeed_mps: float, heading_rad: float) -> tuple[float, float, float]:
        """Returns the gust east, north, up [m/s] at the vehicle."""
        if self._count % UPDATE_STEPS == 0:
            self._update_filters(dt_s, agl_m, airspeed_mps)
        self._count += 1
        gauss, (ku, kv, kw), (nu, nv, nw) = self._gauss, self._decay, self._driving_sigma
        self._u = ku * self._u + nu * gauss(0.0, 1.0)
        self._v2 += (self._v1 - self._v2) * (1.0 - kv)
        self._v1 = kv * self._v1 + nv * gauss(0.0, 1.0)
        self._w2 += (self._w1 - self._w2) * (1.0 - kw)
        self._w1 = kw * self._w1 + nw * gauss(0.0, 1.0)
        # (1 + sqrt3 T s) / (1 + T s)^2 = sqrt3 / (1 + T s) + (1 - sqrt3) / (1 + T s)^2
        across = _ROOT3 * self._v1 + (1.0 - _ROOT3) * self._v2
        up = _ROOT3 * self._w1 + (1.0 - _ROOT3) * self._w2
        s, c = math.sin(heading_rad), math.cos(heading_rad)
        return self._u * s + across * c, self._u * c - across * s, up

    def _update_filters(self, dt_s: float, agl_m: float, airspeed_mps: float) -> None:
        height_ft = min(max(agl_m, AGL_M[0]), AGL_M[1]) / FOOT_M
        shape = 0.177 + 0.000823 * height_ft
        length_u_m, length_w_m = height_ft / shape**1.2 * FOOT_M, height_ft * FOOT_M
        sigma_u_mps = self._sigma_w_mps / shape**0.4
        speed_mps = max(airspeed_mps, MIN_AIRSPEED_MPS)
        decay_uv, decay_w = math.exp(-dt_s * speed_mps / length_u_m), math.exp(-dt_s * speed_mps / length_w_m)
        self._decay = decay_uv, decay_uv, decay_w
        # The second-order filter doubles the variance of its first stage, which therefore gets half.
        half = math.sqrt(0.5)
        self._driving_sigma = (
            sigma_u_mps * math.sqrt(1.0 - decay_uv**2),
            sigma_u_mps * math.sqrt(1.0 - decay_uv**2) * half,
            self._sigma_w_mps * math.sqrt(1.0 - decay_w**2) * half,
        )


_ROOT3 = math.sqrt(3.0)
