"""HTTP for map sources: whole answers or a reason, tried again where that helps, never more than the server allows."""

import email.utils
import random
import time
import urllib.request
from collections.abc import Callable, Mapping
from urllib.parse import urlsplit

import urllib3

from terrafix.core.errors import MapError
from terrafix_tools.mapping.fetch_pace import Limits, Pace

AGAIN = {408, 425, 429, 500, 502, 503, 504}  # a server's own trouble, or its wish for patience
NOTHING_THERE = {204, 404, 410}
LONGEST_WAIT_S = 60.0  # between two attempts that nobody asked to be longer
LONGEST_RETRY_AFTER_S = 600.0  # a server that wants more rest than this gets it by a later run
MOST_BYTES = 256 << 20
CHUNK_BYTES = 1 << 16


class FetchError(MapError):
    """One answer could not be had, even after several attempts."""


class RefusedError(FetchError):
    """The server says no: nothing that is asked in the same way will succeed."""


class Damaged(Exception):
    """Raised by a check of an answer: why it is not what was asked for. It is asked for again."""


Check = Callable[[bytes], None]


class Client:
    """One source's server. Used by several threads at once."""

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
        most_bytes: int = MOST_BYTES,
    ) -> bytes | None:
        """The answer, or None where the server has nothing. ``check`` raises Damaged when the answer must be repeated.

        Raises RefusedError (another 4xx), FetchError (still no whole answer after all attempts) and Stopped."""
        reason = ""
        for attempt in range(self.limits.attempts):
            if attempt:
                self._rest(attempt)
            self.pace.turn()
            try:
                status, answer, retry_after = self._once(method, url, headers, body, most_bytes)
                if status in NOTHING_THERE:
                    return None
                if status == 200:
                    if check:
                        check(answer)
                    return answer
            except (urllib3.exceptions.HTTPError, OSError) as error:
                reason = plain(error)
                continue
            except Damaged as damage:
                reason = str(damage)
                continue
            reason = f"status {status}"
            if status not in AGAIN:
                said = answer[:120].decode("utf-8", "replace").split("\n")[0].strip()
                raise RefusedError(f"{self.name}: the server refuses ({reason}: {said}); {_advice(status)}")
            self._obey(retry_after)
        raise FetchError(f"{self.name}: no whole answer after {self.limits.attempts} attempts (last: {reason})")

    def _once(
        self, method: str, url: str, headers: Mapping[str, str] | None, body: bytes | None, most_bytes: int
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
            for part in response.stream(CHUNK_BYTES, decode_content=True):  # raises when fewer bytes come than promised
                size += len(part)
                if size > most_bytes:
                    raise Damaged(f"answer larger than {most_bytes >> 20} MB")
                parts.append(part)
        except BaseException:
            response.close()  # the rest of this answer must not be taken for the next one
            raise
        finally:
            response.release_conn()  # also a closed one: the pool counts them, and waits for one that is not given back
        return response.status, b"".join(parts), response.headers.get("Retry-After", "")

    def _pool(self, url: str) -> urllib3.PoolManager:
        """Through the proxy of the environment where there is one."""
        proxy = proxy_of(url)
        if proxy not in self._pools:
            options = {"maxsize": self.limits.connections, "block": True}
            self._pools[proxy] = (
                urllib3.ProxyManager(proxy, **options) if proxy else urllib3.PoolManager(**options)  # type: ignore[arg-type]
            )
        return self._pools[proxy]

    def _rest(self, attempt: int) -> None:
        wait_s = min(self.limits.first_wait_s * 2 ** (attempt - 1), LONGEST_WAIT_S)
        self.pace.rest(
            wait_s * random.uniform(0.5, 1.0)
        )  # apart from each other, so that they do not come back at once

    def _obey(self, retry_after: str) -> None:
        """Retry-After (RFC 9110, 10.2.3): seconds or a date; it counts for all connections."""
        if not retry_after:
            return
        if retry_after.strip().isdigit():
            wait_s = float(retry_after)
        else:
            try:
                wait_s = email.utils.parsedate_to_datetime(retry_after).timestamp() - time.time()
            except ValueError:
                return
        if wait_s > LONGEST_RETRY_AFTER_S:
            raise RefusedError(f"{self.name}: the server wants {wait_s / 60:.0f} minutes of rest; run again after that")
        self.pace.hold(max(wait_s, 0.0))


def proxy_of(url: str) -> str:
    """What the environment (HTTPS_PROXY, NO_PROXY) says for this address; empty: none."""
    parts = urlsplit(url)
    proxy = urllib.request.getproxies().get(parts.scheme, "")
    return "" if proxy and urllib.request.proxy_bypass(parts.netloc) else proxy


def _advice(status: int) -> str:
    if status in (401, 403):
        return "check key, credentials and the terms of use"
    return "check the address of the source"


def plain(error: Exception) -> str:
    """What an exception of the network says, in a line."""
    if isinstance(error, urllib3.exceptions.MaxRetryError) and error.reason is not None:
        error = error.reason
    match error:
        case urllib3.exceptions.NewConnectionError():  # before its base class, a timeout
            return "no connection"
        case urllib3.exceptions.IncompleteRead() | urllib3.exceptions.ProtocolError():
            return "the answer was cut off"
        case urllib3.exceptions.TimeoutError():
            return "no answer in time"
    return str(error).split("\n")[0][:120] or type(error).__name__
