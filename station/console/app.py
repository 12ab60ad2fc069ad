"""The whole console as one ASGI application."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from starlette.requests import Request
from starlette.responses import Response

from station import __version__
from station.archive.phrases import PHRASES
from station.console.api import booth, live, results, scans
from station.console.api.console import Console
from station.console.api.problems import Problem, install
from station.console.assets import Asset, Assets
from station.console.security.gate import Gate
from station.console.security.origin import own_names

PREFIX = "/api/v1"
STATIC = Path(__file__).parent / "static"
_REPORT_PERIOD_S = 0.2
"""Shorter than the period of health reports, so that none is left out."""


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
    assets = Assets(STATIC)
    for path, asset in (
        ("/", assets["index.html"]),
        ("/person", assets["person.html"]),
        (f"{PREFIX}/docs", assets["docs.html"]),
        # The page's words for what the station says are those of the printed sheet.
        ("/static/phrases.json", Asset.read(PHRASES)),
    ):
        app.add_route(path, _sender(asset))
    app.mount("/static", assets, name="static")


def _sender(asset: Asset) -> Any:
    async def file(request: Request) -> Response:
        return asset.answer(request.headers)

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
