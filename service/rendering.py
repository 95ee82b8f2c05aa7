"""A bounded pool of render processes. The only place of the service that touches the engine.

Each process keeps the avatars it used last in memory and makes one picture at a time. This process imports no
torch: the engine is imported by the function that runs in the child. A child that hangs is killed, one that
dies is replaced, and the request is answered with a problem either way.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import threading
from collections import OrderedDict
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from service.pictures import View
from service.problems import Kind, ProblemError
from service.settings import Settings
from service.waiting import Line

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

log = logging.getLogger(__name__)


class RenderRefusedError(Exception):
    """The engine said no. ``argument``: the pose or camera is to blame (422), else the avatar (500)."""

    def __init__(self, code: str, message: str, advice: str, *, argument: bool) -> None:
        super().__init__(code, message, advice)
        self.code, self.message, self.advice, self.argument = code, message, advice, argument


class Renderer(Protocol):
    """A loaded avatar: makes uint8 [H,W,4] straight-alpha RGBA pictures. Raises RenderRefusedError."""

    def render(self, pose: str, camera: str, width: int, height: int, channel: str) -> NDArray[np.uint8]:
        """One picture of one channel."""
        ...


#: Loads an avatar in a render process; given by reference, so a module-level function.
Loader = Callable[[Path], Renderer]


class _EngineAvatar:
    """The engine's avatar with its errors in this module's terms."""

    def __init__(self, path: Path) -> None:
        from mass_engine import Avatar, EngineError

        try:
            self._avatar = Avatar.load(path)
        except EngineError as error:
            raise RenderRefusedError(error.code, error.message, error.advice, argument=False) from error

    def render(self, pose: str, camera: str, width: int, height: int, channel: str) -> NDArray[np.uint8]:
        from mass_engine import BadArgumentError, EngineError

        try:
            image: NDArray[np.uint8] = self._avatar.render(pose, camera, width, height, channel)
        except EngineError as error:
            argument = isinstance(error, BadArgumentError)
            raise RenderRefusedError(error.code, error.message, error.advice, argument=argument) from error
        return image


def load_avatar(path: Path) -> Renderer:
    """The real loader: ``mass_engine.Avatar``."""
    return _EngineAvatar(path)


def warm_engine() -> None:
    """Import the engine ahead of the first request; if that fails, each request will say so."""
    try:
        from mass_engine import Avatar  # noqa: F401
    except ImportError:
        log.exception("the engine cannot be imported")


class RenderPool:
    """Makes pictures in ``workers`` processes; at most ``queue`` requests wait for one of them.

    First come, first served among the requests of one owner; owners take turns (service/waiting.py).
    """

    def __init__(
        self,
        loader: Loader = load_avatar,
        *,
        workers: int = 1,
        queue: int = 16,
        timeout: float = 10.0,
        load_timeout: float = 60.0,
        warm: int = 4,
    ) -> None:
        self._loader = loader
        self._workers = workers
        self._timeout = timeout
        self._load_timeout = load_timeout
        self._warm = warm
        #: Nobody is in the line while a process is idle.
        self._line: Line[_Child] = Line(queue)
        self._idle: list[_Child] = []
        self._busy: set[_Child] = set()
        self._closed = False
        self._lock = threading.Lock()

    def start(self) -> None:
        """Start the processes; returns before they are ready."""
        with self._lock:
            while len(self._idle) + len(self._busy) < self._workers:
                self._idle.append(_Child(self._loader, self._warm))

    def render(self, avatar: Path, view: View, owner: str = "") -> bytes:
        """One encoded picture. Blocks. Raises ProblemError: busy, too slow, refused or failed."""
        child = self._acquire(avatar, owner)
        answer: tuple[Any, ...] | None = None
        try:
            limit = self._timeout if child.keeps(avatar) else self._load_timeout
            answer = child.ask(avatar, view, limit)
        except TimeoutError:
            raise ProblemError(Kind.RENDER_TIMEOUT, headers={"Retry-After": "5"}) from None
        except (EOFError, OSError) as error:
            log.warning("render process %s died: %r", child.pid, error)
            raise ProblemError(Kind.RENDER_FAILED, "The render process died and was replaced.") from error
        finally:
            self._give_back(child, healthy=answer is not None)
        if answer[0] == "picture":
            picture: bytes = answer[1]
            return picture
        _, code, message, advice, argument = answer
        kind = Kind.RENDER_REFUSED if argument else Kind.RENDER_FAILED
        raise ProblemError(kind, message, code=code, advice=advice)

    def close(self) -> None:
        """End the processes; a picture in the making is lost."""
        with self._lock:
            self._closed = True
            children = [*self._idle, *self._busy]
            self._idle.clear()
            self._line.clear()
        for child in children:
            child.stop(1.0)

    def pids(self) -> list[int]:
        """Process ids of the pool, for monitoring."""
        with self._lock:
            return [child.pid for child in (*self._idle, *self._busy)]

    def _acquire(self, avatar: Path, owner: str) -> _Child:
        with self._lock:
            if self._idle:
                child = next((child for child in self._idle if child.keeps(avatar)), self._idle[0])
                self._idle.remove(child)
                self._busy.add(child)
                return child
            turn = None if self._closed else self._line.join(owner)
        if turn is None:
            raise _busy()
        given = turn.wait(self._timeout)
        if given is None:
            with self._lock:
                self._line.leave(turn)
                given = turn.given  # it may have come at the last moment
        if given is None:
            raise _busy()
        return given

    def _give_back(self, child: _Child, *, healthy: bool) -> None:
        if not healthy:
            child.stop(0.0)
        with self._lock:
            self._busy.discard(child)
            if self._closed:
                return
            free = child if healthy else _Child(self._loader, self._warm)
            # Handed on, not put back: who asks just now may not overtake those who wait.
            if self._line.serve(free):
                self._busy.add(free)
            else:
                self._idle.append(free)


def _busy() -> ProblemError:
    return ProblemError(Kind.RENDER_BUSY, headers={"Retry-After": "1"})


class _Child:
    """The parent's end of one render process. Used by one thread at a time."""

    def __init__(self, loader: Loader, warm: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        arguments = (theirs, loader, warm)
        self._process = context.Process(target=_serve, args=arguments, name="mass-render", daemon=True)
        self._process.start()
        theirs.close()
        self._kept: frozenset[Path] = frozenset()
        self.pid = self._process.pid or 0

    def keeps(self, avatar: Path) -> bool:
        """Whether the avatar was loaded there when the process last answered."""
        return avatar in self._kept

    def ask(self, avatar: Path, view: View, timeout: float) -> tuple[Any, ...]:
        """One request. Raises TimeoutError, EOFError, OSError."""
        self._connection.send((avatar, view))
        if not self._connection.poll(timeout):
            raise TimeoutError
        answer: tuple[Any, ...]
        answer, self._kept = self._connection.recv()
        return answer

    def stop(self, grace: float) -> None:
        """End the process: it leaves when its pipe closes, or is killed after ``grace`` seconds."""
        self._connection.close()
        self._process.join(grace)
        if self._process.is_alive():
            self._process.kill()
        self._process.join(5.0)


def _serve(connection: Connection, loader: Loader, warm: int) -> None:
    """The render process: answers requests until its pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if loader is load_avatar:
        warm_engine()
    avatars: OrderedDict[Path, Renderer] = OrderedDict()
    while True:
        try:
            path, view = connection.recv()
        except EOFError:
            return
        try:
            if path not in avatars:
                avatars[path] = loader(path)
            avatars.move_to_end(path)
            while len(avatars) > warm:
                avatars.popitem(last=False)
            image = avatars[path].render(view.pose, view.camera, view.width, view.height, view.channel)
            answer: tuple[Any, ...] = ("picture", encode(image, view.format))
        except RenderRefusedError as error:
            answer = ("refused", error.code, error.message, error.advice, error.argument)
        except Exception:
            log.exception("rendering %s failed", view)
            answer = ("refused", None, "", None, False)
        connection.send((answer, frozenset(avatars)))


def encode(image: NDArray[np.uint8], format_name: str) -> bytes:
    """Encode uint8 [H,W,4] straight-alpha RGBA. JPEG has no alpha: the hand is put on white."""
    import cv2
    import numpy as np

    if format_name == "jpeg":
        alpha = cv2.cvtColor(np.ascontiguousarray(image[..., 3]), cv2.COLOR_GRAY2BGR)
        hand = cv2.multiply(cv2.cvtColor(image, cv2.COLOR_RGBA2BGR), alpha, scale=1.0 / 255.0)
        pixels = cv2.add(hand, cv2.bitwise_not(alpha))
        options = [cv2.IMWRITE_JPEG_QUALITY, 92]
    else:
        pixels = cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA)
        options = [cv2.IMWRITE_PNG_COMPRESSION, 3]
        if format_name == "webp":
            options = [cv2.IMWRITE_WEBP_QUALITY, 90]
    done, data = cv2.imencode(f".{format_name}", pixels, options)
    if not done:
        raise ValueError(f"OpenCV cannot write {format_name}")
    return bytes(data)


def create_pool(settings: Settings, loader: Loader = load_avatar) -> RenderPool:
    """The pool of ``settings``, not yet started."""
    return RenderPool(
        loader,
        workers=settings.render_workers,
        queue=settings.render_queue,
        timeout=settings.render_timeout,
        load_timeout=settings.render_load_timeout,
        warm=settings.render_warm_avatars,
    )
