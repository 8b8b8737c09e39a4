"""Resumable download of one file over HTTP (RFC 9110, section 14: range requests)."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import urllib3

from terrafix.core.errors import ModelError
from terrafix_engines.manifest import Manifest
from terrafix_tools.mapping.fetching.fetch import RETRY_STATUS, describe_error, proxy_of

ATTEMPTS = 4  # number of successive attempts without a received byte
FIRST_WAIT_S = 0.5  # before the second attempt; doubles from there
TIMEOUT_S = 30.0
BLOCK_BYTES = 1 << 16
USER_AGENT = "Terrafix models"


class CutOffError(Exception):
    """The download ended early, with the reason; the received part is kept."""


def download(manifest: Manifest, url: str, part: Path, on_progress: Callable[[int], None]) -> None:
    """Appends to ``part`` until it is complete; ``on_progress`` receives the number of bytes so far. Raises
    ModelError.
    """
    attempt, reason = 0, ""
    while (received := part.stat().st_size) < manifest.size_bytes:
        if attempt == ATTEMPTS:
            size = f"{received / 1e6:.1f} of {manifest.size_bytes / 1e6:.1f} MB"
            raise ModelError(f"{url}: {reason}, {size} are here; run it again to go on, or give a file with --from")
        if attempt:
            time.sleep(FIRST_WAIT_S * 2 ** (attempt - 1))
        try:
            _resume(manifest, url, part, on_progress)
            reason = "the answer was cut off"
        except CutOffError as error:
            reason = str(error)
        attempt = 1 if part.stat().st_size > received else attempt + 1


def _resume(manifest: Manifest, url: str, part: Path, on_progress: Callable[[int], None]) -> None:
    """Processes one response, from the current end of ``part``. Raises CutOffError; ModelError for permanent errors."""
    received = part.stat().st_size
    headers = {"User-Agent": USER_AGENT, "Accept-Encoding": "identity"}
    if received:
        headers["Range"] = f"bytes={received}-"
    proxy = proxy_of(url)
    try:
        with (
            urllib3.ProxyManager(proxy) if proxy else urllib3.PoolManager() as pool,
            pool.request(
                "GET", url, headers=headers, preload_content=False, timeout=TIMEOUT_S, retries=_redirects()
            ) as response,
        ):
            if response.status not in (200, 206):
                _raise_for_status(manifest, url, response.status)
            if response.status == 200:  # the server does not support ranges and sends the whole file
                os.truncate(part, 0)
                received = 0
            elif not response.headers.get("Content-Range", "").startswith(f"bytes {received}-"):
                os.truncate(part, 0)
                raise CutOffError("the server sent another range than requested")
            _check_size(manifest, url, response)
            with part.open("ab") as out:
                while block := response.read1(BLOCK_BYTES):  # not stream(): it discards a block that is cut off
                    received += len(block)
                    if received > manifest.size_bytes:
                        raise ModelError(f"{url}: larger than the published file; it was discarded")
                    out.write(block)
                    on_progress(received)
    except urllib3.exceptions.HTTPError as error:
        raise CutOffError(describe_error(error)) from None


def _check_size(manifest: Manifest, url: str, response: urllib3.BaseHTTPResponse) -> None:
    """Distinguishes an error page or another version from a response that was cut off. Raises ModelError."""
    stated = response.headers.get("Content-Range", "").rpartition("/")[2] or response.headers.get("Content-Length", "")
    if stated.isdigit() and int(stated) != manifest.size_bytes:
        raise ModelError(f"{url}: has {stated} bytes, the published file {manifest.size_bytes}; it was discarded")


def _raise_for_status(manifest: Manifest, url: str, status: int) -> None:
    if status in RETRY_STATUS:
        raise CutOffError(f"the server returned status {status}")
    raise ModelError(f"{url}: the server refuses (status {status}); check the address, or give a file with --from")


def _redirects() -> urllib3.Retry:
    return urllib3.Retry(total=None, connect=0, read=0, status=0, other=0, redirect=5)
