"""Copernicus Data Space: OAuth token, catalogue of scenes, and images rendered on request.

Protocols as documented at documentation.dataspace.copernicus.eu (APIs, Sentinel Hub: Authentication, Catalog, Process).
The service computes the mosaic, so that images of 2500 px are transferred and not whole scenes of 800 MB."""

import os
import threading
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import msgspec
import numpy as np
from rasterio.errors import RasterioError
from rasterio.io import MemoryFile

from terrafix.core.errors import MapError, UsageError
from terrafix.core.toml_file import read_toml
from terrafix_tools.mapping.fetching.fetch import Client, Damaged, FetchError
from terrafix_tools.mapping.fetching.pace import Limits

LICENCE = "Contains modified Copernicus Sentinel data"  # the notice that the data licence requires
CREDENTIALS = ("COPERNICUS_CLIENT_ID", "COPERNICUS_CLIENT_SECRET")
CREDENTIALS_FILE = Path("~/.config/terrafix/copernicus.toml")
LIMITS = Limits(requests_per_s=1.0, connections=2, timeout_s=180.0)  # the image is computed during the request
MAX_REQUEST_PX = 2500  # maximum side of one request
TOKEN_MARGIN_S = 60.0  # a token is renewed this long before it expires
MAX_SCENES = 500


@dataclass(frozen=True)
class DataSpaceService:
    """URLs of the public service; others for a mirror."""

    token_url: str = "https://identity.dataspace.copernicus.eu/auth/realms/CDSE/protocol/openid-connect/token"
    api_url: str = "https://sh.dataspace.copernicus.eu/api/v1"


@dataclass(frozen=True)
class Credentials:
    client_id: str
    client_secret: str


def read_credentials(file: Path = CREDENTIALS_FILE) -> Credentials:
    """From the environment, else from a file with client_id and client_secret that only its owner can read.

    Raises UsageError."""
    known = [os.environ.get(name, "") for name in CREDENTIALS]
    if all(known):
        return Credentials(*known)
    path = file.expanduser()
    if not path.is_file():
        raise UsageError(
            f"Copernicus needs an OAuth client (free, made in the dashboard of dataspace.copernicus.eu): "
            f"export {CREDENTIALS[0]} and {CREDENTIALS[1]}, or write client_id and client_secret into {file}"
        )
    if path.stat().st_mode & 0o077:
        raise UsageError(f"{file}: others can read this secret; run: chmod 600 {file}")
    try:
        return msgspec.convert(read_toml(path), Credentials)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise UsageError(f"{file}: {error}; it has two lines: client_id = '...' and client_secret = '...'") from None


class Copernicus:
    """Client of the service. Thread-safe."""

    def __init__(self, credentials: Credentials, service: DataSpaceService, limits: Limits = LIMITS) -> None:
        self._credentials, self._service = credentials, service
        self.client = Client("Copernicus Data Space", limits)
        self._lock = threading.Lock()
        self._token, self._token_until_s = "", 0.0

    def scenes(
        self, collection: str, bbox: tuple[float, ...], period: tuple[str, str], cloud_percent: int
    ) -> list[str]:
        """Times (RFC 3339) of the scenes in a box in degrees with at most this cloud cover, newest first.

        Raises FetchError, RefusedError."""
        query: dict[str, Any] = {
            "collections": [collection],
            "bbox": list(bbox),
            "datetime": f"{period[0]}T00:00:00Z/{period[1]}T23:59:59Z",
            "filter": f"eo:cloud_cover <= {cloud_percent}",
            "filter-lang": "cql2-text",
            "fields": {"include": ["properties.datetime", "properties.eo:cloud_cover"]},
            "limit": 100,
        }
        found: list[str] = []
        while len(found) < MAX_SCENES:
            response = self._post("/catalog/1.0.0/search", query, "application/geo+json")
            try:
                page = msgspec.json.decode(response)
                found += [feature["properties"]["datetime"] for feature in page["features"]]
                following = page.get("context", {}).get("next")
            except (msgspec.DecodeError, KeyError, TypeError, AttributeError):
                raise FetchError(
                    "Copernicus Data Space: the catalogue returned an invalid response; try later"
                ) from None
            if following is None:
                break
            query["next"] = following
        return sorted(found, reverse=True)

    def picture(self, request: dict[str, Any]) -> bytes:
        """A complete GeoTIFF from the Process API. Raises FetchError, RefusedError."""
        return self._post("/process", request, "image/tiff", check=_check_tiff)

    def _post(self, path: str, body: dict[str, Any], accept: str, check: Any = None) -> bytes:
        headers = {
            "Authorization": f"Bearer {self._access_token()}",
            "Content-Type": "application/json",
            "Accept": accept,
        }
        url = self._service.api_url + path
        response = self.client.request("POST", url, headers=headers, body=msgspec.json.encode(body), check=check)
        if response is None:
            raise MapError(f"{url}: nothing there; the service has moved")
        return response

    def _access_token(self) -> str:
        """Access token by OAuth 2 client credentials (RFC 6749, 4.4)."""
        with self._lock:
            if time.monotonic() < self._token_until_s:
                return self._token
            form = {
                "grant_type": "client_credentials",
                "client_id": self._credentials.client_id,
                "client_secret": self._credentials.client_secret,
            }
            headers = {"Content-Type": "application/x-www-form-urlencoded"}
            response = self.client.request(
                "POST", self._service.token_url, headers=headers, body=urlencode(form).encode()
            )
            try:
                granted = msgspec.json.decode(response or b"")
                self._token = str(granted["access_token"])
                self._token_until_s = time.monotonic() + float(granted["expires_in"]) - TOKEN_MARGIN_S
            except (msgspec.DecodeError, KeyError, TypeError, ValueError):
                raise FetchError("Copernicus Data Space: no access token received; check the credentials") from None
            return self._token


def _check_tiff(data: bytes) -> None:
    if not data.startswith((b"II*\0", b"MM\0*", b"II+\0")):
        raise Damaged(f"no TIFF (starts with {data[:40]!r})")
    try:
        with MemoryFile(data) as memory, memory.open() as file:
            for band in range(1, file.count + 1):
                np.asarray(file.read(band))
    except RasterioError as error:
        raise Damaged(f"damaged TIFF ({str(error)[:80]})") from None
