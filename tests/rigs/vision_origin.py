"""Origin of a flight for tests of vision, which uses its camera alone."""

from origins import origin_of
from terrafix.messages import Camera
from textured_ground import PINHOLE

PINHOLE_ORIGIN = origin_of(
    Camera(width=PINHOLE.width, height=PINHOLE.height, fx=PINHOLE.fx, fy=PINHOLE.fy, cx=PINHOLE.cx, cy=PINHOLE.cy)
)
