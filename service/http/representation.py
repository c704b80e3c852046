"""What every GET has beside its content: a HEAD, an entity tag where it is JSON, compression."""

from __future__ import annotations

import hashlib

import anyio
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_HAVE_THEIR_OWN = "/api/v1/uploads/"  # HEAD of a resumable upload
_TAGGED = ("application/json", "application/geo+json")
_COMPRESS_FROM = 1 << 10  # [bytes]; less fits into a packet
_LEVEL = 5  # of gzip; 9 takes three times as long for 2 % less
_COMPRESSED = (  # already, or noise
    *DEFAULT_EXCLUDED_CONTENT_TYPES,
    "application/octet-stream",
    "application/vnd.apache.arrow.stream",
    "application/vnd.apache.parquet",
    "application/vnd.duckdb",
    "application/vnd.laszip",
    "application/vnd.mcap",
    "image/tiff",
    "model/e57",
)


class Representation:
    """Wraps an application: HEAD has the headers of GET, JSON an entity tag, text is compressed."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = GZipMiddleware(
            _Tagged(app),
            minimum_size=_COMPRESS_FROM,
            compresslevel=_LEVEL,
            exclude_content_types=_COMPRESSED,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        is_head = scope["type"] == "http" and scope["method"] == "HEAD"
        if not is_head or scope["path"].startswith(_HAVE_THEIR_OWN):
            await self.app(scope, receive, send)
            return
        scope["method"] = "GET"
        with anyio.CancelScope() as sending:

            async def send_head(message: Message) -> None:
                if message["type"] == "http.response.start":
                    scope["method"] = "HEAD"  # as metrics and log have it
                    await send(message)
                    await send({"type": "http.response.body", "body": b""})
                    sending.cancel()  # its content may be long, or never end

            await self.app(scope, receive, send_head)


class _Tagged:
    """Wraps an application: JSON that has not changed is not sent again (RFC 9110, 13.1.2)."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http" or scope["method"] != "GET":
            await self.app(scope, receive, send)
            return
        known = Headers(scope=scope).get("if-none-match", "")
        start: Message | None = None

        async def send_tagged(message: Message) -> None:
            nonlocal start
            if message["type"] == "http.response.start" and _is_tagged(message):
                start = message
                return
            if start is None:
                await send(message)
                return
            begin, start = start, None
            if not message.get("more_body", False):
                begin, message = _tagged(begin, message, known)
            await send(begin)
            await send(message)

        await self.app(scope, receive, send_tagged)


def _is_tagged(start: Message) -> bool:
    """Return whether a response is to have a tag."""
    headers = Headers(raw=start["headers"])
    kind = headers.get("content-type", "").partition(";")[0]
    return start["status"] == 200 and kind in _TAGGED and "etag" not in headers


def _tagged(start: Message, body: Message, known: str) -> tuple[Message, Message]:
    """Return a response with its tag; without its content where that is known."""
    tag = f'W/"{hashlib.sha256(body.get("body", b"")).hexdigest()[:32]}"'
    headers = MutableHeaders(raw=start["headers"])
    headers["ETag"] = tag
    headers.setdefault("Cache-Control", "no-cache")  # may be kept, and is to be compared
    if known.strip() != "*" and tag not in (one.strip() for one in known.split(",")):
        return start, body
    del headers["Content-Length"]
    return {**start, "status": 304}, {**body, "body": b""}
