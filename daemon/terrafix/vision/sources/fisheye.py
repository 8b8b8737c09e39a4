"""A fisheye lens: of what it sees, the part around its axis becomes the image of a pinhole camera."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import msgspec
import numpy as np

from terrafix.messages import Camera, Fact, Origin
from terrafix.vision.sources.contract import Shot, Source, WrappedSource, truth_of
from terrafix.vision.sources.facts import facts_of

# Off the axis; there a pixel sees three times the ground of one in the middle (1 / cos^2) [spec: geometry]
VIEW_HALF_DEG = 55.0
FULL_FOV_DEG = 180.0  # of a lens whose image circle is not stated
STEP_DEG = 0.05  # to which the edge of the image is found
SHRINK = 0.99  # of the view, until its corners lie in the image


class FisheyeCamera(Camera, frozen=True, kw_only=True):
    """Stored images of a lens of Kannala and Brandt (2006), as cv2.fisheye and Kalibr's equidistant have it:
    r = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8), t the angle off the axis. ``distortion``: k1 to k4.

    No process receives it: what flies sees ``view_of`` it."""

    fov_deg: float = FULL_FOV_DEG  # full angle of the circle that the lens images


def project(camera: FisheyeCamera, rays: np.ndarray) -> np.ndarray:
    """Rays in the camera frame (N, 3), z > 0 -> pixels of the stored image (N, 2)."""
    points = np.ascontiguousarray(rays, dtype=np.float64).reshape(-1, 1, 3)
    px, _ = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), _matrix(camera), np.array(camera.distortion))
    return np.asarray(px).reshape(-1, 2)


def view_of(camera: Camera) -> Camera:
    """The camera whose images a flight gets from a source that has ``camera``: the pinhole camera itself, or the view
    of a fisheye: same axis and focal length (its resolution in the middle), as wide as VIEW_HALF_DEG and image allow.
    """
    if not isinstance(camera, FisheyeCamera):
        return camera
    left, right, up, down = (_reach(camera, np.array(way)) for way in ((-1.0, 0), (1.0, 0), (0, -1.0), (0, 1.0)))
    while min(left + right, up + down) > 0 and not _lies_in(camera, left, right, up, down):
        left, right, up, down = SHRINK * left, SHRINK * right, SHRINK * up, SHRINK * down
    cx, cy = np.floor(left * camera.fx), np.floor(up * camera.fy)
    return Camera(
        width=int(cx + np.floor(right * camera.fx)) + 1,
        height=int(cy + np.floor(down * camera.fy)) + 1,
        fx=camera.fx,
        fy=camera.fy,
        cx=float(cx),
        cy=float(cy),
        distortion=(0.0, 0.0, 0.0, 0.0),  # calibrated, and none is left
        focal_sigma=camera.focal_sigma,
        mount_yaw_deg=camera.mount_yaw_deg,
        mount_pitch_deg=camera.mount_pitch_deg,
        mount_roll_deg=camera.mount_roll_deg,
        mount_tolerance_deg=camera.mount_tolerance_deg,
        gimbal=camera.gimbal,
        readout_s=camera.readout_s,
    )


class FisheyeView(WrappedSource):
    """A source with the views of another's images (``Source``). The grid of the view is computed once."""

    def __init__(self, source: Source, camera: FisheyeCamera) -> None:
        super().__init__(source)
        self._camera = view_of(camera)
        view, size = self._camera, (self._camera.width, self._camera.height)
        self._grid = cv2.fisheye.initUndistortRectifyMap(
            _matrix(camera), np.array(camera.distortion), np.eye(3), _matrix(view), size, cv2.CV_16SC2
        )

    def origin(self) -> Origin:
        return msgspec.structs.replace(self._source.origin(), camera=self._camera)

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        for shot in self._source.shots(from_s):
            frame = msgspec.structs.replace(shot.frame, width=self._camera.width, height=self._camera.height)
            image = None if shot.image is None else cv2.remap(shot.image, *self._grid, cv2.INTER_LINEAR)
            yield replace(shot, frame=frame, image=image)

    def facts(self) -> list[Fact]:
        return [*facts_of(self._source), *view_facts(self._source.origin().camera)]

    def truth(self) -> list[tuple[str, float, float]]:
        return truth_of(self._source)


def view_facts(camera: Camera) -> list[Fact]:
    """What of a fisheye is used; nothing of a pinhole camera."""
    if not isinstance(camera, FisheyeCamera):
        return []
    view = view_of(camera)
    across, down = (
        np.degrees(np.arctan(near / focal) + np.arctan((size - 1 - near) / focal))
        for near, size, focal in ((view.cx, view.width, view.fx), (view.cy, view.height, view.fy))
    )
    used = f"{across:.0f} x {down:.0f} degrees are used: a pinhole image of {view.width}x{view.height} px"
    return [Fact("camera", f"fisheye, of which {used}")]


def pinhole_source(source: Source) -> Source:
    """The source itself, or its views if its lens is a fisheye."""
    camera = source.origin().camera
    return FisheyeView(source, camera) if isinstance(camera, FisheyeCamera) else source


def _matrix(camera: Camera) -> np.ndarray:
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def _inside(camera: FisheyeCamera, px: np.ndarray) -> np.ndarray:
    return (px >= 0).all(axis=1) & (px[:, 0] <= camera.width - 1) & (px[:, 1] <= camera.height - 1)


def _reach(camera: FisheyeCamera, way: np.ndarray) -> float:
    """Tangent of the angle off axis as far as the image reaches in direction ``way`` (2,), and its polynomial rises."""
    angle = np.radians(np.arange(0.0, min(VIEW_HALF_DEG, camera.fov_deg / 2) + STEP_DEG / 2, STEP_DEG))
    px = project(camera, np.column_stack([np.sin(angle)[:, None] * way, np.cos(angle)]))
    along = (px - px[0]) @ way
    usable = _inside(camera, px) & (np.diff(along, prepend=-1.0) > 0)
    return float(np.tan(angle[int(np.argmin(usable)) - 1 if not usable.all() else -1]))


def _lies_in(camera: FisheyeCamera, left: float, right: float, up: float, down: float) -> bool:
    """Whether the border of the view, by the tangents of its sides, lies in the image and in the circle of the lens."""
    x, y = np.linspace(-left, right, 21), np.linspace(-up, down, 21)
    sides = [(x, np.full(21, -up)), (x, np.full(21, down)), (np.full(21, -left), y), (np.full(21, right), y)]
    border = np.vstack([np.column_stack([*side, np.ones(21)]) for side in sides])
    in_circle = np.hypot(border[:, 0], border[:, 1]) <= np.tan(np.radians(min(camera.fov_deg, 178.0) / 2))
    return bool((_inside(camera, project(camera, border)) & in_circle).all())
