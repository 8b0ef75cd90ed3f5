"""``rmpa trust init|invite|join|status|renew|revoke|leave`` as a user meets them, with real agents on loopback."""

from __future__ import annotations

import json
import re
import signal
from pathlib import Path

import pytest

pytest.importorskip("cryptography")

import subprocess
from collections.abc import Callable

from tests.cli.conftest import DEADLINE, Machine, until


def peers(machine: Machine) -> dict[str, str]:
    return {peer["name"]: peer["state"] for peer in json.loads(machine.says("peer", "list", "--json"))}


def trust(machine: Machine, *arguments: str, stdin: str = "") -> str:
    """A command that succeeds; what it says."""
    return machine.says("trust", *arguments, stdin=stdin)


def refused(machine: Machine, *arguments: str, stdin: str = "", code: int = 1) -> str:
    """A command that fails; what the user reads."""
    return machine.says("trust", *arguments, stdin=stdin, code=code)


def _line(process: subprocess.Popen[str], words: str) -> str:
    """The next line on standard error that has these words."""
    assert process.stderr is not None
    for line in process.stderr:
        if words in line:
            return line
    raise AssertionError(f"no line with {words!r}")


def test_from_init_to_a_linked_mesh_and_to_a_revocation(machines: Callable[[str], Machine]) -> None:
    base, arm = machines("base"), machines("arm")
    out = trust(base, "init", "--label", "lab")
    assert "base is the authority of a new mesh" in out
    assert "Keep a copy of that folder" in out
    assert "is a member of a secured mesh already; rmpa trust status shows it" in refused(base, "init")
    assert "the agent base: does not run, so no module can join; start it: rmpa up" in refused(base, "invite")
    base.up()
    assert "trust is off" not in base.log()

    with base.start("trust", "invite") as inviting:
        assert inviting.stdout is not None
        token = inviting.stdout.readline().strip()
        _line(inviting, "waiting for the module")
        assert "arm has joined; its certificate ends" in trust(arm, "join", "-", stdin=token + "\n")
        assert "arm has joined" in _line(inviting, "has joined")

    arm.up()
    until(lambda: peers(arm).get("base") == "linked" and peers(base).get("arm") == "linked")
    shown = base.status()
    assert (shown["is_authority"], shown["agent"], shown["problems"]) == (True, "secured", [])
    assert [(m["name"], m["linked"]) for m in shown["members"]] == [("arm", True), ("base", True)]
    assert arm.status()["authority"] == "base"
    assert "certificate: valid until" in trust(base, "status")
    assert "arm has a new certificate until" in trust(arm, "renew")
    assert "group key 2 is made" in trust(base, "renew", "--group-key")
    assert "is not the authority of its mesh; do it at base" in refused(arm, "revoke", "base")
    assert "did you mean arm?" in refused(base, "revoke", "amr")
    assert "arm is revoked (deny list 1); there is a new group key" in trust(base, "revoke", "arm")
    until(lambda: peers(base).get("arm") != "linked")
    assert base.status()["revoked"] == ["arm"]
    # It comes back: leave, join with a token from standard input, start again.
    arm.down()
    assert "arm has left its mesh" in trust(arm, "leave", "--yes")
    token = trust(base, "invite", "--no-wait").split()[0]
    trust(arm, "join", "-", stdin=token + "\n")
    arm.up()
    until(lambda: peers(arm).get("base") == "linked")
    for secret in (token, token.removeprefix("rmpa1-")):
        assert secret not in base.log() + arm.log()


def test_a_token_that_cannot_be_used(machines: Callable[[str], Machine]) -> None:
    base, arm, gripper = machines("base"), machines("arm"), machines("gripper")
    trust(base, "init")
    base.up()
    token = trust(base, "invite", "--no-wait", "--module", "gripper").split()[0]
    mistyped = token[:-2] + ("bb" if token.endswith("aa") else "aa")
    assert "the token is mistyped" in refused(arm, "join", mistyped, code=2)
    assert "it is not whole" in refused(arm, "join", token[:-9], code=2)
    assert "does not begin with rmpa1-" in refused(arm, "join", "-", stdin="\n", code=2)
    assert token not in refused(arm, "join", mistyped, code=2)
    assert "join with the --name that it is for" in refused(arm, "join", token)
    assert arm.status()["on"] is False  # nothing is left behind
    trust(gripper, "join", token)
    err = refused(arm, "join", "--name", "gripper", token)
    assert "gripper cannot join: the token was used (used)" in err
    assert "each token lets one module join; ask for a new one: rmpa trust invite" in err
    token = trust(base, "invite", "--no-wait").split()[0]
    base.down()
    assert "no authority answers at" in refused(arm, "join", token)


