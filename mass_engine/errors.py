"""Errors that carry a stable code and one sentence of advice, so that a caller can act on them."""

from __future__ import annotations

#: The code of a failure that a smaller setting may avoid: a device's memory did not suffice.
OUT_OF_MEMORY = "device.out_of_memory"


class EngineError(Exception):
    """The input cannot be used (exit code 3).

    ``code`` is stable and dotted (``video.no_hand``), ``message`` says what is wrong,
    ``advice`` says what the user can do about it.
    """

    def __init__(self, code: str, message: str, advice: str) -> None:
        super().__init__(f"{code}: {message} {advice}")
        self.code = code
        self.message = message
        self.advice = advice


class BadArgumentError(EngineError):
    """The request itself is wrong: a pose, camera or option that does not parse (exit code 2)."""
