"""How often one owner and one address may ask: token buckets in memory, of this API process."""

from __future__ import annotations

import ipaddress
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable

#: Buckets kept. Whoever makes the service forget the oldest had to ask from as many addresses.
_MOST = 20_000


class RateLimiter:
    """``rate`` requests a second in the long run, ``burst`` at once; a rate of 0 limits nothing. Thread-safe.

    A bucket that is full again says no more than none: the least recently used are forgotten.
    """

    def __init__(self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._burst, self._clock = rate, max(burst, 1.0), clock
        #: Tokens left, and when that was so.
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def take(self, who: str) -> int:
        """Count one request of ``who``: 0 it may pass, else the whole seconds until another one may."""
        if self._rate <= 0:
            return 0
        with self._lock:
            now = self._clock()
            tokens, since = self._buckets.pop(who, (self._burst, now))
            tokens = min(tokens + (now - since) * self._rate, self._burst)
            wait = 0.0 if tokens >= 1.0 else (1.0 - tokens) / self._rate
            self._buckets[who] = (tokens if wait else tokens - 1.0, now)
            if len(self._buckets) > _MOST:
                self._buckets.popitem(last=False)
        return math.ceil(wait)

    def __len__(self) -> int:
        return len(self._buckets)


def network(host: str | None) -> str | None:
    """What counts as one address: an IPv4 address, or the /64 that one IPv6 subscriber has. None for
    this machine itself and for what has no address."""
    try:
        address = ipaddress.ip_address((host or "").partition("%")[0])
    except ValueError:
        return None
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is None:
            return None if address.is_loopback else str(ipaddress.ip_network((address, 64), strict=False))
        address = address.ipv4_mapped
    return None if address.is_loopback else str(address)
