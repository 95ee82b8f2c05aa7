"""Sending webhooks: signed (https://www.standardwebhooks.com), and never into a private network.

A receiver's name is looked up once, every address it has must be a public one, and the connection goes to
an address that was checked: a name that changes in between gains nothing. Redirects are not followed.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import ipaddress
import logging
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterable
from urllib.parse import urlsplit

import httpcore

from service.webhooks.outbox import Delivery, Outbox

log = logging.getLogger(__name__)

_SECONDS = 5.0
_MAX_ANSWER = 64 * 1024
_NAT64 = ipaddress.ip_network("64:ff9b::/96")

#: The addresses of a name; a test puts another one here.
Resolver = Callable[[str, int], list[str]]


class ForbiddenAddressError(Exception):
    """The receiver is, or may be, inside a private network."""


def resolve(host: str, port: int) -> list[str]:
    """All addresses of ``host``. Raises OSError."""
    return [str(entry[4][0]) for entry in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)]


def is_public(address: str) -> bool:
    """Whether an address is reachable for everybody, also when it hides inside an IPv6 one."""
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return False
    if isinstance(ip, ipaddress.IPv6Address):
        inner = ip.ipv4_mapped or ip.sixtofour or (ip.teredo[1] if ip.teredo else None)
        if ip in _NAT64:
            inner = ipaddress.IPv4Address(int(ip) & 0xFFFFFFFF)
        if inner is not None:
            return inner.is_global and not inner.is_multicast
    return ip.is_global and not ip.is_multicast


def check_url(url: str, *, private: bool = False) -> str | None:
    """What is wrong with a receiver's address, or None. ``private``: http and private addresses will do."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        return "It is not a URL."
    if parts.scheme != "https" and not (private and parts.scheme == "http"):
        return "It must begin with https://."
    if not parts.hostname or port == 0 or not url.isascii() or any(c.isspace() or ord(c) < 32 for c in url):
        return "It has no usable host."
    if parts.username is not None or parts.password is not None:
        return "It must not carry a name or password."
    host = parts.hostname
    try:
        literal = str(ipaddress.ip_address(host))
    except ValueError:
        # 2130706433, 0x7f.1 and the like are addresses to a resolver.
        digits = host.rstrip(".").rpartition(".")[2]
        literal = "" if not (digits.isdecimal() or digits.startswith("0x")) else "127.0.0.1"
    if not private and (
        (literal and not is_public(literal)) or host == "localhost" or "." not in host.strip("[]")
    ):
        return None if literal and is_public(literal) else "It is in a private network."
    return None


def signature(secret: str, message_id: str, timestamp: int, body: str) -> str:
    """The ``webhook-signature`` of a message."""
    key = base64.b64decode(secret.removeprefix("whsec_"))
    mark = hmac.new(key, f"{message_id}.{timestamp}.{body}".encode(), hashlib.sha256).digest()
    return f"v1,{base64.b64encode(mark).decode()}"


class GuardedBackend(httpcore.NetworkBackend):
    """Connects to public addresses only (to any with ``private``)."""

    def __init__(self, *, private: bool, resolver: Resolver = resolve) -> None:
        self._private, self._resolver = private, resolver
        self._inner = httpcore.SyncBackend()

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[httpcore.SOCKET_OPTION] | None = None,
    ) -> httpcore.NetworkStream:
        """Look up, check all, connect to one. Raises ForbiddenAddressError."""
        try:
            addresses = self._resolver(host, port)
        except OSError as error:
            raise httpcore.ConnectError(f"no address for {host}") from error
        if not addresses or not (self._private or all(map(is_public, addresses))):
            raise ForbiddenAddressError(host)
        return self._inner.connect_tcp(addresses[0], port, timeout, local_address, socket_options)


class Sender:
    """Sends what is due, one message after another."""

    def __init__(
        self,
        outbox: Outbox,
        *,
        private: bool = False,
        resolver: Resolver = resolve,
        ssl_context: ssl.SSLContext | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._outbox, self._clock = outbox, clock
        self._private, self._resolver, self._ssl = private, resolver, ssl_context

    def run(self, stopping: threading.Event, every: float = 1.0) -> None:
        """Send until ``stopping`` is set."""
        while not stopping.is_set():
            try:
                while not stopping.is_set() and self.send_next():
                    pass
            except Exception:
                log.exception("webhooks: the outbox could not be read")
            stopping.wait(every)

    def send_next(self) -> bool:
        """Send the message most overdue. False when none is due."""
        delivery = self._outbox.take()
        if delivery is None:
            return False
        try:
            status = self._post(delivery)
        except ForbiddenAddressError:
            self._outbox.failed(delivery, "the address is in a private network")
        except Exception as error:
            self._outbox.failed(delivery, f"not reached ({type(error).__name__})")
        else:
            if 200 <= status < 300:
                self._outbox.delivered(delivery, str(status))
            else:
                self._outbox.failed(delivery, str(status), gone=status == 410)
        return True

    def _post(self, delivery: Delivery) -> int:
        now = int(self._clock())
        headers: dict[str | bytes, str | bytes] = {
            "content-type": "application/json",
            "user-agent": "mass-webhooks",
            "webhook-id": delivery.message_id,
            "webhook-timestamp": str(now),
            "webhook-signature": signature(delivery.secret, delivery.message_id, now, delivery.body),
        }
        limits = {"timeout": dict.fromkeys(("connect", "read", "write", "pool"), _SECONDS)}
        backend = GuardedBackend(private=self._private, resolver=self._resolver)
        end = time.monotonic() + 2 * _SECONDS
        with (
            httpcore.ConnectionPool(ssl_context=self._ssl, network_backend=backend) as pool,
            pool.stream(
                "POST", delivery.url, headers=headers, content=delivery.body.encode(), extensions=limits
            ) as answer,
        ):
            received = 0
            for chunk in answer.iter_stream():
                received += len(chunk)
                if received > _MAX_ANSWER or time.monotonic() > end:
                    break  # what it says does not matter
            return int(answer.status)
