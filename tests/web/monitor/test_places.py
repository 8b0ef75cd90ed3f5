"""Places on the ring: who is there does not move."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rmpa.web.monitor import limits
from rmpa.web.monitor.places import Places

NAMES = [f"m{number}" for number in range(40)]


def test_the_own_module_is_at_the_top() -> None:
    places = Places("pc")
    places.update(NAMES[:7], 0.0)
    assert places.places["pc"] == 0


def test_a_module_that_fits_moves_no_other() -> None:
    places = Places("pc")
    places.update(NAMES[:4], 0.0)  # five of six slots
    before = dict(places.places)
    places.update(NAMES[:5], 1.0)
    assert {name: places.places[name] for name in before} == before


def test_a_module_that_comes_back_has_its_place() -> None:
    places = Places("pc")
    places.update(["arm", "base"], 0.0)
    before = dict(places.places)
    places.update(["base"], 10.0)
    assert places.absent(["base"]) == ["arm"]
    places.update(["base", "hand"], 20.0)
    places.update(["arm", "base", "hand"], 30.0)
    assert {name: places.places[name] for name in before} == before


def test_a_module_that_left_long_ago_is_forgotten() -> None:
    places = Places("pc")
    places.update(["arm"], 0.0)
    places.update([], limits.FORGET_AFTER + 1)
    assert list(places.places) == ["pc"]


def test_there_are_never_more_places_than_can_be_shown() -> None:
    places = Places("pc")
    for start in range(3):
        places.update((f"{start} {number}" for number in range(limits.MODULES_SHOWN)), float(start))
    assert len(places.places) == limits.MODULES_SHOWN
    assert places.places["pc"] == 0


@given(st.lists(st.sets(st.sampled_from(NAMES)), max_size=8))
def test_the_order_around_the_ring_stays_and_no_two_share_a_place(steps: list[set[str]]) -> None:
    places = Places("pc")
    for now, present in enumerate(steps):
        before = sorted(places.places, key=places.places.__getitem__)
        places.update(sorted(present), float(now))
        taken = places.places
        assert len(set(taken.values())) == len(taken)
        assert max(taken.values()) < places.slots
        assert present <= taken.keys()
        after = [name for name in sorted(taken, key=taken.__getitem__) if name in before]
        assert after == before


def test_free_slots_are_spread_around_the_ring() -> None:
    places = Places("pc")
    places.update(NAMES[:12], 0.0)
    free = set(range(places.slots)) - set(places.places.values())
    assert (places.slots, len(free)) == (16, 3)
    assert not [slot for slot in free if (slot + 1) % places.slots in free]
