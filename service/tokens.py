"""Named tokens with scopes, kept as digests in the data folder, and the log of what they wrote."""

from __future__ import annotations

import hashlib
import hmac
import json
import logging
import os
import secrets
import tempfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

from spheremark.pipelines.errors import ConflictError, InputError, NotFoundError

logger = logging.getLogger(__name__)

TOKENS = "tokens.json"
AUDIT = "audit.jsonl"  # in the data folder
BITS_MIN = 128
_CHARACTERS_MIN = 22  # of Base64, 6 bits each
_DISTINCT_MIN = 8  # different characters; random tokens have twice as many
_NAME_MAX = 100


class Scope(StrEnum):
    """What a token allows; each scope includes those before it."""

    READ = "read"
    WRITE = "write"
    ADMIN = "admin"

    def includes(self, needed: Scope) -> bool:
        """Whether this scope is enough."""
        order = list(Scope)
        return order.index(self) >= order.index(needed)


@dataclass(frozen=True, slots=True, kw_only=True)
class Token:
    """A token without its secret: name, scope, SHA-256 of its text, and when it was made."""

    name: str
    scope: Scope
    sha256: str
    created_at: str

    @property
    def cookie(self) -> str:
        """What a browser keeps in place of the token."""
        key = bytes.fromhex(self.sha256)
        return hmac.new(key, b"spheremark cookie", hashlib.sha256).hexdigest()


def is_strong(text: str) -> bool:
    """Whether a token can have 128 bits: by its length, and by how many characters differ."""
    return len(text) >= _CHARACTERS_MIN and len(set(text)) >= _DISTINCT_MIN


class Tokens:
    """The tokens of a data folder, and the one of the settings, whose scope is admin."""

    def __init__(self, data: Path, own: str = "") -> None:
        self._path = data / TOKENS
        self._own = _token("settings", Scope.ADMIN, own) if own else None
        self._stamp: int | None = None
        self._kept: tuple[Token, ...] = ()

    def all(self) -> tuple[Token, ...]:
        """Return the tokens that are valid now: one that was revoked is gone at once."""
        try:
            stamp = self._path.stat().st_mtime_ns
        except FileNotFoundError:
            stamp = None
        if stamp != self._stamp:
            self._kept = tuple(_read(self._path))
            self._stamp = stamp
        return (*self._kept, self._own) if self._own else self._kept

    def of_text(self, text: str) -> Token | None:
        """Return the token with this text."""
        given = hashlib.sha256(text.encode()).hexdigest()
        found = [one for one in self.all() if hmac.compare_digest(one.sha256, given)]
        return found[0] if found else None

    def of_cookie(self, value: str) -> Token | None:
        """Return the token that a browser has logged in with."""
        given = value.encode()
        found = [one for one in self.all() if hmac.compare_digest(one.cookie.encode(), given)]
        return found[0] if found else None

    def make(self, name: str, scope: Scope) -> str:
        """Add a token and return its text, which is kept nowhere."""
        if not name.isprintable() or not 0 < len(name.strip()) <= _NAME_MAX:
            raise InputError(
                f"The name is {name!r}; it must have 1 to {_NAME_MAX} printable characters."
            )
        if any(one.name == name for one in self.all()):
            raise ConflictError(f"There is already a token called {name!r}; revoke it first.")
        text = f"sm_{secrets.token_urlsafe(32)}"
        _write(self._path, [*_read(self._path), _token(name, scope, text)])
        return text

    def revoke(self, name: str) -> None:
        """Remove a token."""
        kept = list(_read(self._path))
        left = [one for one in kept if one.name != name]
        if len(left) == len(kept):
            raise NotFoundError(f"There is no token called {name!r} in {self._path.parent}.")
        _write(self._path, left)


def _token(name: str, scope: Scope, text: str) -> Token:
    """Return a token without its text."""
    digest = hashlib.sha256(text.encode()).hexdigest()
    made = datetime.now(UTC).isoformat(timespec="seconds")
    return Token(name=name, scope=scope, sha256=digest, created_at=made)


def _read(path: Path) -> Iterable[Token]:
    """Yield the tokens of a file; none without one."""
    if path.exists():
        for one in json.loads(path.read_text("utf-8")):
            yield Token(**one | {"scope": Scope(one["scope"])})


def _write(path: Path, tokens: Iterable[Token]) -> None:
    """Replace the tokens of a file, which only its user may read."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, part = tempfile.mkstemp(dir=path.parent)
    with os.fdopen(handle, "w") as file:
        json.dump([asdict(one) for one in tokens], file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    Path(part).replace(path)


class Audit:
    """Appends each request that writes, or was not allowed to, to a file of the data folder."""

    def __init__(self, data: Path) -> None:
        self._path = data / AUDIT

    def add(self, **entry: Any) -> None:
        """Append an entry."""
        line = json.dumps({"at": datetime.now(UTC).isoformat(timespec="milliseconds"), **entry})
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
        try:
            with os.fdopen(os.open(self._path, flags, 0o600), "w") as file:
                file.write(line + "\n")
        except FileNotFoundError:  # the data folder is not made yet
            return
        except OSError as error:  # a full disk must not refuse what the database could still keep
            logger.warning("Not in the audit log (%s): %s", error.strerror, line)

    def last(self, n: int) -> list[dict[str, Any]]:
        """Return the newest entries, newest first."""
        if not self._path.exists():
            return []
        lines = self._path.read_text("utf-8").splitlines()[-n:]
        return [json.loads(line) for line in reversed(lines)]
