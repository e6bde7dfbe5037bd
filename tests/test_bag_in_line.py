"""One topic's time line: what is used at once, what waits for the next message, what was out of line."""

from __future__ import annotations

from pred_core.bag.in_line import InLine

S = 1_000_000_000  # [ns]


def given(stamps: list[float], back: float = 0.1, ahead: float = 0.5) -> tuple[list[float], list[str]]:
    """What came out [s], and what the refusals say they got."""
    line: InLine[float] = InLine("gripper/pose", back, ahead)
    used, refused = [], []
    for stamp in stamps:
        items, wrong = line.take(round(stamp * S), stamp)
        used += items
        refused += [] if wrong is None else [str(wrong).split("got ")[1].split(" from")[0]]
    return used, refused


def test_what_goes_on_is_used_at_once() -> None:
    assert given([1.0, 1.1, 1.05, 1.5]) == ([1.0, 1.1, 1.05, 1.5], [])


def test_one_stamp_out_of_line_is_refused_and_nothing_else() -> None:
    for wrong, said in ((-19.0, "-20.000 s"), (0.8, "-0.200 s"), (1.6, "+0.600 s"), (3600.0, "+3599.000 s")):
        assert given([1.0, wrong, 1.1, 1.2]) == ([1.0, 1.1, 1.2], [said])
    assert given([1.0, 9.0, -9.0, 1.1]) == ([1.0, 1.1], ["+8.000 s", "-10.000 s"])


def test_a_new_line_is_followed_and_nothing_is_lost() -> None:
    for line in ([7.0, 7.1, 7.2], [0.0, 0.1, 0.2], [0.0, 0.0]):  # a hole, a loop, a clock that stands still
        assert given([1.0, 1.1, *line]) == ([1.0, 1.1, *line], [])


def test_a_line_slower_than_what_is_believed_at_once_comes_in_pairs() -> None:
    used, refused = given([0.0, 1.0, 2.0, 3.0, 4.0])
    assert used == [0.0, 1.0, 2.0, 3.0, 4.0] and not refused
