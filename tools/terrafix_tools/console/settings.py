"""Options of `terrafix serve`, and the limits of the service."""

from dataclasses import dataclass, field
from pathlib import Path

MB = 2**20


@dataclass(frozen=True)
class ServiceLimits:
    """Bounds of what one service accepts [spec: docs/console.md]."""

    flights: int = 1000  # stored
    images: int = 20_000  # of one flight
    batch: tuple[int, int] = (10, 50)  # images of one upload
    image_bytes: int = 40 * MB  # one image of 26 megapixels as JPEG has 15 MB
    body_bytes: int = 2 * MB  # of a body that is no upload
    uploads: int = 4  # at once; further ones get 429
    upload_s: float = 300.0  # longest time of one, so that slow ones do not keep others out
    event_clients: int = 256
    disk_reserve_bytes: int = 256 * MB  # that an upload leaves free
    object_requests: int = 4  # waiting object-to-GPS computations


@dataclass(frozen=True)
class Settings:
    """``maps``: folders with map packages; ``sources``: TOML file of map sources for areas; ``bus``: run folder of a
    live Terrafix; ``workers``: flights that are computed at once; ``configs``: as of `terrafix replay`."""

    data: Path
    host: str = "127.0.0.1"
    port: int = 8700
    maps: tuple[Path, ...] = ()
    sources: Path | None = None
    bus: str | None = None
    tokens: Path | None = None
    cert: Path | None = None
    key: Path | None = None
    hosts: tuple[str, ...] = ()  # further names of this service in the Host header
    workers: int = 2
    scheduler: str = ""  # of a Dask cluster that computes the flights; else processes of this computer
    nice: int = 10  # of the processes that compute: the service and what flies come first
    configs: tuple[Path, ...] = ()
    models: tuple[str, ...] = ()
    limits: ServiceLimits = field(default_factory=ServiceLimits)

    @property
    def flights(self) -> Path:
        return self.data / "flights"

    @property
    def map_folders(self) -> tuple[Path, ...]:
        """That of areas first."""
        return (self.data / "maps", *self.maps)

    def flight(self, flight_id: str) -> Path:
        return self.flights / flight_id
