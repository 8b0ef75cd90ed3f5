"""``rmpa reload`` beside a fake agent."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING

from rmpa.observe.control import ReloadReply

if TYPE_CHECKING:
    from tests.cli.conftest import Place

Agent = Callable[..., None]
REPLY = ReloadReply(
    file="/etc/rmpa.toml",
    changed=("bridge.deny", "[[peer]]"),
    restart=("mesh.port (1 instead of 0)",),
    notes=("contract: a rule that sets nothing",),
)


def test_what_holds_now_is_named_and_what_waits(place: Place, agent: Agent) -> None:
    asked: list[object] = []

    def answer(args: dict[str, object]) -> ReloadReply:
        asked.append(args["check"])
        return REPLY

    agent(reload=answer)
    code, out, err = place.run("reload")
    assert (code, out) == (0, "/etc/rmpa.toml: bridge.deny, [[peer]] in effect\n")
    assert err.splitlines() == [
        "! contract: a rule that sets nothing",
        "! mesh.port (1 instead of 0) waits for a restart",
    ]
    code, out, err = place.run("reload", "--check")
    assert (code, out) == (0, "/etc/rmpa.toml: bridge.deny, [[peer]] would take effect\n")
    assert "! mesh.port (1 instead of 0) needs a restart" in err
    assert asked == [False, True]
    code, out, _ = place.run("reload", "--json")
    assert (code, json.loads(out)["restart"]) == (0, ["mesh.port (1 instead of 0)"])


def test_nothing_to_do(place: Place, agent: Agent) -> None:
    agent(reload=lambda _: ReloadReply())
    assert place.run("reload") == (0, "no file: nothing has changed\n", "")
    assert place.run("reload", "--check") == (0, "no file: nothing would change\n", "")


def test_settings_that_cannot_be_used_exit_with_2(place: Place, agent: Agent) -> None:
    agent(reload=lambda _: ReloadReply(problem="/etc/rmpa.toml:7: bridge.deny: no\x1b[2J"))
    code, out, err = place.run("reload")
    assert (code, out) == (2, "")
    assert err.startswith("rmpa: /etc/rmpa.toml:7: bridge.deny: no")
    assert "\x1b" not in err
    assert place.run("reload", "--json")[0] == 2
