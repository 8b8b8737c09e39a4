"""Copernicus Data Space, with a local server that implements its protocols: token, catalogue, images."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import parse_qs

import numpy as np
import pytest
import rasterio
from pyproj import CRS, Transformer
from rasterio.io import MemoryFile
from rasterio.transform import Affine

from map_servers import Reply, Request, serving
from terrafix.core.errors import MapError, UsageError
from terrafix_tools.mapping.area.files import read_area
from terrafix_tools.mapping.fetching.fetch import FetchError, RefusedError
from terrafix_tools.mapping.fetching.pace import Limits
from terrafix_tools.mapping.package.dem import DemSource
from terrafix_tools.mapping.sources.copernicus import data_space, glo30, sentinel
from terrafix_tools.mapping.sources.copernicus.data_space import (
    Copernicus,
    Credentials,
    DataSpaceService,
    read_credentials,
)
from terrafix_tools.mapping.sources.spec import SourceSpec

AREA = read_area("11.97,47.0,12.01,47.02", buffer_km=0.0)  # on the border of UTM zones 32 and 33
SECRET = "s3cret&="
EPSG = "http://www.opengis.net/def/crs/EPSG/0/"


@dataclass
class FakeService:
    """Records requests. ``trouble``: replies by path that precede the regular ones."""

    scenes: list[str] = field(default_factory=lambda: ["2024-07-02T10:00:00Z", "2024-07-20T10:00:00Z"])
    trouble: dict[str, list[Reply]] = field(default_factory=dict)
    tokens: int = 0
    searches: list[dict] = field(default_factory=list)
    pictures: list[dict] = field(default_factory=list)
    expires_s: float = 600.0

    def answer(self, request: Request) -> Reply:
        if self.trouble.get(request.path):
            return self.trouble[request.path].pop(0)
        if request.path == "/token":
            return self.token(request)
        if request.headers["Authorization"] not in {f"Bearer token-{n}" for n in range(1, self.tokens + 1)}:
            return Reply(401, b"no such token")
        body = json.loads(request.body)
        if request.path == "/api/catalog/1.0.0/search":
            self.searches.append(body)
            start = body.get("next", 0)
            page = [{"properties": {"datetime": t}} for t in self.scenes[start : start + 1]]
            following = {"next": start + 1} if start + 1 < len(self.scenes) else {}
            return Reply(body=json.dumps({"features": page, "context": following}).encode())
        assert request.path == "/api/process" and request.headers["Accept"] == "image/tiff"
        self.pictures.append(body)
        return Reply(body=picture(body), headers={"Content-Type": "image/tiff"})

    def token(self, request: Request) -> Reply:
        form = parse_qs(request.body.decode())
        if form != {"grant_type": ["client_credentials"], "client_id": ["me"], "client_secret": [SECRET]}:
            return Reply(401, b'{"error":"invalid_client"}')
        self.tokens += 1
        granted = {"access_token": f"token-{self.tokens}", "expires_in": self.expires_s, "token_type": "Bearer"}
        return Reply(body=json.dumps(granted).encode())


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Ground of the fake satellite images: a function of position."""
    return (120 + 50 * np.sin(x / 700.0) + 40 * np.cos(y / 900.0)).astype(np.float32)


