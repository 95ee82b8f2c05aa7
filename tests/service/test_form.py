"""The streaming form reader gives the same answer however the network cuts the bytes."""

from __future__ import annotations

import asyncio
import tempfile
from itertools import pairwise
from pathlib import Path

from fastapi import Request
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.types import Message

from service.problems import ProblemError
from service.storage import Storage
from service.uploads import ReceivedForm, container, receive_form
from tests.service.test_uploads import BOUNDARY, form

MP4 = b"\x00\x00\x00\x18ftypisom"


def receive(body: bytes, cuts: list[int]) -> tuple[ReceivedForm | str, bytes]:
    """What the reader makes of ``body`` cut at ``cuts``: the form or the problem's code, and the file."""
    edges = [0, *sorted(cut % (len(body) + 1) for cut in cuts), len(body)]
    pieces = iter([body[a:b] for a, b in pairwise(edges)])

    async def read() -> Message:
        piece = next(pieces, None)
        return {"type": "http.request", "body": piece or b"", "more_body": piece is not None}

    header = f"multipart/form-data; boundary={BOUNDARY}".encode()
    request = Request({"type": "http", "method": "POST", "headers": [(b"content-type", header)]}, read)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "source.part"
        try:
            result: ReceivedForm | str = asyncio.run(
                receive_form(request, target, Storage(Path(folder)), 100_000)
            )
        except ProblemError as error:
            result = error.code
        return result, target.read_bytes()


@settings(max_examples=40, deadline=None)
@given(
    tail=st.binary(max_size=400), cuts=st.lists(st.integers(0, 10_000), max_size=12), options=st.booleans()
)
def test_cuts_do_not_matter(tail: bytes, cuts: list[int], options: bool) -> None:
    parts = [("video", MP4 + tail), *([("options", b'{"seed": 5}')] if options else [])]
    result, written = receive(form(*parts), cuts)
    assert isinstance(result, ReceivedForm)
    assert written == MP4 + tail
    assert result.video_bytes == len(MP4 + tail)
    assert result.options.seed == (5 if options else 0)


@settings(max_examples=40, deadline=None)
@given(head=st.binary(min_size=1, max_size=40), cuts=st.lists(st.integers(0, 10_000), max_size=12))
def test_the_verdict_on_the_container_does_not_depend_on_cuts(head: bytes, cuts: list[int]) -> None:
    result, _ = receive(form(("video", head)), cuts)
    if container(head) is None:
        assert result == "video.unsupported_container"
    else:
        assert isinstance(result, ReceivedForm)


@settings(max_examples=60, deadline=None)
@given(body=st.binary(max_size=300), cuts=st.lists(st.integers(0, 300), max_size=5))
def test_no_bytes_whatever_are_more_than_a_problem(body: bytes, cuts: list[int]) -> None:
    result, _ = receive(f"--{BOUNDARY}\r\n".encode() + body, cuts)
    assert isinstance(result, str)
