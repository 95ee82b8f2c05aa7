"""The line in front of the render processes."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from service.waiting import Line, Turn


def join(line: Line[int], owner: str) -> Turn[int]:
    turn = line.join(owner)
    assert turn is not None
    return turn


def test_first_come_first_served_and_owners_take_turns() -> None:
    line: Line[int] = Line(10)
    assert not line.serve(0)
    turns = [join(line, owner) for owner in ("ann", "ann", "ann", "bob", "carol", "bob")]
    for thing in range(6):
        assert line.serve(thing)
    assert [turn.given for turn in turns] == [0, 3, 5, 1, 2, 4]
    assert len(line) == 0
    assert not line.serve(6)


def test_a_full_line_turns_away_whoever_has_most_of_it() -> None:
    line: Line[int] = Line(4)
    ann = [join(line, "ann") for _ in range(4)]
    assert line.join("ann") is None
    bob = [join(line, "bob") for _ in range(2)]
    assert [turn.wait(0.0) for turn in ann[2:]] == [None, None]
    assert line.join("bob") is None  # as many as Ann now
    assert line.join("ann") is None
    carol = join(line, "carol")
    assert len(line) == 4
    while line.serve(1):
        pass
    given = [turn.given for turn in (*ann, *bob, carol)]
    assert given.count(1) == 4
    assert carol.given == 1
    assert ann[0].given == bob[0].given == 1


def test_no_room_is_no_room_and_leaving_makes_some() -> None:
    assert Line[int](0).join("ann") is None
    line: Line[int] = Line(1)
    turn = join(line, "ann")
    assert line.join("bob") is None
    line.leave(turn)
    line.leave(turn)
    again = join(line, "bob")
    line.clear()
    assert again.wait(0.0) is None
    assert len(line) == 0


@given(st.lists(st.sampled_from(["ann", "bob", "carol", None])), st.integers(0, 6))
def test_nobody_is_lost_or_served_twice(steps: list[str | None], room: int) -> None:
    """An owner's name joins, None serves."""
    line: Line[int] = Line(room)
    turns: list[Turn[int]] = []
    served = 0
    for step in steps:
        if step is not None:
            turn = line.join(step)
            turns += [turn] if turn else []
        elif line.serve(served):
            served += 1
        assert len(line) <= room
    things = [turn.given for turn in turns if turn.given is not None]
    assert sorted(things) == [*range(served)]
    for owner in ("ann", "bob", "carol"):
        own = [turn.given for turn in turns if turn.owner == owner and turn.given is not None]
        assert own == sorted(own)
