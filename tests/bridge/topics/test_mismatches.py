"""What a mismatch of definitions says here, and what the agent at the other end hears of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.messages import Mismatch, Source
from rmpa.bridge.topics.subscribers import Mismatches
from tests.bridge.recorder import Send

CMD = Source("/cmd", "/joy")
BASE = 1


class Reports(Mismatches):
    """Reports of a module that offers ``/cmd`` to the peer *base*, or has it of that peer."""

    def __init__(self) -> None:
        self.done: list[Any] = []
        self.warnings: list[str] = []
        self.offered = {CMD}
        exports = SimpleNamespace(
            offered=self.offered, local=lambda _peer, source: source if source in self.offered else None
        )
        imports = SimpleNamespace(at=lambda topic: [(BASE, CMD)] if topic == CMD.topic else [], knows=lambda _: False)
        out = SimpleNamespace(
            send=lambda peer, message: self.done.append(Send(peer, message)),
            warn=lambda *args: self.warnings.append(args[2]),
        )
        super().__init__(cast("Any", out), cast("Any", exports), cast("Any", imports))

    def hear(self, text: str, subscriber: str = "/viewer") -> None:
        self.reported(BASE, "base", Mismatch(CMD.topic, CMD.node, subscriber, text))


@pytest.fixture
def reports() -> Reports:
    return Reports()


def test_a_refused_subscriber_is_shown_here_and_told_to_the_peer(reports: Reports) -> None:
    reports.refused(BASE, CMD, "/viewer", "other md5")
    assert reports.texts(CMD) == ("other md5",)
    assert reports.done == [Send(BASE, Mismatch("/cmd", "/joy", "/viewer", "other md5"))]
    assert reports.warnings == ["other md5"]


def test_a_subscriber_that_registers_again_is_mended_at_the_peer_too_and_once(reports: Reports) -> None:
    reports.refused(BASE, CMD, "/viewer", "other md5")
    reports.done.clear()
    for _ in range(2):
        reports.registration_changed("/cmd", "/viewer")
    assert reports.texts(CMD) == ()
    assert reports.done == [Send(BASE, Mismatch("/cmd", "/joy", "/viewer", ""))]


def test_another_subscriber_of_the_topic_mends_nothing(reports: Reports) -> None:
    reports.refused(BASE, CMD, "/viewer", "other md5")
    reports.done.clear()
    reports.registration_changed("/cmd", "/recorder")
    assert (reports.texts(CMD), reports.done) == (("other md5",), [])


def test_a_peers_report_is_a_warning_that_names_the_peer(reports: Reports) -> None:
    reports.hear("other md5")
    assert reports.texts(CMD) == ("other md5",)
    assert reports.warnings == [f"base: {CMD}: other md5"]


def test_a_peers_report_ends_with_an_empty_text_or_with_the_peer(reports: Reports) -> None:
    reports.hear("other md5")
    reports.hear("")
    assert reports.texts(CMD) == ()
    reports.hear("other md5")
    reports.peer_gone("base")
    assert reports.texts(CMD) == ()
    assert len(reports.warnings) == 2, "an end is no warning"


def test_only_nodes_of_a_peer_that_is_gone_are_forgotten(reports: Reports) -> None:
    reports.hear("of base")
    reports.reported(2, "base2", Mismatch(CMD.topic, CMD.node, "/viewer", "of base2"))
    reports.refused(BASE, CMD, "/viewer", "ours")
    reports.peer_gone("base")
    assert reports.texts(CMD) == ("of base2", "ours")


def test_a_source_has_only_so_many_and_each_of_them_can_still_change(reports: Reports) -> None:
    for number in range(limits.MISMATCHES_MAX + 5):
        reports.hear("other md5", f"/n{number}")
    assert len(reports.texts(CMD)) == limits.MISMATCHES_MAX
    reports.hear("changed", "/n0")
    assert reports.texts(CMD)[0] == "changed"


def test_a_source_that_is_gone_has_no_mismatches(reports: Reports) -> None:
    reports.hear("other md5")
    reports.forget_gone()
    assert reports.texts(CMD) == ("other md5",)
    reports.offered.clear()
    reports.forget_gone()
    assert reports.texts(CMD) == ()
    reports.hear("late")
    assert reports.texts(CMD) == (), "the report crossed the withdrawal"
