"""``rmpa trust check``, and keys that are the service's."""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest

from rmpa.bridge.policy import PermissionGate
from rmpa.cli import module
from rmpa.config.peer_rules import Access
from rmpa.config.read import load_settings
from rmpa.config.settings import Settings
from rmpa.core.errors import PeerRefused, StartError
from rmpa.gateway.rules import CrossingRules, ForeignSource, SourceKind
from rmpa.trust.permissions import Permissions
from rmpa.trust.store import TrustStore
from rmpa.web.server.process import CertificateFiles, TokenAccess, WebSetup
from tests.cli.conftest import Place, compare

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
    monkeypatch.setattr(module, "STATE", str(place.path))
    monkeypatch.setattr(TrustStore, "exists", property(refuse))
    monkeypatch.setattr(os, "geteuid", lambda: uid)
    code, _, error = place.run("trust", "join", "rmpa1-secret", "--name", "arm")
    assert (code, words in error, "secret" in error) == (1, True, False)


ASKED = """
[trust]
default = "{default}"
[[permission]]
modules = ["web", "hall", "arm"]
publish = ["/open/**"]
subscribe = ["/open/**"]
call = ["/open/**"]
serve = ["/open/**"]
param = ["/open/**"]
kill = ["/open/**"]
[[permission]]
modules = ["*"]
effect = "deny"
publish = ["/secret"]
subscribe = ["/secret"]
call = ["/secret"]
serve = ["/secret"]
param = ["/secret"]
kill = ["/secret"]
"""


def _web(settings: Settings, access: Access, _asker: str, name: str) -> bool:
    setup = WebSetup(settings, TokenAccess("secret-" * 6), CertificateFiles(), trusted=True)
    try:
        setup.rules.check(access, name)
    except PeerRefused as error:
        assert error.code == "not-permitted"  # noqa: PT017 - a yes has no error
        return False
    return True


def _peer(settings: Settings, access: Access, asker: str, name: str) -> bool:
    return PermissionGate(Permissions(settings.trust)).admits(access, asker, name)


def _site(settings: Settings, access: Access, asker: str, name: str) -> bool:
    rules = CrossingRules(settings.gateway.rules, gate=PermissionGate(Permissions(settings.trust)))
    if access in (Access.PUBLISH, Access.SERVE):
        kind = SourceKind.TOPIC if access is Access.PUBLISH else SourceKind.SERVICE
        return rules.incoming(ForeignSource(kind, asker, "m", "/n", name, "std_msgs/String")).allowed
    return not rules.denial(asker, name, access)


@pytest.mark.parametrize("default", ["allow", "deny"])
@pytest.mark.parametrize(
    ("asker", "enforced"), [("web", _web), ("arm", _peer), ("other", _peer), ("hall", _site), ("ros2", _site)]
)
def test_the_check_says_what_is_enforced(
    place: Place, default: str, asker: str, enforced: Callable[[Settings, Access, str, str], bool]
) -> None:
    (place.path / "rmpa.toml").write_text(ASKED.format(default=default))
    options = {"config": str(place.path / "rmpa.toml")}
    settings = load_settings(options, {}, host_name="h").settings
    found = set()
    for access in Access:
        for name in ("/open/a", "/secret", "/other"):
            code, said, error = place.run("trust", "check", asker, str(access), name)
            assert (code == 0) == enforced(settings, access, asker, name), (access, name, said, error)
            found.add(code == 0)
    assert found == {True, False} or (asker in ("other", "ros2") and default == "deny")
