"""Fixtures with a real broker."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.worker.harness import Bench


@pytest.fixture
def bench() -> Iterator[Bench]:
    """A broker and a store of this test's own."""
    bench = Bench()
    yield bench
    bench.close()
