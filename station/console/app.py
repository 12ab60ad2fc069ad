"""The whole console as one ASGI application."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.responses import FileResponse
from starlette.responses import Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from station import __version__
from station.archive.phrases import PHRASES
from station.console.api import booth, live, results, scans
from station.console.api.console import Console
from station.console.api.problems import Problem, install
from station.console.security.gate import Gate
from station.console.security.origin import own_names

PREFIX = "/api/v1"
STATIC = Path(__file__).parent / "static"
_REPORT_PERIOD_S = 0.2
"""Shorter than the period of health reports, so that none is left out."""


class _Static(StaticFiles):
    """Files of the page: a browser caches them and revalidates them each time."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers["cache-control"] = "no-cache"
        return response


def create_app(console: Console) -> FastAPI:
    """The application of a console; starting and stopping it starts and stops its threads."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        console.events.attach(asyncio.get_running_loop())
        console.start()
        progress = asyncio.create_task(_report_progress(console))
        yield
        progress.cancel()
        await asyncio.to_thread(console.close)

    app = FastAPI(
        title="Body booth",
        version=__version__,
        docs_url=None,
        redoc_url=None,
        openapi_url=f"{PREFIX}/openapi.json",
        lifespan=lifespan,
    )
    app.state.console = console
    install(app)
    for module in (booth, scans, results, live):
        app.include_router(module.router, prefix=PREFIX)
    _serve_pages(app)
    app.openapi = lambda: _document(app)  # type: ignore[method-assign]  # FastAPI's own way
    app.add_middleware(Gate, names=own_names(console.config.console.names))
    return app


async def _report_progress(console: Console) -> None:
    """Report progress while requests are served (in the same loop) and the booth is watched."""
    console.heart.ready()
    while True:
        if not console.watch.hangs():
            console.heart.beat()
        if console.heart.due:
            console.heart.report(console.watch.health())
        await asyncio.sleep(_REPORT_PERIOD_S)


def _serve_pages(app: FastAPI) -> None:
    for path, name in (
        ("/", "index.html"),
        ("/person", "person.html"),
        (f"{PREFIX}/docs", "docs.html"),
    ):
        file = _file(STATIC / name)
        app.add_api_route(path, file, include_in_schema=False, response_class=FileResponse)
    # The page's words for what the station says are those of the printed sheet.
    app.add_api_route(
        "/static/phrases.json", _file(PHRASES), include_in_schema=False, response_class=FileResponse
    )
    app.mount("/static", _Static(directory=STATIC), name="static")


def _file(path: Path) -> Any:
    def file() -> FileResponse:
        return FileResponse(path, headers={"cache-control": "no-cache"})

    return file


def _document(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document, with the problem document and how to log in."""
    if app.openapi_schema is None:
        schema = get_openapi(
            title=app.title,
            version=app.version,
            description="The booth's API. Errors are problem documents (RFC 9457).",
            routes=app.routes,
        )
        parts = schema.setdefault("components", {})
        parts.setdefault("schemas", {})["Problem"] = Problem.model_json_schema()
        for unused in ("HTTPValidationError", "ValidationError"):
            parts["schemas"].pop(unused, None)
        parts["securitySchemes"] = {
            "token": {"type": "http", "scheme": "bearer"},
            "session": {"type": "apiKey", "in": "cookie", "name": "booth_session"},
        }
        schema["security"] = [{"token": []}, {"session": []}]
        app.openapi_schema = schema
    return app.openapi_schema
