"""Refusals of the console as application/problem+json (RFC 9457)."""

import logging
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response

from terrafix.core.errors import OutputError, TerrafixError
from terrafix_tools.console.payloads import Problem

MEDIA_TYPE = "application/problem+json"
MAX_ERRORS = 20  # of a body that are listed [spec: a longer list helps nobody]
FULL = 507  # Insufficient Storage, RFC 4918
TITLES = {
    400: "Bad request",
    401: "Token needed",
    403: "Not allowed",
    404: "Not found",
    405: "Method not allowed",
    408: "Too slow",
    409: "Conflict",
    411: "Length needed",
    413: "Too large",
    415: "Wrong media type",
    416: "No such range",
    421: "Wrong host",
    422: "Not valid",
    429: "Too many",
    500: "Internal error",
    503: "Not available",
    FULL: "Disk full",
}

log = logging.getLogger("terrafix.console")


class Refusal(Exception):
    """A request that is refused: HTTP status, and what is wrong and what to do next in one line."""

    def __init__(self, status: int, detail: str, errors: list[dict[str, Any]] | None = None) -> None:
        super().__init__(detail)
        self.status, self.detail, self.errors = status, detail, errors or []


def problem(status: int, detail: str, errors: list[dict[str, Any]] | None = None) -> Response:
    body = Problem(title=TITLES.get(status, "Refused"), status=status, detail=detail, errors=errors or [])
    headers = {"WWW-Authenticate": "Bearer"} if status == 401 else None
    return JSONResponse(body.model_dump(), status, headers, media_type=MEDIA_TYPE)


def add_handlers(app: FastAPI) -> None:
    """Every error of a route becomes a problem. A bug is logged with its traceback and answered with 500."""

    async def refusal(_request: Request, error: Exception) -> Response:
        assert isinstance(error, Refusal)
        return problem(error.status, error.detail, error.errors)

    async def http(_request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        return problem(error.status_code, str(error.detail))

    async def invalid(_request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        errors = [{"where": ".".join(str(p) for p in e["loc"]), "what": str(e["msg"])} for e in error.errors()]
        first = f"{errors[0]['where']}: {errors[0]['what']}" if errors else "the body is not valid"
        return problem(422, first, errors[:MAX_ERRORS])

    async def ours(_request: Request, error: Exception) -> Response:
        return problem(FULL if isinstance(error, OutputError) else 422, str(error))

    async def bug(_request: Request, error: Exception) -> Response:
        log.error("a request failed", exc_info=error)
        return problem(500, "the console has a bug; its log has the traceback")

    app.add_exception_handler(Refusal, refusal)
    app.add_exception_handler(HTTPException, http)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(TerrafixError, ours)
    app.add_exception_handler(Exception, bug)
