"""The program as a whole: help, exit codes, quiet ends."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from typing import TYPE_CHECKING

import click
import pytest
from click.testing import CliRunner

from rmpa import __version__
from rmpa.cli.lazy_group import LazyGroup
from rmpa.cli.main import cli, main

if TYPE_CHECKING:
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


@pytest.mark.parametrize(("path", "command"), [(path, command) for path, _, command in ALL])
def test_each_command_has_help(path: str, command: click.Command) -> None:
    result = CliRunner().invoke(cli, [*path.split()[1:], "--help"])
    assert result.exit_code == 0
    if not isinstance(command, LazyGroup) and path != "rmpa core":
        assert "Examples:" in result.output, path


@pytest.mark.parametrize(("path", "command"), [(path, command) for path, _, command in ALL])
def test_each_command_but_those_without_an_answer_has_json(path: str, command: click.Command) -> None:
    if path.split()[1] in ("peer", "topic") and not isinstance(command, LazyGroup):
        assert any("--json" in parameter.opts for parameter in command.params), path


WORDS = {"values": "{}", "value": "1"}
QUIET = {
    "rmpa doctor",
    "rmpa multicast send",
    "rmpa multicast receive",
    "rmpa trust init",
    "rmpa trust status",
    "rmpa web",
}
"""These need neither an agent nor a master."""


@pytest.mark.parametrize(
    ("path", "command"),
    [
        (path, command)
        for path, _, command in ALL
        if path not in QUIET and any("--json" in parameter.opts for parameter in command.params)
    ],
)
def test_an_error_is_json_too(
    path: str,
    command: click.Command,
    place: Place,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Where neither an agent nor a master answers, and whatever is named is not there."""
    for name in [name for name in os.environ if name.startswith(("ROS_", "RMPA_"))]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("RMPA_RUNTIME_DIR", str(place.path))
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:9/")
    monkeypatch.chdir(place.path)
    arguments = [
        WORDS.get(parameter.name or "", "nothere")
        for parameter in command.params
        if isinstance(parameter, click.Argument) and (parameter.required or parameter.name == "names")
    ]
    code = main([*path.split()[1:], *arguments, "--json"])
    out, err = capsys.readouterr()
    said = json.loads(out)
    assert code in {1, 2}, out
    assert list(said) == ["error"]
    assert said["error"] in " ".join(err.split()) or said["error"] in err


def test_an_error_is_json_only_where_that_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["peer", "info", "--no-such-flag"]) == 2
    assert capsys.readouterr().out == ""
    assert main(["peer", "info", "--no-such-flag", "--json"]) == 2
    assert list(json.loads(capsys.readouterr().out)) == ["error"]
    assert main(["peer", "info", "--no-such-flag", "--", "--json"]) == 2
    assert capsys.readouterr().out == ""


def test_version() -> None:
    assert CliRunner().invoke(cli, ["--version"]).output == f"rmpa {__version__}\n"


def test_a_command_that_moved_says_where_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", "run", "--short"]) == 2
    assert "make experiment" in capsys.readouterr().err


def test_a_misspelt_command_is_told_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["topci", "list"]) == 2
    assert "Did you mean topic?" in capsys.readouterr().err


def test_a_setting_that_cannot_be_exits_2(place: Place) -> None:
    code, out, err = place.run("up", "--name", "robot-1")
    assert (code, out) == (2, "")
    assert err.startswith("rmpa: --name: 'robot-1' is not a ROS base name")
    assert "did you mean --name robot_1?" in err


def test_a_mistake_in_the_file_names_file_line_and_key(place: Place) -> None:
    (place.path / "rmpa.toml").write_text("[core]\nprot = 1\n")
    assert place.run("up") == (2, "", "rmpa: rmpa.toml:2: core.prot: an unknown key; did you mean core.port?\n")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts(shell: str) -> None:
    assert "_RMPA_COMPLETE" in CliRunner().invoke(cli, ["completion", shell]).output


@pytest.mark.parametrize("module", ["rmpa.cli.main", "rmpa.cli.up", "rmpa.cli.peer", "rmpa.cli.topic_graph"])
def test_heavy_packages_wait_until_they_are_needed(module: str) -> None:
    importlib.import_module(module)
    heavy = "{'aiohttp', 'prometheus_client', 'rich', 'numpy', 'rosbags', 'ruamel', 'yaml', 'matplotlib'}"
    code = f"import sys, {module}; sys.exit(' '.join({heavy} & set(sys.modules)) or 0)"
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).stderr == b""


def test_help_imports_no_command() -> None:
    code = (
        "import sys; from rmpa.cli.main import main; main(['--help']);"
        "sys.exit(' '.join({'asyncio', 'msgspec', 'rmpa.cli.up', 'rmpa.cli.peer'} & set(sys.modules)) or 0)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).stderr == b""
