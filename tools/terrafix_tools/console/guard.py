"""What every request passes first: host, origin, token and role, size of the body; and the headers of every answer."""

import asyncio
from collections.abc import Iterable
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from terrafix_tools.console.access import Access
from terrafix_tools.console.payloads import Role
from terrafix_tools.console.problems import problem

COOKIE = "terrafix_token"
SAFE = ("GET", "HEAD", "OPTIONS")
OPEN = ("/session", "/page", "/favicon.ico")  # the page itself has no data; it asks for the token
UPLOADS = ("/images/batch", "/photos")  # ends of paths; bounded where they are read
BODY_S = 30.0  # longest time of another body [spec: docs/console.md]
SECURITY_HEADERS = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
        "connect-src 'self'; worker-src 'self' blob:; font-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    ),
}


class Guard:
    """ASGI middleware. ``hosts``: accepted names in the Host header, against names of other sites that resolve to this
    computer; empty: any (tokens are asked for)."""

    def __init__(self, app: ASGIApp, access: Access, hosts: Iterable[str], body_bytes: int) -> None:
        self._app, self._access = app, access
        self._hosts, self._body_bytes = frozenset(hosts), body_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return  # there are no web sockets
        headers = Headers(scope=scope)
        refused = self._refusal(scope, headers)
        is_upload = scope["path"].endswith(UPLOADS)
        length = headers.get("content-length", "0")
        if refused is None and not is_upload and (not length.isdecimal() or int(length) > self._body_bytes):
            refused = 413, f"the body is larger than {self._body_bytes} bytes"

        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                out = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    out.setdefault(name, value)
                out.setdefault("cache-control", "no-store")
            await send(message)

        if refused is not None:
            await problem(*refused)(scope, receive, send_safely)
            return
        await self._app(scope, receive if is_upload else self._bounded(receive), send_safely)

    def _bounded(self, receive: Receive) -> Receive:
        taken = 0
        until_s: float | None = asyncio.get_running_loop().time() + BODY_S

        async def bounded() -> Message:
            nonlocal taken, until_s
            try:
                async with asyncio.timeout_at(until_s):
                    message = await receive()
            except TimeoutError:
                return {"type": "http.disconnect"}
            if not message.get("more_body", False):
                until_s = None  # the body is here; what follows is the end of the connection
            taken += len(message.get("body", b""))
            if taken > self._body_bytes:  # a body in chunks states no length
                return {"type": "http.disconnect"}
            return message

        return bounded

    def _refusal(self, scope: Scope, headers: Headers) -> tuple[int, str] | None:
        """-> status and detail; None: the request may pass."""
        host = headers.get("host", "")
        if self._hosts and _name(host) not in self._hosts:
            return 421, f"this service does not go by the name {host[:80]!r}; add it with --name"
        role = self._access.role_of(token_of(headers))
        scope.setdefault("state", {})["role"] = role
        if scope["method"] not in SAFE and not _same_origin(headers, host):
            return 403, "a page of another site may not send this"
        path = scope["path"]
        if path == "/" or any(path == name or path.startswith(name + "/") for name in OPEN):
            return None
        if role is None:
            return 401, "send a token: Authorization: Bearer TOKEN"
        if scope["method"] not in SAFE and role is not Role.OPERATOR:
            return 403, "a viewer may only read; this needs the token of an operator"
        return None


def token_of(headers: Headers) -> str:
    """From the header Authorization, or the cookie that POST /session sets; "": none."""
    scheme, _, token = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    return cookie_parser(headers.get("cookie", "")).get(COOKIE, "")


def _same_origin(headers: Headers, host: str) -> bool:
    """Whether an unsafe request comes from a program, or from a page of this service (Fetch Metadata; Origin in
    browsers that do not send it)."""
    site = headers.get("sec-fetch-site")
    if site is not None and site not in ("same-origin", "none"):
        return False
    origin = headers.get("origin")
    return origin is None or urlsplit(origin).netloc.lower() == host.lower()


def _name(host: str) -> str:
    """The name of a Host header without its port."""
    return host.rpartition("]")[0].lstrip("[").lower() if host.startswith("[") else host.partition(":")[0].lower()
