"""What lists show of very many things."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from rmpa.cli.options import Selection, summary
from rmpa.observe.peer_info import PeerInfo
from tests.observe.samples import SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import Callable

    import pytest

    from tests.cli.conftest import Place


def peers(count: int) -> tuple[PeerInfo, ...]:
    """So many relayed peers, one of them refused."""
    made = [
        PeerInfo(
            name=f"arm{n}",
            guid=f"10.0.{n // 250}.{n % 250 + 1}:40000#1",
            instance="22" * 16,
            state="relayed",
            since_ago=9.0,
        )
        for n in range(count)
    ]
    made[777] = msgspec.structs.replace(made[777], state="refused", last_error="another domain")
    return tuple(made)


def test_a_list_of_a_thousand_begins_with_a_summary_and_the_problems(
    place: Place, agent: Callable[..., None]
) -> None:
    agent(snapshot=msgspec.structs.replace(SNAPSHOT, peers=peers(1000), notes=()))
    code, out, err = place.run("peer", "list", "--limit", "5")
    assert code == 0
    lines = out.splitlines()
    assert lines[0] == "1,000 peers: 999 relayed, 1 refused"
    assert lines[3].split()[:2] == ["arm777", "refused"]
    assert len(lines) == 1 + 1 + 1 + 5 + 1
    assert lines[-1] == "... 995 more peers; fewer: rmpa peer list 'arm*', --state linked; all: --all"
    assert err == "! arm777: another domain\n"


def test_peers_are_filtered_by_name_and_state(place: Place, agent: Callable[..., None]) -> None:
    agent(snapshot=msgspec.structs.replace(SNAPSHOT, peers=peers(1000), notes=()))
    assert [line.split()[0] for line in place.run("peer", "list", "arm99?")[1].splitlines()[1:]] == [
        f"arm{n}" for n in range(990, 1000)
    ]
    assert place.run("peer", "list", "--state", "refused")[1].splitlines()[1].split()[0] == "arm777"


def test_in_a_pipe_a_list_is_complete(place: Place, agent: Callable[..., None]) -> None:
    agent(snapshot=msgspec.structs.replace(SNAPSHOT, peers=peers(1000), notes=()))
    assert len(place.run("peer", "list")[1].splitlines()) == 1001


def test_names_and_modules_are_selected_by_patterns() -> None:
    of = {"/a/scan": ["arm1"], "/b/scan": ["arm2"], "/cmd": []}
    chosen = Selection(match="*/scan", peer="*2")
    assert [name for name, peers in of.items() if chosen.wants(name, peers)] == ["/b/scan"]
    assert all(Selection().wants(name, peers) for name, peers in of.items())
    assert not Selection(peer="arm*").wants("/cmd", (None,))


def test_a_terminal_shows_the_first_of_many_unless_all_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not Selection().is_long(range(20_000))
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    assert Selection().is_long(range(20_000))
    assert not Selection().is_long(range(100))
    assert not Selection(everything=True).is_long(range(20_000))


def test_the_summary_names_the_most_frequent_first() -> None:
    assert summary(3, "peers", ["relayed", "linked", "relayed"]) == "3 peers: 2 relayed, 1 linked"
