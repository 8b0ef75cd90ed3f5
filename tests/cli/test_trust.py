"""``rmpa trust check``, and keys that are the service's."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from rmpa.cli import trust
from rmpa.core.errors import StartError
from rmpa.trust.store import TrustStore
from tests.cli.conftest import compare

if TYPE_CHECKING:
    from tests.cli.conftest import Place

FILE = """
[trust.groups]
operators = ["joystick", "laptop*"]
[[permission]]
groups = ["operators"]
publish = ["/cmd_vel"]
action = ["/arm/move"]
[[permission]]
modules = ["laptop2"]
effect = "deny"
publish = ["/arm/move/cancel"]
"""


def test_what_a_peer_may_do_here_and_by_which_rule(place: Place) -> None:
    said = place.transcript("check arm publish /cmd_vel", group="trust")  # no rmpa.toml is there
    (place.path / "rmpa.toml").write_text(FILE)
    said += place.transcript(
        "check joystick publish /cmd_vel", "check base publish /cmd_vel", "check laptop1 action /arm/move",
        "check laptop2 action /arm/move", "check laptop2 publish /cmd_vel --json",
        "check 'my arm' publish /a", "check arm publish a",
        group="trust",
    )  # fmt: skip
    compare("trust_check", said)
    code, _, err = place.run("trust", "check", "arm", "write", "/a")
    assert (code, "'write' is not one of" in err) == (2, True)


@pytest.mark.parametrize(("uid", "words"), [(1000, "sudo rmpa trust join …"), (0, "choose another state directory")])
def test_keys_of_the_service_take_sudo(place: Place, monkeypatch: pytest.MonkeyPatch, uid: int, words: str) -> None:
    def refuse(*_: object) -> bool:
        raise StartError("/x/trust", "cannot be searched", "choose another state directory", code="keys-unusable")

    place.environ["RMPA_STATE_DIR"] = str(place.path)
    monkeypatch.setattr(trust, "STATE", str(place.path))
    monkeypatch.setattr(TrustStore, "exists", property(refuse))
    monkeypatch.setattr(os, "geteuid", lambda: uid)
    code, _, error = place.run("trust", "join", "rmpa1-secret", "--name", "arm")
    assert (code, words in error, "secret" in error) == (1, True, False)
