"""Signed links: a path that works without a key for a few minutes, for a browser's img, a or EventSource."""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import secrets
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import parse_qsl, urlencode

MAX_SECONDS = 3600
_EXPIRES, _SIGNATURE = "expires", "signature"


class Signer:
    """Signs and checks links with a secret of the service."""

    def __init__(self, secret: bytes, clock: Callable[[], float] = time.time) -> None:
        self._secret = secret
        self._clock = clock

    def sign(self, path: str, query: str, seconds: int) -> tuple[str, float]:
        """The link for ``path?query``, and the time (since 1970) until which it works."""
        until = int(self._clock()) + min(max(seconds, 1), MAX_SECONDS)
        pairs = [(k, v) for k, v in _pairs(query) if k not in (_EXPIRES, _SIGNATURE)]
        pairs.append((_EXPIRES, str(until)))
        return f"{path}?{urlencode([*pairs, (_SIGNATURE, self._mark(path, pairs))])}", until

    def check(self, path: str, query: str) -> bool:
        """Whether the signature is ours, covers this path and query, and has not run out."""
        pairs = _pairs(query)
        signatures = [v for k, v in pairs if k == _SIGNATURE]
        until = [v for k, v in pairs if k == _EXPIRES]
        signed = [(k, v) for k, v in pairs if k != _SIGNATURE]
        if len(signatures) != 1 or len(until) != 1 or not until[0].isascii() or not until[0].isdecimal():
            return False
        same = hmac.compare_digest(signatures[0].encode(), self._mark(path, signed).encode())
        return same and int(until[0][:12]) >= self._clock()

    def _mark(self, path: str, pairs: list[tuple[str, str]]) -> str:
        text = f"GET\n{path}\n{urlencode(sorted(pairs))}"
        return hmac.new(self._secret, text.encode(), hashlib.sha256).hexdigest()


def is_signed(query: str) -> bool:
    """Whether a query carries a signature, good or bad."""
    return any(k == _SIGNATURE for k, _ in _pairs(query))


def service_secret(given: str, data_dir: Path) -> bytes:
    """The secret of the settings, else one kept in the data directory (made at the first call)."""
    if given:
        return given.encode()
    path = data_dir / "run" / "secret"
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    with contextlib.suppress(FileExistsError):
        part = path.with_name(f"secret.{os.getpid()}")
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(secrets.token_bytes(32))
        try:
            os.link(part, path)  # whole or not at all, and the first one wins
        finally:
            part.unlink()
    return path.read_bytes()


def _pairs(query: str) -> list[tuple[str, str]]:
    return parse_qsl(query, keep_blank_values=True)
