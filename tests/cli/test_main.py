"""The program as a whole: help, exit codes, quiet ends."""

from __future__ import annotations

import importlib
import json
import os
import socket
import subprocess
import sys
import threading
from typing import TYPE_CHECKING

import click
import pytest
from click.testing import CliRunner

import rmpa
from rmpa.cli import agent
from rmpa.cli.main import MEANT, REMOVED_VERBS, LazyGroup, cli, main
from tests.cli.conftest import DEADLINE, with_core

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.ros.core.embedded import RosCore
    from tests.cli.conftest import Place


def commands(group: LazyGroup, path: str = "rmpa") -> list[tuple[str, str, click.Command]]:
    found: list[tuple[str, str, click.Command]] = []
    for name, (_, text) in group.commands_at.items():
        command = group.get_command(click.Context(group), name)
        assert command is not None, name
        found.append((f"{path} {name}", text, command))
        if isinstance(command, LazyGroup):
            found += commands(command, f"{path} {name}")
    return found


assert isinstance(cli, LazyGroup)
ALL = commands(cli)


def test_each_command_has_help_and_each_of_a_graph_has_json() -> None:
    for path, _, command in ALL:
        result = CliRunner().invoke(cli, [*path.split()[1:], "--help"])
        assert result.exit_code == 0, path
        if isinstance(command, LazyGroup):
            continue
        assert "Examples:" in result.output or path == "rmpa core" or path.startswith("rmpa config "), path
        if path.split()[1] in ("peer", "topic"):
            assert any("--json" in parameter.opts for parameter in command.params), path


