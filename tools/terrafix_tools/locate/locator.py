"""Object positions of one flight: what an external detector calls for every detection."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from terrafix.map.package import MapPackage
from terrafix_tools.evaluate import read_summary
from terrafix_tools.flight_map import map_of_flight
from terrafix_tools.locate.cloud import Elevation, PointCloud, build_cloud, finalised_cloud
from terrafix_tools.locate.ground import ground_patch
from terrafix_tools.locate.position import ObjectPosition, Pixel, check_pixel, locate_object
from terrafix_tools.locate.views import FlightViews, read_views


class FlightLocator:
    """A flight record and the elevation of its map. The point cloud of a fragment is built when it is first needed.

    locator = FlightLocator.open(Path("out/replay"))
    found = locator.locate([("frame-000120.jpg", (412.0, 300.5))])
    lat_deg, lon_deg = locator.flight.frame.to_wgs84(*found.p_m[:2])
    """

    def __init__(self, flight: FlightViews, elevation: Elevation | None, dense: PointCloud | None = None) -> None:
        """``dense``: cloud of the whole finalised flight."""
        self.flight = flight
        self._dense = dense
        self.elevation = elevation
        self._clouds: dict[int, PointCloud] = {}

    @property
    def amsl_known(self) -> bool:
        """Whether heights are above mean sea level; else above the ground at the start."""
        return self.elevation is not None or self.flight.origin.ground_amsl_m is not None

    @classmethod
    def open(cls, record: Path, map_path: Path | None = None) -> "FlightLocator":
        """``record``: a file, or the folder of a replay or run. ``map_path``: None: the map that the record names, if
        it is there. Raises SourceError, MapError, EvaluationError (summary.json is damaged)."""
        flight = read_views(record)
        folder = record if record.is_dir() else record.parent
        package = map_of_flight(folder, map_path, read_summary(folder), flight.header)
        elevation = None if package is None else MapPackage.open(package).bind(flight.frame).elevation
        return cls(flight, elevation, finalised_cloud(folder))

    def locate(self, pixels: Sequence[tuple[str, tuple[float, float]]]) -> ObjectPosition:
        """Position of one object. ``pixels``: frame (number or file) and pixel (u, v) of each sighting.

        Raises UsageError: no such frame or pixel; SourceError: a frame without position, or sky."""
        seen = [Pixel(self.flight.view(frame), *uv) for frame, uv in pixels]
        for pixel in seen:
            check_pixel(pixel)
        patches = [
            ground_patch(pixel.view, pixel.ray(), self.cloud(pixel.view.fragment_id), self.elevation) for pixel in seen
        ]
        return locate_object(seen, patches)

    def cloud(self, fragment_id: int) -> PointCloud:
        """Point cloud of the finalised flight; else of a fragment, empty without one (-1)."""
        if self._dense is not None:
            return self._dense
        if fragment_id not in self._clouds:
            self._clouds[fragment_id] = (
                build_cloud(self.flight, fragment_id, self.elevation)
                if fragment_id >= 0
                else PointCloud(np.zeros((0, 3)), np.zeros(0))
            )
        return self._clouds[fragment_id]
