"""``rmpa trust check``, and keys that are the service's."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

import pytest

from rmpa.cli import trust
from rmpa.cli.main import main
from rmpa.core.errors import StartError
from rmpa.trust.store import TrustStore

if TYPE_CHECKING:
    from pathlib import Path

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


def _run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = main(["trust", *arguments])
    out, err = capsys.readouterr()
    return code, out, err


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "rmpa.toml"
    path.write_text(FILE)
    return str(path)


def test_yes_and_no_with_the_rule(capsys: pytest.CaptureFixture[str], file: str) -> None:
    assert _run(capsys, "check", "joystick", "publish", "/cmd_vel", "--config", file) == (
        0,
        "yes: [[permission]] 1 allows publish of '/cmd_vel' to group 'operators'\n",
        "",
    )
    assert _run(capsys, "check", "base", "publish", "/cmd_vel", "--config", file) == (
        1,
        "no: no [[permission]] lets base publish /cmd_vel\n",
        "",
    )


def test_an_action_is_allowed_as_a_whole(capsys: pytest.CaptureFixture[str], file: str) -> None:
    assert _run(capsys, "check", "laptop1", "action", "/arm/move", "--config", file)[0] == 0
    code, out, _ = _run(capsys, "check", "laptop2", "action", "/arm/move", "--config", file)
    assert code == 1
    assert "[[permission]] 2 denies publish" in out


def test_json_has_the_decision(capsys: pytest.CaptureFixture[str], file: str) -> None:
    code, out, _ = _run(capsys, "check", "laptop2", "publish", "/cmd_vel", "--json", "--config", file)
    assert code == 0
    assert json.loads(out) == {
        "allowed": True,
        "rule": "[[permission]] 1 allows publish of '/cmd_vel' to group 'operators'",
        "number": 1,
        "groups": ["operators"],
        "files": [file],
    }


def test_the_answer_says_that_no_file_was_found(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    code, out, error = _run(capsys, "check", "arm", "publish", "/cmd_vel")
    assert (code, out) == (1, "no: no [[permission]] lets arm publish /cmd_vel\n")
    assert "no rmpa.toml was found here" in error


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("my arm", "publish", "/a"), "not a ROS base name"),
        (("arm", "publish", "a"), "'a' is not a global name"),
        (("arm", "write", "/a"), "'write' is not one of"),
    ],
)
def test_what_cannot_be_asked_exits_2(
    capsys: pytest.CaptureFixture[str], file: str, arguments: tuple[str, ...], words: str
) -> None:
    code, _, err = _run(capsys, "check", *arguments, "--config", file)
    assert code == 2
    assert words in err


@pytest.mark.parametrize(("uid", "words"), [(1000, "sudo rmpa trust join …"), (0, "choose another state directory")])
def test_keys_of_the_service_take_sudo(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, uid: int, words: str
) -> None:
    def refuse(*_: object) -> bool:
        raise StartError("/x/trust", "cannot be searched", "choose another state directory", code="keys-unusable")

    monkeypatch.setenv("RMPA_STATE_DIR", str(tmp_path))
    monkeypatch.setenv("RMPA_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(trust, "STATE", str(tmp_path))
    monkeypatch.setattr(TrustStore, "exists", property(refuse))
    monkeypatch.setattr(os, "geteuid", lambda: uid)
    code, _, error = _run(capsys, "join", "rmpa1-secret", "--name", "arm")
    assert code == 1
    assert words in error
    assert "secret" not in error