@pytest.mark.parametrize("command", ["up", "core"])
def test_an_option_that_is_gone_says_what_to_use(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--fresh"]) == 2
    assert "No such option: --fresh; write --keep never" in capfd.readouterr().err


WORDS = {"values": "{}", "value": "1"}
QUIET = {
    "rmpa explain",
    "rmpa config show",
    "rmpa bug-report",
    "rmpa doctor",
    "rmpa init",
    "rmpa trust init",
    "rmpa trust status",
    "rmpa web",
}
"""These need neither an agent nor a master."""


def test_an_error_is_json_too(
    place: Place, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where neither an agent nor a master answers, and whatever is named is not there."""
    for name in [name for name in os.environ if name.startswith(("ROS_", "RMPA_"))]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("RMPA_RUNTIME_DIR", str(place.path))
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:9/")
    monkeypatch.chdir(place.path)
    with_json = [
        (path, command)
        for path, _, command in ALL
        if path not in QUIET and any("--json" in parameter.opts for parameter in command.params)
    ]
    assert len(with_json) > 40
    for path, command in with_json:
        arguments = [
            WORDS.get(parameter.name or "", "nothere")
            for parameter in command.params
            if isinstance(parameter, click.Argument) and (parameter.required or parameter.name == "names")
        ]
        code = main([*path.split()[1:], *arguments, "--json"])
        out, err = capsys.readouterr()
        said = json.loads(out)
        assert code in {1, 2}, out
        assert list(said) == ["error", "code"]
        assert said["error"] in " ".join(err.split()) or said["error"] in err, path


def test_an_error_is_json_only_where_that_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["peer", "info", "--no-such-flag"]) == 2
    assert capsys.readouterr().out == ""
    assert main(["peer", "info", "--no-such-flag", "--json"]) == 2
    assert list(json.loads(capsys.readouterr().out)) == ["error", "code"]
    assert main(["peer", "info", "--no-such-flag", "--", "--json"]) == 2
    assert capsys.readouterr().out == ""


def test_version_of_a_build_comes_with_its_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"VERSION": "0.2.0", "COMMIT": "1a2b3c4d5e", "DATE": "2026-11-26"}.items():
        monkeypatch.setattr(rmpa, name, value)
    assert CliRunner().invoke(cli, ["--version"]).output == "rmpa 0.2.0 (1a2b3c4d5e, 2026-11-26)\n"


def test_a_bug_report_has_the_formats_and_the_system(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["version"].startswith(rmpa.__version__.removesuffix("0"))
    assert (told["protocols"]["beacon"], told["protocols"]["link"]) == (2, 3)
    assert told["python"] == ".".join(map(str, sys.version_info[:3]))
    assert main(["--json", "topic", "list"]) == 2
    assert "--json belongs after the command: rmpa topic list --json" in capsys.readouterr().err


@pytest.mark.parametrize(("words", "remedy"), REMOVED_VERBS.items())
def test_a_command_that_is_gone_says_what_to_use(words: str, remedy: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words.split(), "an-argument", "--an-option"]) == 2
    assert f"rmpa {words}: is not a command any more; {remedy}" in " ".join(capsys.readouterr().err.split())


def test_a_misspelt_command_is_told_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["topci", "list"]) == 2
    assert "Did you mean `rmpa topic`?" in capsys.readouterr().err


def test_a_setting_that_cannot_be_exits_2(place: Place) -> None:
    code, out, err = place.run("up", "--name", "robot-1")
    assert (code, out) == (2, "")
    assert err.startswith("rmpa: --name: 'robot-1' is not a ROS base name")
    assert "did you mean --name robot_1?" in err


def test_a_mistake_in_the_file_names_file_line_and_key(place: Place) -> None:
    (place.path / "rmpa.toml").write_text("[core]\nprot = 1\n")
    assert place.run("up") == (
        2,
        "",
        "rmpa: rmpa.toml:2: core.prot: an unknown key; did you mean core.port? [invalid-value]\n",
    )


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts(shell: str) -> None:
    assert "_RMPA_COMPLETE" in CliRunner().invoke(cli, ["completion", shell]).output


@pytest.mark.parametrize("module", ["rmpa.cli.main", "rmpa.cli.agent", "rmpa.cli.peer", "rmpa.cli.topic"])
def test_heavy_packages_wait_until_they_are_needed(module: str) -> None:
    importlib.import_module(module)
    heavy = "{'aiohttp', 'rich', 'numpy', 'rosbags', 'ruamel', 'yaml', 'matplotlib'}"
    code = f"import sys, {module}; sys.exit(' '.join({heavy} & set(sys.modules)) or 0)"
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).stderr == b""


def test_help_without_arguments_is_no_error_with_a_code(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert capsys.readouterr().err.endswith("why they do not come\n")


def test_help_imports_no_command() -> None:
    code = (
        "import sys; from rmpa.cli.main import main; main(['--help']);"
        "sys.exit(' '.join({'asyncio', 'msgspec', 'rmpa.cli.agent', 'rmpa.cli.peer'} & set(sys.modules)) or 0)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).stderr == b""


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("list", "Did you mean `rmpa peer list` or `rmpa topic list`?"),
        ("help", "Did you mean `rmpa --help`?"),
        ("version", "Did you mean `rmpa --version`?"),
        ("start", "Did you mean `rmpa up` or `rmpa service install`?"),
        ("--json peer list", "--json belongs after the command: rmpa peer list --json"),
        ("topic --agent base list", "--agent belongs after the command: rmpa topic list --agent"),
    ],
)
def test_a_word_at_the_wrong_place_leads_to_the_right_verb(
    line: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(line.split()) == 2
    assert hint in capsys.readouterr().err


def test_every_word_that_leads_to_a_verb_leads_to_one_that_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    for line in {line for lines in MEANT.values() for line in lines if not line.startswith("--")}:
        assert main([*line.split(), "--help"]) == 0
    capsys.readouterr()


@pytest.mark.parametrize("word", ["nan", "inf", "-inf"])
def test_no_number_of_the_command_line_is_endless(word: str) -> None:
    numbers = [(path, each) for path, _, command in ALL for each in command.params if "float" in each.type.name]
    assert numbers
    for path, option in numbers:
        with pytest.raises(click.BadParameter):
            pytest.fail(f"{path} takes {option.type.convert(word, option, None)}")


BASH = """\
eval "$(rmpa completion bash)"
compopt() { :; }
COMP_LINE=$1 COMP_POINT=${#1}
_rmpa_completion rmpa
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("rmpa peer in", ["info"]),
        ("rmpa peer info j", ["joystick"]),
        ("rmpa topic echo /cm", ["/cmd"]),
        ("rmpa topic echo joystick:/c", ["/cmd"]),
        ("rmpa topic hz --agent b", ["base"]),
        ("rmpa param get /ro", ["/rosdistro", "/rosversion"]),
        ("rmpa service call /rosout/get", ["/rosout/get_loggers"]),
        ("rmpa node info joy", ["joystick:/joy"]),
        ("rmpa node info joystick:/", ["/joy"]),
    ],
)
def test_bash_completes_what_the_agent_knows(
    place: Place, agent: Callable[..., None], core: RosCore, line: str, words: list[str]
) -> None:
    agent(snapshot=with_core(core.uri))
    with socket.create_server(("127.0.0.1", 0)) as stands:
        api = f"http://127.0.0.1:{stands.getsockname()[1]}/"
        assert core.call("registerPublisher", "/rmpa/joystick/joy", "/cmd", "sensor_msgs/Joy", api).code == 1
        (place.path / "rmpa").write_text(f'#!/bin/sh\nexec {sys.executable} -m rmpa.cli.main "$@"\n')
        (place.path / "rmpa").chmod(0o755)
        environ = place.environ | {"PATH": f"{place.path}:{os.environ['PATH']}"}
        shell = ["bash", "-c", BASH, "bash", line]
        said = subprocess.run(
            shell, env=environ, cwd=place.path, capture_output=True, text=True, timeout=60, check=True
        )
        core.call("unregisterPublisher", "/rmpa/joystick/joy", "/cmd", api)
    assert said.stdout.split() == words


def test_an_agent_that_hangs_does_not_hold_up_the_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    end = threading.Event()

    def hang(_: click.Context, __: str) -> list[str]:
        end.wait(DEADLINE)
        return ["late"]

    monkeypatch.setitem(agent._FIND, "peer", hang)
    assert agent.complete_names("peer", click.Context(cli), "") == []
    end.set()
