"""What every request passes first: host, origin and token are checked, headers are set.

Hides how a browser can be turned against a service on this machine, and what stops it.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import re
from collections.abc import Mapping
from time import monotonic

from fastapi import Request
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from spheremark.pipelines.errors import SpheremarkError
from spheremark.service.errors import (
    ForbiddenError,
    MalformedHeaderError,
    TooLargeError,
    UnauthorizedError,
    problem_of,
)
from spheremark.service.http.errors import problem_response
from spheremark.service.settings import Settings
from spheremark.service.tokens import Audit, Token, Tokens
from spheremark.service.tokens import Scope as AccessScope

COOKIE = "spheremark_token"
OPEN_PATHS = ("/healthz", "/readyz", "/login", "/static/")  # open without the token
ADMIN_PATHS = ("/api/v1/audit",)
READING_PATHS = (
    "/api/v1/sql",
    *(f"/api/v1/plans/{verb}" for verb in ("evaluate", "optimise", "suggest", "random")),
)
LONG_PATHS = ("/api/v1/recordings", "/api/v1/terrains")  # streamed, with a limit of their own
UPLOADS = "/api/v1/uploads/"  # and what is below it
BODY_MAX = 16 << 20  # [bytes] of any other body
BODY_SECONDS = 120.0  # until such a body has arrived
IDLE_SECONDS = 30.0  # between two parts of a body
SLOWEST = 1 << 10  # [bytes/s] of a body of any size, after that time
UNREAD_MAX = 1 << 30  # [bytes] of a refused body that are read before the response is sent
UNREAD_SECONDS = 30.0
_SHOWN = 80  # characters of a malformed header that its refusal repeats
SAFE_METHODS = ("GET", "HEAD", "OPTIONS")

POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self' 'sha256-47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU='",  # see below
        "style-src-attr 'unsafe-inline'",
        "img-src 'self' data: blob:",
        "font-src 'self'",
        "connect-src 'self'",
        "frame-ancestors 'none'",
        "base-uri 'none'",
        "form-action 'self'",
    )
)
"""Plotly fills one style element, empty as the policy sees it (its hash), and sets attributes."""

HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


_NAME = r"[^\s/?#@:\[\]\\]+"
_HOST = re.compile(rf"(?P<name>{_NAME}|\[(?P<ipv6>[0-9A-Fa-f:.]+)\])(:\d{{1,5}})?", re.ASCII)
_ORIGIN = re.compile(r"null|[A-Za-z][A-Za-z0-9+.-]*://(?P<host>.*)", re.ASCII)
_LENGTH = re.compile(r"\d{1,18}", re.ASCII)


class SecureHeaders:
    """Wraps an application and all its middleware: every response carries the headers."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self.app(scope, receive, send_with_headers)


