"""The page's own files: compressed once, and kept by browsers until they change.

``index.html`` names the other files with a hash of their content (``cockpit.js?v=…``), and what the build splits off
has one in its name. Such an address never means anything else, so that a browser need not ask for it again.
"""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import mimetypes
import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse, Response
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Scope

SMALLEST_PACKED: Final = 1000  #: bytes; to compress less saves nothing
_PACKED: Final = re.compile(r"text/.*|application/(javascript|json)|image/svg\+xml")
_NAMED_BY_HASH: Final = re.compile(r".+-[A-Z0-9]{8}\.\w+")
_REFERENCE: Final = re.compile(r'"/static/([\w.-]+)"')
_FOR_GOOD: Final = "private, max-age=31536000, immutable"


@dataclass(frozen=True, slots=True)
class _File:
    """A file as it was read; ``stamp`` tells whether it has changed since."""

    stamp: tuple[int, int]
    kind: str
    hash: str
    plain: bytes
    packed: bytes | None  #: None: it is sent as it is


class PageFiles(StaticFiles):
    """Serves the folder of the page.

    Args:
        folder: The folder; it may be missing.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder, check_dir=False)
        self._index = folder / "index.html"
        self._files: dict[str, _File] = {}

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return a file, compressed where the browser takes that."""
        try:
            full, found = self.lookup_path(path)
        except (OSError, ValueError):
            full, found = "", None
        if scope["method"] not in ("GET", "HEAD") or found is None or not stat.S_ISREG(found.st_mode):
            return await super().get_response(path, scope)
        file = await self._read(full, found)
        version = scope["query_string"].decode("latin-1").partition("=")[2]
        for_good = version == file.hash or _NAMED_BY_HASH.fullmatch(path) is not None
        return self._answer(file, Headers(scope=scope), _FOR_GOOD if for_good else "no-cache")

    async def page(self) -> Response:
        """Return the page itself, which names its files by what is in them."""
        try:
            text = self._index.read_text()
        except OSError:
            return PlainTextResponse(f"The page is not built: there is no {self._index}. Run make in the sources.", 503)
        hashes: dict[str, str] = {}
        for name in set(_REFERENCE.findall(text)):
            full, found = self.lookup_path(name)
            if found is not None and stat.S_ISREG(found.st_mode):
                hashes[name] = (await self._read(full, found)).hash

        def named(reference: re.Match[str]) -> str:
            name = reference[1]
            return f'"/static/{name}?v={hashes[name]}"' if name in hashes else reference[0]

        return Response(_REFERENCE.sub(named, text), media_type="text/html")

    def _answer(self, file: _File, headers: Headers, cache: str) -> Response:
        packs = file.packed is not None and "gzip" in headers.get("accept-encoding", "")
        answer = Response(file.packed if packs else file.plain, media_type=file.kind)
        answer.headers["cache-control"] = cache
        answer.headers["etag"] = f'"{file.hash}{"-gz" if packs else ""}"'
        answer.headers["vary"] = "Accept-Encoding"
        if packs:
            answer.headers["content-encoding"] = "gzip"
        return NotModifiedResponse(answer.headers) if self.is_not_modified(answer.headers, headers) else answer

    async def _read(self, full: str, found: os.stat_result) -> _File:
        stamp = (found.st_mtime_ns, found.st_size)
        file = self._files.get(full)
        if file is None or file.stamp != stamp:
            # On a thread: the 3-D view takes some 30 ms to compress, and pilots' commands wait for nothing here.
            file = self._files[full] = await asyncio.to_thread(_read, full, stamp)
        return file


def _read(full: str, stamp: tuple[int, int]) -> _File:
    plain = Path(full).read_bytes()
    kind = mimetypes.guess_type(full)[0] or "application/octet-stream"
    packs = len(plain) >= SMALLEST_PACKED and _PACKED.fullmatch(kind) is not None
    packed = gzip.compress(plain, 9, mtime=0) if packs else None
    return _File(stamp, kind, hashlib.sha256(plain).hexdigest()[:16], plain, packed)
