"""A console in a thread of the test, plain HTTP requests to it, and images to upload."""

import io
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import urllib3
from PIL import Image

import small_map
from terrafix_tools.console.app import make_app
from terrafix_tools.console.client import ConsoleClient
from terrafix_tools.console.serve import Server, config_of
from terrafix_tools.console.service import Service
from terrafix_tools.console.settings import Settings

MAP = "small"
CAMERA = {"width": 640, "height": 480, "fx": 500.0}
NEW = {"camera": CAMERA, "map": MAP}
WAIT_S = 20.0  # longest wait for the service
WAIT_FOR_RESULT_S = 900.0  # ... for a result; processes of others may take the processors
BOUNDARY = "a-boundary-of-the-test"


@dataclass(frozen=True)
class Answer:
    status: int
    headers: Any
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


def settings(folder: Path, **changes: Any) -> Settings:
    """Of a service with one small map that computes no flight (``workers`` 0)."""
    (folder / "maps").mkdir(parents=True, exist_ok=True)
    if not (folder / "maps" / small_map.NAME).is_file():
        small_map.write(folder / "maps")
    return Settings(**{"data": folder, "port": 0, "workers": 0, "nice": 0, **changes})


class Console:
    """A context manager: the service runs in between."""

    def __init__(self, chosen: Settings) -> None:
        app = make_app(chosen)
        self.service: Service = app.state.service
        self._server = Server(config_of(app, chosen), self.service)
        self._thread = threading.Thread(target=self._server.run)
        self._http = urllib3.PoolManager(retries=False, timeout=WAIT_S, cert_reqs="CERT_NONE")
        self._scheme = "http" if chosen.cert is None else "https"

    def __enter__(self) -> Self:
        self._thread.start()
        until = time.monotonic() + WAIT_S
        while not self._server.started and time.monotonic() < until:
            time.sleep(0.005)
        assert self._server.started
        port = self._server.servers[0].sockets[0].getsockname()[1]
        self.url = f"{self._scheme}://127.0.0.1:{port}"
        return self

    def __exit__(self, *_: object) -> None:
        self._http.clear()  # a TLS connection is closed by both sides
        self._server.end()
        self._thread.join()

    def send(self, method: str, path: str, body: object = None, headers: dict[str, str] | None = None) -> Answer:
        """``body``: bytes as they are, in chunks if they are several, anything else as JSON."""
        sent = dict(headers or {})
        plain = body is None or isinstance(body, bytes | Iterator)
        data = body if plain else json.dumps(body).encode()
        if not plain:
            sent.setdefault("content-type", "application/json")
        answer = self._http.request(method, self.url + path, body=data, headers=sent)
        return Answer(answer.status, answer.headers, answer.data)

    def create(self, **changes: object) -> str:
        """-> the id of a new flight."""
        answer = self.send("POST", "/flights", {**NEW, **changes})
        assert answer.status == 201, answer.body
        return str(answer.json["flight_id"])

    def upload(self, flight_id: str, parts: Sequence[tuple[str, str, bytes]], **headers: str) -> Answer:
        """``parts``: (field, file name, content)."""
        return self.send(
            "POST",
            f"/flights/{flight_id}/images/batch",
            multipart(parts),
            {"content-type": f"multipart/form-data; boundary={BOUNDARY}", **headers},
        )

    def events(self, flight_id: str, after: int, count: int, headers: dict[str, str] | None = None) -> list[Any]:
        """The next ``count`` events: (id, name, data)."""
        sent = {"last-event-id": str(after), **(headers or {})}
        url = f"{self.url}/flights/{flight_id}/events"
        answer = self._http.request("GET", url, headers=sent, preload_content=False)
        assert answer.status == 200, answer.data
        text, found = "", []
        try:
            for chunk in answer.stream(64):
                text += chunk.decode()
                *blocks, text = text.split("\n\n")
                found += [parsed for block in blocks if (parsed := _event(block)) is not None]
                if len(found) >= count:
                    return found[:count]
        finally:
            answer.close()
        return found