class SecurityMiddleware:
    """Wraps an application: refuses malformed and foreign requests, and those without the token."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app = app
        self.own_host = settings.host
        self.tokens = Tokens(settings.data, settings.token_text)
        self.audit = Audit(settings.data)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        request = Request(scope)
        body = _Body(receive, request)
        token: Token | None = None

        async def send_after_body(message: Message) -> None:
            if message["type"] == "http.response.start":
                self.note(request, token, message["status"])
                if message["status"] >= 400:
                    await body.read_to_its_end()
            await send(message)

        try:
            token = self.check(request)
        except SpheremarkError as error:
            response = problem_response(problem_of(error, scope["path"]), _challenge(error))
            await response(scope, receive, send_after_body)
            return
        await self.app(scope, body.receive, send_after_body)

    def note(self, request: Request, token: Token | None, status: int) -> None:
        """Write into the audit log what changes something, and what was not allowed to."""
        if request.method not in SAFE_METHODS or status in (401, 403):
            self.audit.add(
                token=token.name if token else "",
                method=request.method,
                path=request.scope["path"],
                status=status,
                client=request.client.host if request.client else "",
            )

    def check(self, request: Request) -> Token | None:
        """Raise unless the request may pass; return its token, where tokens are needed."""
        headers, path = request.headers, request.scope["path"]
        check_form(headers)
        host = headers.get("host", "")
        needs_token = bool(self.tokens.all())
        if not (needs_token or is_trustworthy(host, self.own_host)):
            raise ForbiddenError(
                f"The request is for the host {host!r}, a name that others can point at this "
                "machine; use 127.0.0.1 or localhost."
            )
        if request.method not in SAFE_METHODS and is_cross_site(headers):
            raise ForbiddenError(
                "A page of another site sent this request; only pages of this service may change "
                "things here."
            )
        declared = int(headers.get("content-length", "0"))
        if not is_long(path) and declared > BODY_MAX:
            raise _too_large(f"{declared:,}")
        if not needs_token or path.startswith(OPEN_PATHS):
            return None
        token = token_of(request, self.tokens)
        if token is None:
            raise UnauthorizedError(
                "This service needs a token: send 'Authorization: Bearer <token>', or log in at "
                "/login in a browser."
            )
        needed = scope_of(request.method, path)
        if not token.scope.includes(needed):
            raise ForbiddenError(
                f"The token {token.name!r} allows to {token.scope}; this needs {needed}. Make one "
                f"with `spheremark token create NAME --scope {needed}`."
            )
        return token


def scope_of(method: str, path: str) -> AccessScope:
    """Return the scope that a request needs."""
    if path.startswith(ADMIN_PATHS):
        return AccessScope.ADMIN
    is_reading = method in SAFE_METHODS or path in READING_PATHS
    return AccessScope.READ if is_reading else AccessScope.WRITE


def is_long(path: str) -> bool:
    """Whether a path takes whole files."""
    return path in LONG_PATHS or path.startswith(UPLOADS)


def check_form(headers: Headers) -> None:
    """Raise MalformedHeaderError unless Host, Origin and Content-Length have the form of HTTP."""
    for name, expected, is_well_formed in (
        ("host", "one host and perhaps a port, such as localhost:8000", _is_host),
        ("origin", "null or scheme://host:port", _is_origin),
        ("content-length", "one number of bytes", _LENGTH.fullmatch),
    ):
        values = headers.getlist(name)
        if len(values) > 1 or not all(is_well_formed(value) for value in values):
            found = ", ".join(repr(value[:_SHOWN]) for value in values)
            raise MalformedHeaderError(f"The header {name} is {found}; {expected} is expected.")


def _is_host(text: str) -> bool:
    """Whether this is a host with or without a port; no text is well-formed, too (RFC 9110)."""
    found = _HOST.fullmatch(text)
    if found is None:
        return not text
    try:
        return not found["ipv6"] or bool(ipaddress.IPv6Address(found["ipv6"]))
    except ValueError:
        return False


def _is_origin(text: str) -> bool:
    """Whether this is an origin as browsers send it."""
    found = _ORIGIN.fullmatch(text)
    return found is not None and _is_host(found["host"] or "")


def is_trustworthy(host: str, own_host: str) -> bool:
    """Whether no other party can make this well-formed Host lead here (DNS rebinding).

    Addresses and names without a dot cannot be registered by others; a name with one can.
    """
    found = _HOST.fullmatch(host)
    name = (found["ipv6"] or found["name"]).lower() if found else ""
    if name == own_host or "." not in name or name.endswith(".localhost"):
        return bool(name)
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_cross_site(headers: Headers) -> bool:
    """Whether the headers of a browser name a page of another origin."""
    if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
        return True
    origin = headers.get("origin")
    return origin is not None and origin.partition("://")[2] != headers.get("host", "")


def token_of(request: Request, tokens: Tokens) -> Token | None:
    """Return the token of a request: of its header, or of a cookie."""
    scheme, _, given = request.headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return tokens.of_text(given.strip())
    # Python's own parser of cookies takes quadratic time up to 3.11.9 and 3.12.5
    pairs = (one.strip().partition("=") for one in request.headers.get("cookie", "").split(";"))
    found = (tokens.of_cookie(value) for name, _, value in pairs if name == COOKIE)
    return next((one for one in found if one is not None), None)


class _Body:
    """The body of a request: bounded, and read to its end before a refusal is sent.

    A sender that is still sending reads no response: its connection is reset.
    """

    def __init__(self, receive: Receive, request: Request) -> None:
        headers = request.headers
        self._receive = receive
        self._n_bytes = 0
        self._is_bounded = not is_long(request.scope["path"])
        self._begin = monotonic()
        self._expects_continue = "expect" in headers  # sends nothing before 100 Continue
        self._is_open = headers.get("content-length", "0") != "0" or "transfer-encoding" in headers

    async def receive(self) -> Message:
        """Return the next part; HTTPException if it is too late, or more than any route reads."""
        try:
            async with asyncio.timeout(self._seconds()):
                message = await self._next()
        except TimeoutError:
            self._is_open = False  # nothing more is awaited of it
            raise HTTPException(
                408,
                f"The body came too slowly: {self._n_bytes:,} bytes in "
                f"{monotonic() - self._begin:.0f} s. Send it again, or in parts "
                "(/api/v1/uploads) where the connection is slow.",
                headers={"Connection": "close"},
            ) from None
        if self._is_bounded and self._n_bytes > BODY_MAX:
            error = _too_large(f"over {BODY_MAX:,}")
            raise HTTPException(413, str(error))  # the one kind that passes FastAPI while it reads
        return message

    def _seconds(self) -> float | None:
        """Return how long the next part may take [s]; after the end of the body, for ever."""
        if not self._is_open:
            return None
        allowed = BODY_SECONDS + (0.0 if self._is_bounded else self._n_bytes / SLOWEST)
        return max(0.0, min(IDLE_SECONDS, self._begin + allowed - monotonic()))

    async def read_to_its_end(self) -> None:
        """Throw away what is still to come, within reason."""
        if self._expects_continue and not self._n_bytes:
            return
        n_most = self._n_bytes + UNREAD_MAX
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(UNREAD_SECONDS):
                while self._is_open and self._n_bytes < n_most:
                    await self._next()

    async def _next(self) -> Message:
        """Return the next part, counted."""
        message = await self._receive()
        self._n_bytes += len(message.get("body", b""))
        self._is_open = bool(message.get("more_body", False))
        return message


def _too_large(found: str) -> TooLargeError:
    """Return the refusal of a body that no route reads."""
    return TooLargeError(
        f"The body has {found} bytes; {BODY_MAX:,} are the most that this address takes. Send less "
        f"at a time; files go whole to {' and '.join(LONG_PATHS)}."
    )


def _challenge(error: SpheremarkError) -> dict[str, str]:
    """Return the header that a 401 must have."""
    return {"WWW-Authenticate": "Bearer"} if isinstance(error, UnauthorizedError) else {}
