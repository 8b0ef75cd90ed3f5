from __future__ import annotations

from rmpa.bridge import limits
from rmpa.bridge.messages import Source
from rmpa.bridge.topics.subscribers import Mismatches

CMD = Source("/cmd", "/joy")
POSE = Source("/pose", "/base")


def known(*who: str) -> Mismatches:
    made = Mismatches()
    for one in who:
        made.add(CMD, one, f"of {one}")
    return made


def test_those_of_a_peer_that_is_gone_are_forgotten_with_its_nodes() -> None:
    mismatches = known("base", "base/viewer", "base2/viewer", "/viewer")
    mismatches.peer_gone("base")
    assert mismatches.texts(CMD) == ("of base2/viewer", "of /viewer")


def test_what_is_mended_is_said_once() -> None:
    mismatches = known("/viewer", "/recorder")
    assert mismatches.mended(CMD, "/viewer")
    assert not mismatches.mended(CMD, "/viewer")
    assert not mismatches.mended(POSE, "/recorder")
    assert mismatches.texts(CMD) == ("of /recorder",)


def test_said_anew_the_newest_text_counts() -> None:
    mismatches = known("/viewer")
    mismatches.add(CMD, "/viewer", "another definition")
    assert mismatches.texts(CMD) == ("another definition",)


def test_a_source_has_only_so_many_and_each_of_them_can_still_change() -> None:
    mismatches = known(*(f"/n{number}" for number in range(limits.MISMATCHES_MAX + 5)))
    assert len(mismatches.texts(CMD)) == limits.MISMATCHES_MAX
    mismatches.add(CMD, "/n0", "changed")
    assert mismatches.texts(CMD)[0] == "changed"


def test_a_source_that_nobody_has_is_forgotten() -> None:
    mismatches = known("/viewer")
    mismatches.add(POSE, "/viewer", "x")
    mismatches.keep(lambda source: source == POSE)
    assert mismatches.texts(CMD) == ()
    assert mismatches.texts(POSE) == ("x",)
    mismatches.keep(lambda _: False)
    assert not mismatches