def picture(request: dict) -> bytes:
    """As from the Process API, which does not mark the fourth band as a mask."""
    assert request["input"]["bounds"]["properties"]["crs"] == EPSG + "32632"
    x_min, y_min, x_max, y_max = request["input"]["bounds"]["bbox"]
    width, height = request["output"]["width"], request["output"]["height"]
    x = x_min + (np.arange(width) + 0.5) * (x_max - x_min) / width
    y = y_max - (np.arange(height) + 0.5) * (y_max - y_min) / height
    seen = ground(x[None], y[:, None])
    kind = request["input"]["data"][0]["type"]
    if kind == "dem":
        assert request["input"]["data"][0]["dataFilter"] == {"demInstance": "COPERNICUS_30"}
        bands = seen[None] + 500.0
    else:
        valid = np.broadcast_to(np.where(x < 728_000.0, 255, 0), seen.shape)  # permanent clouds in the east
        bands = np.stack([seen, seen, seen, valid]).astype(np.uint8)
    with MemoryFile() as memory:
        profile = {"width": width, "height": height, "count": len(bands), "dtype": bands.dtype, "compress": "deflate"}
        place = Affine((x_max - x_min) / width, 0, x_min, 0, (y_min - y_max) / height, y_max)
        with memory.open(
            driver="GTiff", photometric="minisblack", crs="EPSG:32632", transform=place, **profile
        ) as file:
            file.write(bands)
        return memory.read()


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COPERNICUS_CLIENT_ID", "me")
    monkeypatch.setenv("COPERNICUS_CLIENT_SECRET", SECRET)
    monkeypatch.setattr(data_space, "MAX_REQUEST_PX", 250)
    monkeypatch.setattr("terrafix_tools.mapping.sources.copernicus.chunks.MAX_REQUEST_PX", 250)
    monkeypatch.setattr(glo30, "MAX_REQUEST_PX", 250)
    monkeypatch.setattr(Copernicus.__init__, "__defaults__", (Limits(500.0, 2, first_wait_s=0.01),))


def service(url: str) -> DataSpaceService:
    return DataSpaceService(url + "/token", url + "/api")


def spec(**more: object) -> SourceSpec:
    return SourceSpec(service="sentinel-2", date="2024-08-01", days=60, **more)  # type: ignore[arg-type]


