"""Errors as problem documents (RFC 9457), with the messages of the commands and remedies of the
API."""

from __future__ import annotations

import re
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from station.archive.index import IndexBusyError
from station.console.live.control import NotRunningError
from station.core.errors import BoothError
from station.core.files import disk_words
from station.messaging.asking import RefusedError

MEDIA_TYPE = "application/problem+json"


class Problem(BaseModel):
    """A problem document, RFC 9457."""

    type: str = Field(description="/problems/<kind>; stays the same over releases")
    title: str
    status: int
    detail: str = Field(description="problem and remedy; requests instead of commands")


_REMEDIES = (
    (re.compile("run station start first"), "switch them on with POST /api/v1/booth/start"),
    (re.compile("see station list"), "see GET /api/v1/scans"),
    (re.compile("repair it, see station status"), "repair it, see GET /api/v1/booth"),
    (re.compile(r"with: station purge (\S+)"), r"with: DELETE /api/v1/scans/\1"),
)
"""Commands that a refusal names, and the requests that do the same."""


class ProblemError(Exception):
    """Ends a request with a problem document."""

    def __init__(
        self, status: int, kind: str, detail: str, headers: dict[str, str] | None = None
    ) -> None:
        super().__init__(detail)
        self.status, self.kind, self.detail, self.headers = status, kind, detail, headers


_MEANINGS = {
    400: "The range cannot be read",
    401: "Log in, or give a valid token",
    403: "Not within the token's scopes, or sent by another site",
    404: "Not found",
    408: "The request came too slowly",
    409: "The station refuses; the detail says why and what to do",
    413: "The body is too large",
    416: "The range lies outside the file",
    421: "The console is not known by this host name",
    422: "A value is missing or invalid",
    429: "Too many passwords, wrong or at once; Retry-After says how long to wait",
    431: "The headers are too large",
    503: "No station is responding, or its disk is too busy",
}
_ALWAYS = (401, 403, 408, 413, 421, 422, 431, 503)


def responses(*more: int) -> dict[int | str, dict[str, Any]]:
    """Error answers of a route, for the OpenAPI document."""
    schema = {"schema": {"$ref": "#/components/schemas/Problem"}}
    found: dict[int | str, dict[str, Any]] = {
        status: {"description": _MEANINGS[status], "content": {MEDIA_TYPE: schema}}
        for status in sorted({*_ALWAYS, *more})
    }
    for status in {400, 416} & found.keys():
        found[status]["content"] = {"text/plain": {"schema": {"type": "string"}}}
    return found


def install(app: FastAPI) -> None:
    """Let every error of the app end as a problem document."""

    @app.exception_handler(ProblemError)
    async def _problem(request: Request, error: ProblemError) -> JSONResponse:  # noqa: ARG001
        return _answer(error.status, error.kind, error.detail, error.headers)

    @app.exception_handler(RequestValidationError)
    async def _invalid(
        request: Request,  # noqa: ARG001
        error: RequestValidationError,
    ) -> JSONResponse:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return _answer(422, "invalid", f"{where}: {first['msg']}")

    @app.exception_handler(BoothError)
    async def _booth(request: Request, error: BoothError) -> JSONResponse:  # noqa: ARG001
        if isinstance(error, NotRunningError):
            return _answer(503, "station-not-running", str(error))
        if isinstance(error, IndexBusyError):
            return _answer(503, "busy", str(error))
        kind = "refused" if isinstance(error, RefusedError) else "not-possible"
        return _answer(409, kind, str(error))

    @app.exception_handler(OSError)
    async def _disk(request: Request, error: OSError) -> JSONResponse:  # noqa: ARG001
        if isinstance(error, FileNotFoundError):
            return _answer(404, "gone", "it was moved away or deleted at this moment")
        return _answer(503, "disk", disk_words(error))

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> JSONResponse:
        if error.status_code == HTTPStatus.BAD_REQUEST:
            # A body that is no JSON at all, or too deep; other bodies are refused in the same way.
            return _answer(422, "invalid", str(error.detail))
        kind = {404: "not-found", 405: "method-not-allowed"}.get(error.status_code, "http")
        detail = f"{request.method} {request.url.path}: {error.detail}"
        headers = dict(error.headers) if error.headers else None
        return _answer(error.status_code, kind, detail, headers)


def _answer(
    status: int, kind: str, detail: str, headers: dict[str, str] | None = None
) -> JSONResponse:
    for command, request in _REMEDIES:
        detail = command.sub(request, detail)
    title = HTTPStatus(status).phrase if kind == "http" else kind.replace("-", " ")
    problem = Problem(type=f"/problems/{kind}", title=title, status=status, detail=detail)
    return JSONResponse(problem.model_dump(), status, headers, media_type=MEDIA_TYPE)
