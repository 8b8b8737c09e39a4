"""HTTP client for map sources: complete responses or an error, with retries and rate limits."""

import email.utils
import random
import time
import urllib.request
from collections.abc import Callable, Mapping
from urllib.parse import urlsplit

import urllib3

from terrafix.core.errors import MapError
from terrafix_tools.mapping.fetching.pace import Limits, Pace

RETRY_STATUS = {408, 425, 429, 500, 502, 503, 504}  # transient server errors and rate limits
NOTHING_THERE = {204, 404, 410}
MAX_BACKOFF_S = 60.0  # maximum back-off between two attempts
MAX_RETRY_AFTER_S = 600.0  # a longer Retry-After ends the run; a later run resumes
MAX_RESPONSE_BYTES = 256 << 20
CHUNK_BYTES = 1 << 16


class FetchError(MapError):
    """A request failed after all attempts."""


class RefusedError(FetchError):
    """The server rejects the request; equivalent requests will fail, too."""


class Damaged(Exception):
    """Raised by a check of a response: the reason why it is invalid. The request is repeated."""


Check = Callable[[bytes], None]


class Client:
    """Client of one source's server. Thread-safe."""

    def __init__(self, name: str, limits: Limits, headers: Mapping[str, str] | None = None) -> None:
        self.name = name
        self.limits = limits
        self.pace = Pace(limits.requests_per_s)
        self._headers = {"User-Agent": limits.user_agent, **(headers or {})}
        self._pools: dict[str, urllib3.PoolManager] = {}

    def request(
        self,
        method: str,
        url: str,
        *,
        headers: Mapping[str, str] | None = None,
        body: bytes | None = None,
        check: Check | None = None,
        max_bytes: int = MAX_RESPONSE_BYTES,
    ) -> bytes | None:
        """The response body, or None where the server has no data. ``check`` raises Damaged to repeat the request.

        Raises RefusedError (another 4xx), FetchError (no complete response after all attempts) and Stopped."""
        reason = ""
        for attempt in range(self.limits.attempts):
            if attempt:
                self._back_off(attempt)
            self.pace.turn()
            try:
                status, content, retry_after = self._request_once(method, url, headers, body, max_bytes)
                if status in NOTHING_THERE:
                    return None
                if status == 200:
                    if check:
                        check(content)
                    return content
            except (urllib3.exceptions.HTTPError, OSError) as error:
                reason = describe_error(error)
                continue
            except Damaged as damage:
                reason = str(damage)
                continue
            reason = f"status {status}"
            if status not in RETRY_STATUS:
                first_line = content[:120].decode("utf-8", "replace").split("\n")[0].strip()
                raise RefusedError(
                    f"{self.name}: the server refuses ({reason}: {first_line}); {_status_advice(status)}"
                )
            self._apply_retry_after(retry_after)
        raise FetchError(f"{self.name}: no complete response after {self.limits.attempts} attempts (last: {reason})")

    def _request_once(
        self, method: str, url: str, headers: Mapping[str, str] | None, body: bytes | None, max_bytes: int
    ) -> tuple[int, bytes, str]:
        response = self._pool(url).request(
            method,
            url,
            headers={**self._headers, **(headers or {})},
            body=body,
            preload_content=False,
            timeout=urllib3.Timeout(connect=self.limits.timeout_s, read=self.limits.timeout_s),
            retries=urllib3.Retry(total=None, connect=0, read=0, status=0, other=0, redirect=3),
        )
        try:
            parts: list[bytes] = []
            size = 0
            for part in response.stream(CHUNK_BYTES, decode_content=True):  # raises when bytes are missing
                size += len(part)
                if size > max_bytes:
                    raise Damaged(f"response larger than {max_bytes >> 20} MB")
                parts.append(part)
        except BaseException:
            response.close()  # the rest of this response must not be read as the next one
            raise
        finally:
            response.release_conn()  # also when closed: the pool waits for connections that are not released
        return response.status, b"".join(parts), response.headers.get("Retry-After", "")

    def _pool(self, url: str) -> urllib3.PoolManager:
        """Uses the proxy of the environment if there is one."""
        proxy = proxy_of(url)
        if proxy not in self._pools:
            options = {"maxsize": self.limits.connections, "block": True}
            self._pools[proxy] = (
                urllib3.ProxyManager(proxy, **options) if proxy else urllib3.PoolManager(**options)  # type: ignore[arg-type]
            )
        return self._pools[proxy]

    def _back_off(self, attempt: int) -> None:
        wait_s = min(self.limits.first_wait_s * 2 ** (attempt - 1), MAX_BACKOFF_S)
        self.pace.rest(
            wait_s * random.uniform(0.5, 1.0)
        )  # apart from each other, so that they do not come back at once

    def _apply_retry_after(self, retry_after: str) -> None:
        """Retry-After (RFC 9110, 10.2.3): seconds or a date; pauses all connections."""
        if not retry_after:
            return
        if retry_after.strip().isdigit():
            wait_s = float(retry_after)
        else:
            try:
                wait_s = email.utils.parsedate_to_datetime(retry_after).timestamp() - time.time()
            except ValueError:
                return
        if wait_s > MAX_RETRY_AFTER_S:
            raise RefusedError(
                f"{self.name}: the server requests a pause of {wait_s / 60:.0f} minutes; run again after that"
            )
        self.pace.hold(max(wait_s, 0.0))


def proxy_of(url: str) -> str:
    """Proxy for this address from the environment (HTTPS_PROXY, NO_PROXY); empty: none."""
    parts = urlsplit(url)
    proxy = urllib.request.getproxies().get(parts.scheme, "")
    return "" if proxy and urllib.request.proxy_bypass(parts.netloc) else proxy


def _status_advice(status: int) -> str:
    if status in (401, 403):
        return "check key, credentials and the terms of use"
    return "check the address of the source"


def describe_error(error: Exception) -> str:
    """One-line description of a network exception."""
    if isinstance(error, urllib3.exceptions.MaxRetryError) and error.reason is not None:
        error = error.reason
    match error:
        case urllib3.exceptions.NewConnectionError():  # before its base class, a timeout
            return "no connection"
        case urllib3.exceptions.IncompleteRead() | urllib3.exceptions.ProtocolError():
            return "the answer was cut off"
        case urllib3.exceptions.TimeoutError():
            return "time-out"
    return str(error).split("\n")[0][:120] or type(error).__name__
