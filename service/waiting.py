"""A bounded line of those who wait for one of a few things: owners take turns, each one's in order."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Turn(Generic[T]):
    """One place in the line."""

    def __init__(self, owner: str) -> None:
        self.owner = owner
        self.given: T | None = None
        self._over = threading.Event()

    def wait(self, seconds: float) -> T | None:
        """What was given; None after ``seconds``, or when the place was lost."""
        self._over.wait(seconds)
        return self.given

    def end(self, given: T | None) -> None:
        """Give, or send away with nothing."""
        self.given = given
        self._over.set()


class Line(Generic[T]):
    """Not thread-safe: all but :meth:`Turn.wait` is called under one lock of the user's."""

    def __init__(self, room: int) -> None:
        self._room = room
        self._turns: OrderedDict[str, deque[Turn[T]]] = OrderedDict()

    def __len__(self) -> int:
        return sum(map(len, self._turns.values()))

    def join(self, owner: str) -> Turn[T] | None:
        """A place at the end; None when there is no room.

        Whoever has the most places loses the last of them to an owner who would still have fewer: one owner
        alone may fill the line, but keeps nobody out of it.
        """
        if len(self) >= self._room:
            longest = max(self._turns.values(), key=len, default=deque[Turn[T]]())
            if len(longest) <= len(self._turns.get(owner, ())) + 1:
                return None
            longest.pop().end(None)
        turn = Turn[T](owner)
        self._turns.setdefault(owner, deque()).append(turn)
        return turn

    def leave(self, turn: Turn[T]) -> None:
        """Give the place up, if it is still held."""
        waiting = self._turns.get(turn.owner)
        if waiting is not None and turn in waiting:
            waiting.remove(turn)
            if not waiting:
                del self._turns[turn.owner]

    def serve(self, thing: T) -> bool:
        """Give it to whoever's turn it is. False when nobody waits."""
        if not self._turns:
            return False
        owner, waiting = self._turns.popitem(last=False)
        waiting.popleft().end(thing)
        if waiting:
            self._turns[owner] = waiting  # behind the others now
        return True

    def clear(self) -> None:
        """Send everybody away."""
        for waiting in self._turns.values():
            for turn in waiting:
                turn.end(None)
        self._turns.clear()
