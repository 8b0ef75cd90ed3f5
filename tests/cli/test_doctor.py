"""``rmpa doctor`` as a user runs it; kept to loopback."""

from __future__ import annotations

import os
import socket
from typing import TYPE_CHECKING

import pytest

from rmpa.observe.doctor.checks import CHECKS

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.cli.conftest import Place


@pytest.fixture
def loopback(place: Place) -> Place:
    """A shell whose settings keep to this machine, at ports of this test's own."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        core = probe.getsockname()[1]
    lines = [f"[core]\nport = {core}", '[discovery]\ninterfaces = ["lo"]']
    lines.append(f'multicast = "239.255.82.77:{20000 + os.getpid() % 20000}"')
    (place.path / "rmpa.toml").write_text("\n".join(lines) + "\n")
    return place


def found(place: Place, *words: str) -> dict[tuple[object, object], dict[str, object]]:
    import json

    _, out, err = place.run("doctor", "--json", *words)
    assert "Traceback" not in err
    return {(f["check"], f["subject"]): f for f in json.loads(out)}


def test_every_check_answers(loopback: Place) -> None:
    loopback.environ["ROS_IP"] = "127.0.0.1"
    answers = found(loopback)
    checks = {check for check, _ in answers}
    assert checks == {
        *("settings", "agent", "interface", "multicast", "firewall", "rp_filter", "route", "port", "ROS", "clock"),
        "radio",
        *("realtime", "files", "boot", "exposed nodes"),
    }
    assert set(CHECKS) <= checks
    assert answers["multicast", "lo"]["level"] == "ok"
    assert str(answers["settings", ""]["text"]).startswith("read from rmpa.toml: name ")
    assert {str(f["level"]) for f in answers.values()} <= {"ok", "warn", "skipped"}
    code, out, err = loopback.run("doctor")
    assert (code, err) == (0, "")
    assert "multicast lo: 239.255.82.77:" in out
    assert out.splitlines()[-1].split()[1] == "answers:"


def test_an_agent_and_its_peers_are_looked_at(loopback: Place, agent: Callable[..., None]) -> None:
    agent()
    answers = found(loopback)
    assert answers["agent", "base"]["text"] == "no multicast on eth0", "the last one said of it"
    assert answers["peer", "base-pc"]["text"] == "linking: connection refused"
    assert ("route", "10.0.0.2 (joystick)") in answers
    code, out, _ = loopback.run("doctor", "--quiet")
    assert code == 0
    assert "shares its name" in out
    assert not any(line.startswith("ok") for line in out.splitlines())


@pytest.mark.parametrize(
    ("variable", "value", "subject"),
    [
        ("ROS_MASTER_URI", "http://203.0.113.7:11311", "ROS_MASTER_URI"),
        ("ROS_IP", "203.0.113.7", "ROS_IP"),
        ("ROS_HOSTNAME", "no-such-host.invalid", "ROS_HOSTNAME"),
        ("ROS_DOMAIN_ID", "1000", "ROS_DOMAIN_ID"),
    ],
)
def test_what_would_mislead_nodes_fails(loopback: Place, variable: str, value: str, subject: str) -> None:
    loopback.environ["ROS_IP"] = "127.0.0.1"
    loopback.environ[variable] = value
    if variable == "ROS_HOSTNAME":
        del loopback.environ["ROS_IP"]
    assert found(loopback)["ROS", subject]["level"] == "fail"
    assert loopback.run("doctor")[0] == 1


def test_invalid_settings_are_reported_and_the_rest_is_checked(loopback: Place) -> None:
    (loopback.path / "bad.toml").write_text('[discovery]\ninterfaces = ["lo"]\n[core]\nprot = 1\n')
    loopback.environ["RMPA_INTERFACES"] = "lo"
    answers = found(loopback, "--config", "bad.toml")
    assert "bad.toml:4: core.prot: an unknown key" in str(answers["settings", "core.prot"]["text"])
    assert ("clock", "step") in answers


def test_a_core_port_that_somebody_else_has(loopback: Place) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        loopback.environ["RMPA_CORE_PORT"] = str(port)
        taken = found(loopback)["port", str(port)]
    assert taken["level"] == "fail"
    assert "Address already in use" in str(taken["text"])
