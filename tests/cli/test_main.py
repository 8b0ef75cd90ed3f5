"""The program as a whole: help, exit codes, quiet ends."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable

import click
import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner

import rmpa
from lab.bed.processes import eventually
from rmpa.cli import options
from rmpa.cli.main import _DECLARED, MEANT, VERBS, LazyGroup, cli, main
from rmpa.core import codes
from rmpa.ros.core.embedded import RosCore
from tests.cli.conftest import DEADLINE, Place, with_core


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


WORDS = {"values": "{}", "value": "1"}
# These need neither an agent nor a master.
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


def test_an_error_is_json_too(place: Place) -> None:
    """Where neither an agent nor a master answers, and whatever is named is not there."""
    place.environ["ROS_MASTER_URI"] = "http://127.0.0.1:9/"
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
        code, out, err = place.run(*path.split()[1:], *arguments, "--json")
        said = json.loads(out)
        assert (code in {1, 2}, list(said)) == (True, ["error", "code"]), out
        assert said["error"] in " ".join(err.split()) or said["error"] in err, path
    for words, told in ((("--json",), ["error", "code"]), ((), None), (("--", "--json"), None)):
        code, out, _ = place.run("peer", "info", "--no-such-flag", *words)
        assert (code, list(json.loads(out)) if out else None) == (2, told), "only where it is asked for"


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


def test_a_mistake_names_option_or_file_line_and_key(place: Place) -> None:
    code, out, err = place.run("up", "--name", "robot-1")
    assert (code, out, "did you mean --name robot_1?" in err) == (2, "", True)
    assert err.startswith("rmpa: --name: 'robot-1' is not a ROS base name")
    (place.path / "rmpa.toml").write_text("[core]\nprot = 1\n")
    mistake = "rmpa: rmpa.toml:2: core.prot: an unknown key; did you mean core.port? [invalid-value]\n"
    assert place.run("up") == (2, "", mistake)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts(shell: str) -> None:
    assert "_RMPA_COMPLETE" in CliRunner().invoke(cli, ["completion", shell]).output


def test_heavy_packages_wait_until_they_are_needed() -> None:
    heavy = {"aiohttp", "rmpa.web", "rich", "numpy", "rosbags", "ruamel", "yaml", "matplotlib"}
    assert loaded_by("import rmpa.agent.agent, rmpa.cli.agent, rmpa.cli.peer, rmpa.cli.topic").isdisjoint(heavy)


def test_help_imports_no_command() -> None:
    loaded = loaded_by("from rmpa.cli.main import main; main(['--help'])")
    assert loaded.isdisjoint({"asyncio", "msgspec", "rmpa.cli.agent", "rmpa.cli.peer"})


def loaded_by(code: str) -> set[str]:
    """The modules that a program has loaded then."""
    code = f"import sys; {code}; sys.stderr.write(' '.join(sys.modules))"
    return {*subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stderr.split()}


def test_help_without_arguments_is_no_error_with_a_code(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert capsys.readouterr().err.endswith("why they do not come\n")


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("topci list", "Did you mean `rmpa topic`?"),
        ("list", "Did you mean `rmpa peer list` or `rmpa topic list`?"),
        ("help", "Did you mean `rmpa --help`?"),
        ("version", "Did you mean `rmpa --version`?"),
        ("start", "Did you mean `rmpa up` or `rmpa resource start` or `rmpa service install`?"),
        ("--json peer list", "--json belongs after the command: rmpa peer list --json"),
        ("topic --agent base list", "--agent belongs after the command: rmpa topic list --agent"),
    ],
)
def test_a_word_that_is_wrong_leads_to_the_right_one(place: Place, line: str, hint: str) -> None:
    code, _, err = place.run(*line.split())
    assert (code, hint in " ".join(err.split())) == (2, True), err


def test_every_word_that_leads_to_a_verb_leads_to_one_that_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    for line in {line for lines in MEANT.values() for line in lines if not line.startswith("--")}:
        assert line in _DECLARED
        assert line not in VERBS or main([*line.split(), "--help"]) == 0
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


@pytest.fixture
async def joystick(agent: Callable[..., None], core: RosCore, listening: str) -> AsyncIterator[None]:
    """An agent whose core has a topic of peer joystick."""
    agent(snapshot=with_core(core.uri))
    assert core.call("registerPublisher", "/rmpa/joystick/joy", "/cmd", "sensor_msgs/Joy", listening).code == 1
    yield
    core.call("unregisterPublisher", "/rmpa/joystick/joy", "/cmd", listening)


@pytest.mark.usefixtures("joystick")
def test_a_shell_completes_what_the_agent_knows(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(options, "ANSWER", DEADLINE)
    for line, words in {
        "peer in": ["info"],
        "peer info j": ["joystick"],
        "topic echo /cm": ["/cmd"],
        "topic hz --agent b": ["base"],
        "param get /ro": ["/rosdistro", "/rosversion"],
        "service call /rosout/get": ["/rosout/get_loggers"],
        "node info joy": ["joystick:/joy"],
    }.items():
        *args, begun = line.split()
        with place.shell():
            found = ShellComplete(cli, {}, "rmpa", "_RMPA_COMPLETE").get_completions(args, begun)
        assert [one.value for one in found] == words, line


@pytest.mark.parametrize(
    ("line", "words"), [("rmpa topic echo joystick:/c", ["/cmd"]), ("rmpa node info joystick:/", ["/joy"])]
)
@pytest.mark.usefixtures("joystick")
def test_bash_takes_a_peer_s_name_for_three_words(place: Place, line: str, words: list[str]) -> None:
    (place.path / "rmpa").write_text(f'#!/bin/sh\nexec {sys.executable} -m rmpa.cli.main "$@"\n')
    (place.path / "rmpa").chmod(0o755)
    environ = place.environ | {"PATH": f"{place.path}:{os.environ['PATH']}"}
    shell = ["bash", "-c", BASH, "bash", line]

    def completes() -> bool:
        said = subprocess.run(
            shell, env=environ, cwd=place.path, capture_output=True, text=True, timeout=60, check=True
        )
        return said.stdout.split() == words

    # A shell waits for a second or so, which a busy machine may not have.
    eventually(completes, what=f"{line} completed by {words}")


def test_an_agent_that_hangs_does_not_hold_up_the_shell() -> None:
    end = threading.Event()

    def hang(_: click.Context, __: str) -> list[str]:
        end.wait(DEADLINE)
        return ["late"]

    complete = options.completes(hang)
    assert complete(click.Context(cli), click.Argument(["name"]), "") == []
    end.set()


def help_lines(place: Place, words: str, width: int) -> list[str]:
    place.environ["COLUMNS"] = str(width)
    code, out, _ = place.run(*words.split(), "--help")
    assert code == 0
    return out.splitlines()


def test_every_help_fits_80_columns(place: Place) -> None:
    long = {words: [line for line in help_lines(place, words, 80) if len(line) > 80] for words in ("", *VERBS)}
    assert {words: lines for words, lines in long.items() if lines} == {}


def test_a_wide_terminal_shows_examples_beside_what_they_do(place: Place) -> None:
    assert any(re.search(r"rmpa why arm:/move +why the service", line) for line in help_lines(place, "why", 200))
    narrow = help_lines(place, "why", 80)
    at = narrow.index("    rmpa why arm:/move")
    assert narrow[at + 1] == "        why the service /move of arm cannot be called here"


def test_the_list_of_codes_has_one_line_for_each(place: Place) -> None:
    code, out, _ = place.run("explain")
    lines = [line.split(maxsplit=1) for line in out.splitlines()]
    assert (code, {one for one, _ in lines}) == (0, set(codes.texts()))
    assert all(meaning for _, meaning in lines)


@pytest.mark.pty
@pytest.mark.parametrize(
    ("variables", "coloured"), [({}, True), ({"NO_COLOR": "1"}, False), ({"TERM": "dumb"}, False)]
)
def test_a_dumb_terminal_gets_no_escapes(place: Place, variables: dict[str, str], coloured: bool) -> None:
    environ = {key: value for key, value in place.environ.items() if key != "NO_COLOR"}
    leader, follower = pty.openpty()
    program = [sys.executable, "-m", "rmpa.cli.main", "doctor"]
    environ |= {"TERM": "xterm", **variables}
    said = b""
    with subprocess.Popen(program, env=environ, cwd=place.path, stdin=subprocess.DEVNULL, stdout=follower) as process:
        os.close(follower)
        with contextlib.suppress(OSError):  # EIO is the end
            while data := os.read(leader, 4096):
                said += data
        process.wait(DEADLINE)
    os.close(leader)
    assert b"settings" in said
    assert (b"\x1b[" in said) is coloured