def test_a_sentinel_mosaic_is_fetched_in_adjacent_pieces_and_cached(tmp_path: Path) -> None:
    fake = FakeService()
    with serving(fake.answer) as server:
        job = sentinel.SentinelJob(spec(), AREA, tmp_path, service(server.url))
        estimate = job.estimate()
        assert estimate.items == estimate.missing == len(fake.pictures) + estimate.items
        job.fetch(lambda _: None)
        assert len(fake.pictures) == estimate.items and fake.tokens == 1
        again = sentinel.SentinelJob(spec(), AREA, tmp_path, service(server.url))
        assert again.estimate().missing == 0
        again.fetch(lambda _: None)
        assert len(fake.pictures) == estimate.items and len(fake.searches) == 2
    search = fake.searches[0]
    assert search["collections"] == ["sentinel-2-l2a"] and search["bbox"] == list(AREA.bounds_deg)
    assert search["datetime"] == "2024-06-02T00:00:00Z/2024-08-01T23:59:59Z"
    assert fake.searches[1]["next"] == 1
    request = fake.pictures[0]["input"]["data"][0]
    assert request["dataFilter"]["timeRange"] == {"from": "2024-06-02T00:00:00Z", "to": "2024-08-01T23:59:59Z"}
    assert job.date == "2024-08-01" and job.licence == "Contains modified Copernicus Sentinel data 2024"
    # Every point of the area is in exactly one piece, at 10 m, with the right content.
    to_utm = Transformer.from_crs(4326, 32632, always_xy=True)
    for lon_deg, lat_deg in ((11.971, 47.001), (11.99, 47.01), (12.005, 47.019)):
        x, y = to_utm.transform(lon_deg, lat_deg)
        found = 0
        for opener in job.openers():
            with opener() as imagery:
                column, row = int((x - imagery.x_min) // 10.0), int((imagery.y_max - y) // 10.0)
                if 0 <= column < imagery.width_px and 0 <= row < imagery.height_px:
                    image, mask = imagery.read(column, row, 1, 1)
                    assert imagery.gsd_m == pytest.approx(10.0, rel=0.001) and imagery.has_mask
                    found += 1
                    assert mask[0, 0] == (255 if x < 728_000 - 10 else 0)
                    expected = ground(np.array(imagery.x_min + 10 * column + 5), np.array(imagery.y_max - 10 * row - 5))
                    assert mask[0, 0] == 0 or abs(float(image[0, 0, 0]) - float(expected)) <= 1.0
        assert found == 1


def test_transient_errors_are_retried_and_an_expired_token_is_renewed(tmp_path: Path) -> None:
    fake = FakeService(expires_s=60.0)  # expires at once, because of the safety margin of a minute
    bounds = {"bbox": [0, 0, 2500, 2500], "properties": {"crs": EPSG + "32632"}}
    kind = {"bounds": bounds, "data": [{"type": "sentinel-2-l2a"}]}
    whole = picture({"input": kind, "output": {"width": 250, "height": 250}})
    fake.trouble["/api/process"] = [
        Reply(429, headers={"Retry-After": "0"}),
        Reply(200, whole[: len(whole) // 2]),
        Reply(200, b'{"error": "not a picture"}'),
        Reply(503),
    ]
    with serving(fake.answer) as server:
        job = sentinel.SentinelJob(spec(), AREA, tmp_path, service(server.url))
        job.fetch(lambda _: None)
        assert job.estimate().missing == 0
    assert fake.tokens > 1


def test_a_failed_sentinel_download_keeps_completed_pieces(tmp_path: Path) -> None:
    fake = FakeService()

    def answer(request: Request) -> Reply:
        full = request.path == "/api/process" and len(fake.pictures) >= 2
        return Reply(403, b"out of processing units") if full else fake.answer(request)

    with serving(answer) as server, pytest.raises(RefusedError, match="out of processing units"):
        sentinel.SentinelJob(spec(), AREA, tmp_path, service(server.url)).fetch(lambda _: None)
    kept = len(list(tmp_path.rglob("*.tif")))
    assert kept == len(fake.pictures) >= 2 and not list(tmp_path.rglob("*.part"))
    with serving(fake.answer) as server:
        job = sentinel.SentinelJob(spec(), AREA, tmp_path, service(server.url))
        missing = job.estimate().missing
        before = len(fake.pictures)
        job.fetch(lambda _: None)
        assert len(fake.pictures) - before == missing


def test_wrong_credentials_and_missing_scenes_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeService(scenes=[])
    with serving(fake.answer) as server:
        with pytest.raises(
            MapError, match="no Sentinel-2 scene with under 50 % clouds between 2024-06-02 and 2024-08-01"
        ):
            sentinel.SentinelJob(spec(), AREA, tmp_path, service(server.url)).estimate()
        monkeypatch.setenv("COPERNICUS_CLIENT_SECRET", "wrong")
        with pytest.raises(RefusedError, match=r"invalid_client.*check key, credentials"):
            sentinel.SentinelJob(spec(), AREA, tmp_path, service(server.url)).estimate()
        fake.trouble["/token"] = [Reply(200, b"<html>maintenance</html>")]
        with pytest.raises(FetchError, match="no access token received"):
            sentinel.SentinelJob(spec(), AREA, tmp_path, service(server.url)).estimate()


def test_credentials_are_read_from_a_private_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COPERNICUS_CLIENT_SECRET")
    file = tmp_path / "copernicus.toml"
    with pytest.raises(UsageError, match="export COPERNICUS_CLIENT_ID"):
        read_credentials(file)
    file.write_text("client_id = 'a'\nclient_secret = 'b'\n")
    file.chmod(0o644)
    with pytest.raises(UsageError, match="chmod 600"):
        read_credentials(file)
    file.chmod(0o600)
    assert read_credentials(file) == Credentials("a", "b")
    file.write_text("client_id = 'a'\n")
    with pytest.raises(UsageError, match="client_secret"):
        read_credentials(file)


def test_glo_30_elevation_is_merged_into_one_raster(tmp_path: Path) -> None:
    fake = FakeService()
    with serving(fake.answer) as server:
        path = glo30.fetch_glo30(AREA, tmp_path, lambda _: None, service(server.url))
        count = len(fake.pictures)
        assert glo30.fetch_glo30(AREA, tmp_path, lambda _: None, service(server.url)) == path
        assert len(fake.pictures) == count
    with rasterio.open(path) as file:
        assert file.crs.to_epsg() == 32632
        x, y = Transformer.from_crs(4326, 32632, always_xy=True).transform(11.99, 47.01)
        row, column = file.index(x, y)
        height_m = file.read(1)[row, column]
        at = file.xy(row, column)
    assert height_m == pytest.approx(float(ground(np.array(at[0]), np.array(at[1]))) + 500.0, abs=0.01)
    bounds = Transformer.from_crs(4326, 32632, always_xy=True).transform_bounds(*AREA.bounds_deg)
    with DemSource(path, CRS.from_epsg(32632), bounds) as dem:
        assert 500.0 < np.nanmean(dem.read_tile(0, 0)) < 800.0
