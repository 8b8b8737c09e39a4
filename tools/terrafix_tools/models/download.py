"""One file over HTTP that goes on where it was cut off (RFC 9110, 14: range requests)."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import urllib3

from terrafix.core.errors import ModelError
from terrafix_engines.manifest import Manifest
from terrafix_tools.mapping.fetch import AGAIN, plain, proxy_of

ATTEMPTS = 4  # without a byte in between
FIRST_WAIT_S = 0.5  # before the second attempt; doubles from there
TIMEOUT_S = 30.0
BLOCK_BYTES = 1 << 16
USER_AGENT = "Terrafix models"


class CutOffError(Exception):
    """The download ended too early, and why; what came is kept."""


def download(manifest: Manifest, url: str, part: Path, seen: Callable[[int], None]) -> None:
    """Adds to ``part`` until all is there; ``seen`` is told how much that is. Raises ModelError."""
    attempt, reason = 0, ""
    while (there := part.stat().st_size) < manifest.size_bytes:
        if attempt == ATTEMPTS:
            size = f"{there / 1e6:.1f} of {manifest.size_bytes / 1e6:.1f} MB"
            raise ModelError(f"{url}: {reason}, {size} are here; run it again to go on, or give a file with --from")
        if attempt:
            time.sleep(FIRST_WAIT_S * 2 ** (attempt - 1))
        try:
            _go_on(manifest, url, part, seen)
            reason = "the answer was cut off"
        except CutOffError as error:
            reason = str(error)
        attempt = 1 if part.stat().st_size > there else attempt + 1


def _go_on(manifest: Manifest, url: str, part: Path, seen: Callable[[int], None]) -> None:
    """One answer, from where the last one ended. Raises CutOffError, and ModelError for what will not get better."""
    there = part.stat().st_size
    headers = {"User-Agent": USER_AGENT, "Accept-Encoding": "identity"}
    if there:
        headers["Range"] = f"bytes={there}-"
    proxy = proxy_of(url)
    try:
        with (
            urllib3.ProxyManager(proxy) if proxy else urllib3.PoolManager() as pool,
            pool.request(
                "GET", url, headers=headers, preload_content=False, timeout=TIMEOUT_S, retries=_redirects()
            ) as response,
        ):
            if response.status not in (200, 206):
                _refused(manifest, url, response.status)
            if response.status == 200:  # all of it again: it knows no ranges
                os.truncate(part, 0)
                there = 0
            elif not response.headers.get("Content-Range", "").startswith(f"bytes {there}-"):
                os.truncate(part, 0)
                raise CutOffError("the server sends another part than was asked for")
            _check_size(manifest, url, response)
            with part.open("ab") as out:
                while block := response.read1(BLOCK_BYTES):  # not stream(): of a block that is cut off it gives nothing
                    there += len(block)
                    if there > manifest.size_bytes:
                        raise ModelError(f"{url}: larger than the published file; it was not taken")
                    out.write(block)
                    seen(there)
    except urllib3.exceptions.HTTPError as error:
        raise CutOffError(plain(error)) from None


def _check_size(manifest: Manifest, url: str, response: urllib3.BaseHTTPResponse) -> None:
    """A page that says "not found", or another version, is told from an answer that was cut off. Raises ModelError."""
    told = response.headers.get("Content-Range", "").rpartition("/")[2] or response.headers.get("Content-Length", "")
    if told.isdigit() and int(told) != manifest.size_bytes:
        raise ModelError(f"{url}: has {told} bytes, the published file {manifest.size_bytes}; it was not taken")


def _refused(manifest: Manifest, url: str, status: int) -> None:
    if status in AGAIN:
        raise CutOffError(f"the server says {status}")
    raise ModelError(f"{url}: the server refuses (status {status}); check the address, or give a file with --from")


def _redirects() -> urllib3.Retry:
    return urllib3.Retry(total=None, connect=0, read=0, status=0, other=0, redirect=5)