class Watched:
    """The events of a flight as they come."""

    def __init__(self, client: ConsoleClient, flight_id: str) -> None:
        self._stream = client.events(flight_id)
        self.seen: list[Any] = []

    def until(self, name: str, **fields: object) -> Any:
        """The data of the next event of this name with these fields."""
        end = time.monotonic() + WAIT_FOR_RESULT_S
        for event in self._stream:
            self.seen.append(event)
            if event.name == name and fields.items() <= event.data.items():
                return event.data
            assert time.monotonic() < end, f"no {name}"
        raise AssertionError(f"the stream ended without {name}")


class Served:
    """`terrafix serve` as a process. ``port``: 0 takes a free one."""

    def __init__(self, data: Path, *, maps: Sequence[Path] = (), sources: Path | None = None, port: int = 0) -> None:
        self.port = port or _free_port()
        words = ["serve", "--data", str(data), "--port", str(self.port), "--workers", "1"]
        words += [word for folder in maps for word in ("--maps", str(folder))]
        words += [] if sources is None else ["--sources", str(sources)]
        self.process = subprocess.Popen([sys.executable, "-m", "terrafix_tools.program", *words])
        self.url = f"http://127.0.0.1:{self.port}"
        self.client = ConsoleClient(self.url)
        end = time.monotonic() + WAIT_FOR_RESULT_S
        while True:
            with socket.socket() as trying:
                if trying.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            assert time.monotonic() < end and self.process.poll() is None
            time.sleep(0.05)

    def get(self, path: str) -> Answer:
        with urllib3.PoolManager(retries=False, timeout=WAIT_S) as http:
            answer = http.request("GET", self.url + path)
            return Answer(answer.status, answer.headers, answer.data)

    def stop(self) -> int:
        """In order -> the exit code."""
        self.process.terminate()
        return self.process.wait(timeout=60)


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def _event(block: str) -> tuple[int, str, Any] | None:
    fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
    if "event" not in fields:
        return None
    return int(fields.get("id", 0)), fields["event"], json.loads(fields["data"])


def multipart(parts: Sequence[tuple[str, str, bytes]]) -> bytes:
    body = b""
    for field, name, content in parts:
        head = f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="{field}"; filename="{name}"\r\n\r\n'
        body += head.encode() + content + b"\r\n"
    return body + f"--{BOUNDARY}--\r\n".encode()


@cache
def jpeg(seed: int = 0, width: int = 640, height: int = 480) -> bytes:
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 256, (height // 16, width // 16, 3), np.uint8)
    done, data = cv2.imencode(".jpg", cv2.resize(small, (width, height)), [cv2.IMWRITE_JPEG_QUALITY, 50])
    assert done
    return data.tobytes()


def batch(first: int, count: int = 10, content: bytes | None = None) -> list[tuple[str, str, bytes]]:
    """Images by the numbers from ``first`` on; equal ones if ``content`` is given."""
    return [("images", f"IMG_{number:04d}.jpg", content or jpeg(number)) for number in range(first, first + count)]


XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:RelativeAltitude="+92.4" '
    'drone-dji:GimbalYawDegree="91.0" drone-dji:GimbalPitchDegree="-90.0"></rdf:Description></rdf:RDF></x:xmpmeta>'
)


@cache
def photo(second: int = 0, lat_deg: float = 0.0, lon_deg: float = 0.0) -> bytes:
    """640 x 480 px as a drone writes it: time, 24 mm (of 35 mm film), position (north, east), height 92.4 m, looking
    down, image top to 91 degrees."""
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x9003: f"2024:05:06 10:{second // 60:02}:{second % 60:02}", 0xA405: 24})
    exif.get_ifd(0x8825).update({1: "N", 2: (lat_deg, 0.0, 0.0), 3: "E", 4: (lon_deg, 0.0, 0.0)})
    written = io.BytesIO()
    with Image.open(io.BytesIO(jpeg(0))) as image:
        image.save(written, "JPEG", exif=exif, xmp=XMP.encode())
    return written.getvalue()
