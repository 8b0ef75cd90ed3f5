"""What the gate lets pass, counts and logs; and that `rmpa trust check` says the same."""

from __future__ import annotations

import json
import random
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

from rmpa.bridge import limits
from rmpa.bridge.policy import OPEN_GATE, PermissionGate
from rmpa.cli.trust import trust_check
from rmpa.config.peer_rules import Access, PermissionRule
from rmpa.config.read import load_settings
from rmpa.config.settings import TrustSettings
from rmpa.core.counters import Counters
from rmpa.trust.permissions import Permissions

if TYPE_CHECKING:
    from pathlib import Path


def allow(module: str, **names: str) -> PermissionRule:
    return PermissionRule((module,), names={key: tuple(globs.split()) for key, globs in names.items()})


def test_without_trust_everything_passes_and_nothing_is_counted() -> None:
    for access in Access:
        assert OPEN_GATE.admits(access, "anyone", "/anything", relay="any_relay")
    assert not OPEN_GATE.on
    assert OPEN_GATE.plain
    assert OPEN_GATE.may_relay("any_relay")


def test_each_refusal_is_counted_and_each_rule_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    counters = Counters()
    gate = PermissionGate(Permissions(TrustSettings()), counters)
    for number in range(50):
        assert not gate.admits(Access.PUBLISH, "arm2", f"/t{number}")
    assert not gate.admits(Access.PUBLISH, "arm3", "/t0")
    assert not gate.admits(Access.CALL, "arm2", "/stop")
    assert counters.as_dict() == {"permission.call": 1, "permission.publish": 51}
    assert [record.getMessage() for record in caplog.records] == [
        "! arm2 may not publish /t0: no [[permission]] lets arm2 publish /t0 (logged once, then counted)",
        "! arm3 may not publish /t0: no [[permission]] lets arm3 publish /t0 (logged once, then counted)",
        "! arm2 may not call /stop: no [[permission]] lets arm2 call /stop (logged once, then counted)",
    ]
    gate.reload(TrustSettings())
    assert not gate.admits(Access.CALL, "arm2", "/stop")
    assert len(caplog.records) == 4, "other rules are worth another line"


def test_names_that_are_invented_do_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    counters = Counters()
    gate = PermissionGate(Permissions(TrustSettings()), counters)
    for number in range(limits.REFUSALS_LOGGED + 10):
        assert not gate.admits(Access.PUBLISH, f"m{number}", "/t")
    assert len(caplog.records) == limits.REFUSALS_LOGGED
    assert counters["permission.publish"] == limits.REFUSALS_LOGGED + 10


def test_a_relay_and_the_origin_are_judged_both(caplog: pytest.LogCaptureFixture) -> None:
    counters = Counters()
    rules = (allow("arm", publish="/arm/**"), allow("relay", publish="/**"))
    gate = PermissionGate(Permissions(TrustSettings(rules=rules, relays=("relay",))), counters)
    assert gate.admits(Access.PUBLISH, "arm", "/arm/state", relay="relay")
    assert not gate.admits(Access.PUBLISH, "leg", "/arm/state", relay="relay"), "the relay's own right is no help"
    assert not gate.admits(Access.PUBLISH, "arm", "/arm/state", relay="spy"), "nor the origin's"
    assert counters.as_dict() == {"permission.publish": 1, "permission.relay": 1}
    assert "trust.relays does not have spy" in caplog.text
    assert "leg may not publish /arm/state by way of relay" in caplog.text


def test_the_other_side_is_told_the_outcome_and_no_rule() -> None:
    gate = PermissionGate(Permissions(TrustSettings(rules=(allow("x*", call="/secret/**"),))))
    assert gate.why_not(Access.CALL, "arm", "/secret/go") == "the permissions there do not let arm call /secret/go"
    assert gate.why_not(Access.CALL, "x1", "/secret/go") == ""


MODULES = ("arm", "arm2", "joystick", "laptop7", "base")
NAMES = ("/cmd_vel", "/joy", "/arm/state", "/arm", "/arm2/state", "/motors/left/on", "/laptop7/log")
GLOBS = ("/**", "/cmd_vel", "/arm/**", "/{peer}/**", "/*/state", "/motors/**", "/arm", "/j?y")
WORDS = [*(str(access) for access in Access), "action", "action_serve"]


def _random_file(rng: random.Random) -> str:
    lines = ["[trust]", f'default = "{rng.choice(("deny", "deny", "allow"))}"', "[trust.groups]"]
    lines += ['operators = ["joystick", "laptop*"]', 'arms = ["arm*"]']
    for _ in range(rng.randint(0, 5)):
        lines += ["[[permission]]", f'effect = "{rng.choice(("allow", "allow", "deny"))}"']
        who = rng.choice(('modules = ["*"]', 'modules = ["arm"]', 'groups = ["operators"]', 'groups = ["arms"]'))
        lines.append(who)
        for word in rng.sample(WORDS, rng.randint(1, 4)):
            lines.append(f"{word} = {json.dumps(rng.sample(GLOBS, rng.randint(1, 2)))}")
    return "\n".join(lines)


@pytest.mark.parametrize("seed", range(25))
def test_trust_check_says_what_is_enforced(seed: int, tmp_path: Path) -> None:
    """For single accesses, the gate itself; for an action, all five topics by the plans' questions."""
    rng = random.Random(seed)
    file = tmp_path / "rmpa.toml"
    file.write_text(_random_file(rng))
    settings = load_settings({"config": str(file)}, {}, host_name="robot", cwd=tmp_path).settings
    gate = PermissionGate(Permissions(settings.trust))
    for _ in range(20):
        module, word, name = rng.choice(MODULES), rng.choice(WORDS), rng.choice(NAMES)
        answer = CliRunner().invoke(trust_check, [module, word, name, "--config", str(file), "--json"])
        if word == "action":
            asked = [(Access.PUBLISH, "goal cancel"), (Access.SUBSCRIBE, "status feedback result")]
        elif word == "action_serve":
            asked = [(Access.SUBSCRIBE, "goal cancel"), (Access.PUBLISH, "status feedback result")]
        else:
            asked = [(Access(word), "")]
        each = [(access, f"{name}/{one}" if one else name) for access, ones in asked for one in ones.split(" ")]
        enforced = all(gate.admits(access, module, one) for access, one in each)
        assert json.loads(answer.output)["allowed"] is enforced, (module, word, name, file.read_text())
        assert answer.exit_code == (0 if enforced else 1)
