"""How advertisements of one peer are split, and what is taken of them."""

from __future__ import annotations

from typing import Any

from rmpa.bridge import limits
from rmpa.bridge.messages import AdvertiseServices, ServiceOffer
from rmpa.bridge.peer_offers import Heard
from rmpa.config.settings import LimitSettings
from tests.bridge.recorder import ServiceImports
from tests.bridge.services.test_rules import rules


def heard(*entries: str) -> Heard[str, Any, str]:
    made: Heard[str, Any, str] = Heard(name="far")
    made.entries.update(dict.fromkeys(entries, 1))
    return made


def changes(
    made: Heard[str, Any, str], *added: str, removed: tuple[str, ...] = (), full: bool = False, more: bool = False
) -> list[tuple[str, str | None]]:
    return list(made.changes(added, removed, str, full=full, more=more))


def test_removals_go_first() -> None:
    assert changes(heard(), "/a", "/b", removed=("/gone",)) == [("/gone", None), ("/a", "/a"), ("/b", "/b")]


def test_what_a_complete_account_does_not_mention_is_removed_at_its_end() -> None:
    made = heard("/a", "/b", "/c")
    assert changes(made, "/a", full=True, more=True) == [("/a", "/a")]
    assert changes(made, "/b", more=True) == [("/b", "/b")]
    assert changes(made, "/d") == [("/c", None), ("/d", "/d")]
    assert changes(made) == []


def test_a_complete_account_and_a_long_absence_forget_what_was_refused() -> None:
    made = heard()
    for end in (lambda: changes(made, full=True), made.give_up):
        made.refused["/b"] = "/b"
        end()
        assert not made.refused


def test_a_bounded_number_of_refused_offers_is_remembered(monkeypatch: Any) -> None:
    monkeypatch.setattr(limits, "REFUSED_MAX", 1)
    made = ServiceImports(rules(), LimitSettings(services=1))
    made.link_up(1, "far")
    made.advertised(1, AdvertiseServices(tuple(ServiceOffer(name, "/n") for name in ("/a", "/b", "/c", "/b"))))
    assert made.refused(1) == 1
