"""What the client raises."""

from __future__ import annotations


class ServiceError(Exception):
    """The service refused or could not be reached: status (0: not reached), stable code, text, advice."""

    def __init__(self, status: int, code: str, message: str, advice: str = "") -> None:
        super().__init__(f"{message} {advice}".strip())
        self.status, self.code, self.message, self.advice = status, code, message, advice
