"""One request has one spelling; the cache stays within its bytes."""

from __future__ import annotations

import math
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.pictures import PictureCache, View, canonical_view
from service.problems import ProblemError


def view(pose: str = "rest", camera: str = "source", width: int = 64) -> View:
    return canonical_view(pose, camera, width, 64, "png", 10**6)


@given(st.lists(st.floats(-6.28, 6.28), min_size=48, max_size=48))
def test_canonical_poses_keep_their_values_and_are_fixed_points(values: list[float]) -> None:
    spelled = view(",".join(map(repr, values))).pose
    assert view(spelled).pose == spelled
    assert [float(part) for part in spelled.split(",")] == pytest.approx(values, abs=1e-6)
    assert "-0," not in spelled + ","


@given(st.floats(-1e4, 1e4), st.floats(-90, 90), st.floats(0.02, 10), st.integers(-3, 3))
def test_a_full_turn_is_no_turn(yaw: float, pitch: float, distance: float, turns: int) -> None:
    spelled = view(camera=f"orbit:{yaw!r},{pitch!r},{distance!r}").camera
    assert view(camera=spelled).camera == spelled
    other = view(camera=f"orbit:{yaw + 360 * turns!r},{pitch!r},{distance!r}").camera
    difference = float(other[6:].split(",")[0]) - float(spelled[6:].split(",")[0])
    assert math.isclose(math.cos(math.radians(difference)), 1.0, abs_tol=1e-9)


@given(st.text(max_size=60))
def test_no_text_is_more_than_a_problem(text: str) -> None:
    for arguments in ((text, "source"), ("rest", text)):
        made = None
        with suppress(ProblemError):  # any other error fails the test
            made = view(*arguments)
        if made is not None:
            assert "/" not in made.pose + made.camera
            assert "." not in made.pose or made.pose.count(",") == 47


def test_etags_differ_where_the_request_does() -> None:
    views = [view(), view("fist"), view(camera="orbit:0,0,1"), view(width=65)]
    views.append(canonical_view("rest", "source", 64, 64, "png", 10**6, "depth"))
    tags = {v.etag("job", "1-a") for v in views} | {view().etag("job", "2-b"), view().etag("other", "1-a")}
    assert len(tags) == 7


def test_the_cache_drops_the_least_recently_used_and_forgets_jobs() -> None:
    cache = PictureCache(100)
    views = [view(f"frame:{index}") for index in range(4)]
    for index in range(3):
        cache.put("a", "1", views[index], bytes(40))
        assert cache.get("a", "1", views[0]) is not None
    assert cache.get("a", "1", views[1]) is None
    assert cache.get("a", "1", views[2]) == bytes(40)
    cache.put("a", "1", views[0], bytes(10))
    cache.put("b", "1", views[3], bytes(50))
    assert [cache.get("a", "1", views[i]) is not None for i in (0, 2)] == [True, True]
    cache.put("b", "1", views[1], bytes(101))  # larger than the cache: not kept
    assert cache.get("b", "1", views[1]) is None
    cache.put("a", "1", views[2], bytes(40))
    cache.put("b", "1", views[3], bytes(50))
    cache.drop("a")
    assert cache.get("a", "1", views[2]) is None
    assert cache.get("b", "1", views[3]) == bytes(50)
