"""Colour and depth become pictures by their stamps: in any order, after a step back in time, or it is said why not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from pred_ros.camera_pairs import KEPT, CameraPairs

S, MS = 1_000_000_000, 1_000_000  # [ns]
ORDERS = [("color", "depth"), ("depth", "color")]


def image(stamp: int) -> Any:
    """What is read of an Image here: its stamp [ns]."""
    return SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=stamp // S, nanosec=stamp % S)))


class Feed:
    """One camera on a clock that the test moves."""

    def __init__(self) -> None:
        self.now = 0.0  # [s]
        self.pairs = CameraPairs(["cam0"], lambda: self.now)

    def send(self, kind: str, stamp: int) -> None:
        self.pairs.add_image("cam0", kind, image(stamp))

    def run(self, count: int, *kinds: str, depth_off: int = 0) -> None:
        """`count` instants at 10 Hz."""
        for _ in range(count):
            self.now += 0.1
            for kind in kinds:
                self.send(kind, round(self.now * S) + (depth_off if kind == "depth" else 0))

    def said(self) -> str:
        """What the silent camera's line is, or ''."""
        return self.pairs.why("cam0") if self.pairs.silent(1.0) else ""


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("unit", [1, S], ids=["near", "far"])
def test_a_clock_that_goes_back_pairs_on_though_pictures_wait(order: tuple[str, str], unit: int) -> None:
    feed = Feed()
    for k in range(KEPT):
        feed.send("color", (100 + k) * unit)
    for k in range(1, 4):
        for kind in order:
            feed.send(kind, k * unit)
        (color, depth) = feed.pairs.take(0.0)["cam0"]
        assert color.header.stamp == depth.header.stamp == image(k * unit).header.stamp


@pytest.mark.parametrize("order", ORDERS)
def test_what_waits_from_before_a_step_back_is_given_up(order: tuple[str, str]) -> None:
    feed = Feed()
    for kind in order:
        feed.send(kind, 10 * S)
    feed.pairs.take(0.0)
    feed.send(order[0], 11 * S)  # waits
    for kind in order:
        feed.send(kind, 2 * S)
    assert feed.pairs.take(0.0)["cam0"][0].header.stamp.sec == 2
    feed.send(order[1], 11 * S)
    assert feed.pairs.unpaired == 1 and not feed.pairs.take(0.0), "not a picture of two times"


def test_the_oldest_arrival_is_given_up_and_counted() -> None:
    feed = Feed()
    for k in range(KEPT + 3):
        feed.send("color", k * MS)
    assert feed.pairs.unpaired == 3
    feed.send("depth", 2 * MS)
    assert not feed.pairs.take(0.0)
    feed.send("depth", 3 * MS)
    assert feed.pairs.take(0.0)


@pytest.mark.parametrize(
    ("kinds", "depth_off", "said"),
    [
        (("color",), 0, "colour without depth; is the depth stream on?"),
        (("depth",), 0, "depth without colour; is the colour stream on?"),
        (("color", "depth"), 5 * MS, "stamps of colour and depth differ by 5 ms"),
        (("color", "depth"), -6 * S, "stamps of colour and depth differ by 5900 ms"),  # to 100 ms, a picture's period
        ((), 0, "no pictures"),
    ],
)
def test_pictures_that_find_no_partner_are_silence_and_the_reason_is_said(
    kinds: tuple[str, ...], depth_off: int, said: str
) -> None:
    feed = Feed()
    feed.run(100, "color", "depth")
    assert not feed.said()
    for _ in range(11):
        feed.now += 0.0 if kinds else 0.1
        feed.run(1, *kinds, depth_off=depth_off)
    assert feed.said().startswith(said)
    feed.run(1, "color", "depth")
    assert not feed.said()


def test_colour_twice_as_often_as_depth_is_no_fault() -> None:
    feed = Feed()
    for _ in range(30):
        feed.run(1, "color")
        feed.run(1, "color", "depth")
        assert not feed.said()
