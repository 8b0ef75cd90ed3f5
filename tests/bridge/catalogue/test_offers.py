"""What peers are told of a catalogue: portions, names, limits."""

from __future__ import annotations

from rmpa.bridge import limits
from rmpa.bridge.offers import CataloguePeer, OfferCatalogue

Peer = CataloguePeer[str, int, str, str]


def catalogue(limit: int = 1000) -> OfferCatalogue[str, int, str, str]:
    """Entries by letter; a peer named ``shouts`` knows them in capitals, and none of them with a negative number."""

    def offer(known: Peer, key: str, local: int) -> str | None:
        return None if local < 0 else key.upper() if known.name == "shouts" else key

    return OfferCatalogue("topics", limit, offer=offer, wire=lambda name: name, renewed=lambda old, new: old != new)


def changed(made: OfferCatalogue[str, int, str, str], **entries: int) -> None:
    for key, local in entries.items():
        made.put(key, local)
        made.note(key)


def is_beginning(made: OfferCatalogue[str, int, str, str]) -> bool:
    known = made.peer(1)
    return known is not None and known.beginning


def told(made: OfferCatalogue[str, int, str, str]) -> dict[int, tuple[list[str], list[str]]]:
    return {peer: (portion.added, portion.removed) for peer, portion in made.portions(lambda _: True)}


def test_a_new_peer_is_told_everything_in_portions() -> None:
    made = catalogue()
    changed(made, **{f"e{number:03}": 1 for number in range(limits.ADVERTISED_AT_ONCE + 2)})
    first = made.link_up(1, "far", "", judged=False)
    assert (len(first.added), first.more, first.complete) == (limits.ADVERTISED_AT_ONCE, True, False)
    assert (made.pending, is_beginning(made)) == (True, True)
    [(peer, rest)] = made.portions(lambda _: True)
    assert (peer, len(rest.added), rest.more, rest.complete, rest.is_news) == (1, 2, False, True, True)
    assert (made.pending, is_beginning(made)) == (False, False)


def test_a_peer_that_is_not_ready_is_told_later() -> None:
    made = catalogue()
    made.link_up(1, "far", "", judged=False)
    changed(made, a=1)
    assert not list(made.portions(lambda _: False))
    assert told(made) == {1: (["a"], [])}
    assert told(made) == {}


def test_an_entry_that_leaves_is_removed_by_the_name_it_had() -> None:
    made = catalogue()
    changed(made, a=1)
    assert made.link_up(1, "shouts", "", judged=True).added == ["A"]
    assert made.remove("a")
    made.note("a")
    [(_, portion)] = made.portions(lambda _: True)
    assert (portion.removed, portion.ended, portion.added) == (["A"], ["a"], [])
    assert not made.remove("a")


def test_a_renewed_entry_is_told_once_more() -> None:
    made = catalogue()
    changed(made, a=1)
    made.link_up(1, "far", "", judged=False)
    changed(made, a=1)
    [(_, same)] = made.portions(lambda _: True)
    assert not same.is_news
    changed(made, a=2)
    assert told(made) == {1: (["a"], [])}


def test_of_two_entries_of_one_name_the_second_waits_for_the_first() -> None:
    made = catalogue()
    changed(made, a=1, A=2)
    first = made.link_up(1, "shouts", "", judged=True)
    assert (first.added, first.taken) == (["A"], [("A", "A", "a")])
    made.remove("a")
    made.note("a")
    # What waits is told behind it.
    assert told(made) == {1: ([], ["A"])}
    assert told(made) == {1: (["A"], [])}
    assert made.told(1, "A") == "A"


def test_beyond_the_limit_the_first_one_takes_the_next_free_place() -> None:
    made = catalogue(limit=1)
    assert made.put("a", 1)
    assert not made.put("b", 1)
    assert not made.put("c", 1)
    assert (made.is_beyond("b"), made.beyond, made.next_beyond()) == (True, 2, None)
    assert "limits.topics = 1" in made.warning("sources.too_many").text
    assert not made.remove("c"), "it was not offered"
    assert made.remove("a")
    assert made.next_beyond() == ("b", 1)
    assert made.put("b", 1)
    assert dict(made.offered) == {"b": 1}


def test_of_peers_that_need_judging_one_is_told_at_a_time() -> None:
    made = catalogue()
    for peer in (1, 2, 3):
        made.link_up(peer, "shouts" if peer < 3 else "far", "", judged=peer < 3)
    changed(made, a=1)
    assert list(told(made)) == [1, 3]
    assert list(told(made)) == [2]
    assert told(made) == {}


def test_a_peer_without_a_link_is_told_nothing() -> None:
    made = catalogue()
    made.link_up(1, "far", "", judged=False)
    made.link_down(1)
    changed(made, a=1)
    assert told(made) == {}
    assert (made.told(1, "a"), is_beginning(made), made.peer(1)) == (None, False, None)