def test_errors_of_json_and_of_options(machines: Callable[[str], Machine]) -> None:
    arm = machines("arm")
    assert arm.status()["on"] is False
    assert "trust is off: arm (name in rmpa.toml) has joined no secured mesh" in trust(arm, "status")
    for words, arguments, code in (
        ("needs a TOKEN, --request or --accept", ("join",), 2),
        ("is not a time up to 30 d", ("invite", "--for", "1y"), 2),
        ("'x' is no port", ("invite", "--address", "10.0.0.1:x"), 2),
        ("has joined no secured mesh; make a mesh: rmpa trust init", ("invite",), 1),
        ("has joined no secured mesh", ("revoke", "base"), 1),
        ("has joined no secured mesh", ("renew",), 1),
        ("there is nothing to remove", ("leave", "--yes"), 1),
        ("not a ROS base name", ("status", "--name", "my arm"), 2),
    ):
        found, out, err = arm.run("trust", *arguments, "--json")
        assert (found, words in err) == (code, True), err
        assert words in json.loads(out)["error"]
    trust(arm, "init")
    assert "nothing was removed" in refused(arm, "leave", stdin="n\n", code=2)
    assert "add --yes" in arm.run_apart("trust", "leave")[2]
    store = arm.path / ".local/state/rmpa/arm/trust"
    (store / "keys.json").unlink()
    for command in ("status", "renew"):
        assert "keys.json: is missing; join again" in refused(arm, command)
    assert "keys.json: is missing; join again" in arm.says("up", code=1)
    trust(arm, "leave", "--yes")


def test_a_join_by_files(machines: Callable[[str], Machine]) -> None:
    base, arm = machines("base"), machines("arm")
    trust(base, "init")
    csr = arm.path / "arm.csr"
    out = trust(arm, "join", "--request", str(csr))
    shown = re.search(r"with the key ([0-9a-f ]+);", out)
    assert shown is not None
    code, out, err = base.run("trust", "invite", "--sign", str(csr), stdin="y\n")
    assert code == 0, err
    assert f"arm asks with the key {shown[1]}" in err
    ca = re.search(r"--ca ([0-9a-f]+) --name arm$", out, re.MULTILINE)
    assert ca is not None
    answer = Path(f"{csr}.answer")
    assert answer.stat().st_mode & 0o077 == 0
    assert "exists already" in refused(base, "invite", "--yes", "--sign", str(csr), code=2)
    assert "does not have the fingerprint of --ca" in refused(
        arm, "join", "--accept", str(answer), "--ca", "0" * 32, code=2
    )
    assert "is not 32 hexadecimal digits" in refused(arm, "join", "--accept", str(answer), code=2)
    assert "is no answer of rmpa trust invite" in refused(arm, "join", "--accept", str(csr), "--ca", ca[1], code=2)
    trust(arm, "join", "--accept", str(answer), "--ca", ca[1])
    assert arm.status()["on"] is True
    assert not (arm.path / ".local/state/rmpa/arm/trust/request.key").exists()
    assert "is no request" in refused(base, "invite", "--sign", str(answer), code=2)
    base.up()
    arm.up()
    until(lambda: peers(arm).get("base") == "linked")


def test_an_agent_without_trust_warns_and_says_that_it_must_be_started_again(
    machines: Callable[[str], Machine],
) -> None:
    base = machines("base")
    base.up()
    until(lambda: "peers can find it" in base.log() and "trust is off" in base.log())
    assert base.log().count("trust is off: every program that reaches port") == 1
    out = base.run("trust", "init")
    assert "the agent base runs without its keys; restart it: end it (Ctrl-C), then rmpa up" in out[2]
    shown = base.status()
    assert (shown["on"], shown["agent"]) == (True, "plain")
    assert "restart it: end it" in str(shown["problems"])
    assert "runs without its keys, so no module can join; restart it: end it" in refused(base, "invite")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_ctrl_c_or_a_closed_terminal_withdraws_the_token(
    machines: Callable[[str], Machine], number: signal.Signals
) -> None:
    base, arm = machines("base"), machines("arm")
    trust(base, "init")
    base.up()
    with base.start("trust", "invite", "--json") as inviting:
        assert inviting.stdout is not None
        token = json.loads(inviting.stdout.readline())["token"]
        inviting.send_signal(number)
        _, err = inviting.communicate(timeout=DEADLINE)
    assert (inviting.returncode, "the token is withdrawn" in err) == (130, True), err
    assert "arm cannot join: the token is unknown here (token)" in refused(arm, "join", token)
