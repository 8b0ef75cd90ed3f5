"""What the soak calls growth, and what it calls given back."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import replace

import pytest

from tests.soak.held import MB, Held, floors, growth, left, slope, too_much

IDLE = Held(0.0, 40 * MB, 24, 18, 3, Counter({"Agent.close": 1, "Inbound._work": 2}), 0, 0)


def row(sizes: list[float]) -> list[Held]:
    """Looks every 10 s; sizes in MB."""
    return [replace(IDLE, at=10.0 * number, rss=round(size * MB)) for number, size in enumerate(sizes)]


def test_a_straight_line_is_found() -> None:
    assert slope([(0, 1), (1, 3), (2, 5)]) == pytest.approx(2)
    assert slope([(0, 5)]) == slope([]) == slope([(1, 1), (1, 3)]) == 0


def test_the_floor_is_what_no_queue_held_for_a_moment() -> None:
    assert floors(row([50, 40, 60, 41, 90, 42, 43, 44, 45, 46, 47])) == [(0.0, 40 * MB), (50.0, 42 * MB)]


def test_a_flat_memory_with_peaks_is_flat() -> None:
    rng = random.Random(3)
    samples = row([40 + 30 * rng.random() ** 4 for _ in range(80)])
    assert too_much(samples) == ""


def test_what_the_first_half_takes_is_no_leak() -> None:
    samples = row([min(40 + number, 70) for number in range(80)])
    assert growth(samples) == 0
    assert too_much(samples) == ""


def test_a_leak_is_found_beneath_peaks() -> None:
    rng = random.Random(4)
    samples = row([40 + number / 10 + 20 * rng.random() ** 4 for number in range(80)])
    assert "memory rose by" in too_much(samples)


def test_few_samples_have_no_statistics() -> None:
    samples = row([40 + number for number in range(20)])
    assert growth(samples) is None
    assert too_much(samples) == ""


def test_report_names_what_was_given_back() -> None:
    assert left(IDLE, IDLE) == []
    assert left(IDLE, replace(IDLE, fds=20, sockets=14, rss=90 * MB, tasks=Counter({"Agent.close": 1}))) == []
    kept = replace(IDLE, sockets=19, fds=25, routes=1, proxies=2, tasks=IDLE.tasks + Counter({"Mesh._dial": 1}))
    assert left(IDLE, kept) == [
        "open files: 24 before, 25 afterwards",
        "sockets: 18 before, 19 afterwards",
        "routes: 0 before, 1 afterwards",
        "proxies: 0 before, 2 afterwards",
        "tasks: 1 more of Mesh._dial",
    ]
