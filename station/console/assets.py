"""The page's own files, from memory; a browser keeps them and asks each time if they changed."""

from __future__ import annotations

import gzip
import hashlib
import mimetypes
from collections.abc import AsyncIterator, Iterable
from dataclasses import dataclass
from pathlib import Path

from starlette.datastructures import Headers
from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

_SMALLEST_PACKED = 500
"""Bytes; below, packing saves no packet."""
_LEVEL = 5
_PIECE_BYTES = 32 << 10
"""Most that is kept for a reader that reads nothing."""
_TYPES = {".js": "text/javascript", ".svg": "image/svg+xml"}


@dataclass(frozen=True, slots=True)
class Asset:
    """One file as it is sent."""

    plain: bytes
    packed: bytes
    """gzip; empty where it would not be smaller."""
    tag: str
    media_type: str

    @staticmethod
    def read(path: Path) -> Asset:
        plain = path.read_bytes()
        # The same bytes each time: a file's name and time are left out.
        packed = gzip.compress(plain, _LEVEL, mtime=0) if len(plain) >= _SMALLEST_PACKED else b""
        media = _TYPES.get(path.suffix) or mimetypes.guess_type(path.name)[0]
        return Asset(
            plain,
            packed if len(packed) < len(plain) else b"",
            f'W/"{hashlib.sha256(plain).hexdigest()[:32]}"',
            media or "text/plain",
        )

    def answer(self, request: Headers) -> Response:
        """The file, or that the browser has it."""
        headers = {"etag": self.tag, "cache-control": "no-cache", "vary": "Accept-Encoding"}
        known = {tag.strip() for tag in request.get("if-none-match", "").split(",")}
        if self.tag in known:
            return Response(status_code=304, headers=headers)
        accepts = (word.partition(";")[0].strip() for word in _encodings(request))
        if self.packed and "gzip" in accepts:
            headers["content-encoding"] = "gzip"
            return self._sent(self.packed, headers)
        return self._sent(self.plain, headers)

    def _sent(self, content: bytes, headers: dict[str, str]) -> Response:
        if len(content) <= _PIECE_BYTES:
            return Response(content, headers=headers, media_type=self.media_type)
        headers["content-length"] = str(len(content))
        return StreamingResponse(_pieces(content), headers=headers, media_type=self.media_type)


async def _pieces(content: bytes) -> AsyncIterator[bytes]:
    for start in range(0, len(content), _PIECE_BYTES):
        yield content[start : start + _PIECE_BYTES]


def _encodings(request: Headers) -> Iterable[str]:
    return request.get("accept-encoding", "").split(",")


class Assets:
    """All files of a folder as an ASGI application; nothing else can be asked for."""

    def __init__(self, folder: Path) -> None:
        self._assets = {
            path.relative_to(folder).as_posix(): Asset.read(path)
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }

    def __getitem__(self, name: str) -> Asset:
        return self._assets[name]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        name = scope["path"].removeprefix(scope.get("root_path", "")).lstrip("/")
        asset = self._assets.get(name)
        if scope["method"] not in ("GET", "HEAD"):
            response = Response(status_code=405, headers={"allow": "GET, HEAD"})
        elif asset is None:
            response = Response("there is no such file", status_code=404)
        else:
            response = asset.answer(Headers(scope=scope))
        await response(scope, receive, send)
