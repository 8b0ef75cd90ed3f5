"""What packages of others add, by entry points: examples/hello, and packages that are broken."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import aiohttp
import pytest

from rmpa.observe.check import Check
from rmpa.observe.doctor.checks import examine
from rmpa.runtime import plugins
from tests.cli.conftest import DEADLINE, Place, free_port
from tests.cli.test_web import running

HELLO = Path(__file__).parents[2] / "examples/hello"


@pytest.fixture(scope="module")
def hello(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip has installed the example."""
    made = tmp_path_factory.mktemp("hello")
    shutil.copytree(HELLO, made / "source")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    command = [*pip, "--disable-pip-version-check", "--target", str(made / "installed"), str(made / "source")]
    subprocess.run(command, check=True, timeout=4 * DEADLINE)
    return made / "installed"


def write_package(folder: Path, group: str, module: str = "", entry: str = "other = rmpa_other:thing") -> None:
    """A package ``rmpa-other 2.0`` with one entry point."""
    about = folder / "rmpa_other-2.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: rmpa-other\nVersion: 2.0\n")
    (about / "entry_points.txt").write_text(f"[{group}]\n{entry}\n")
    (folder / "rmpa_other.py").write_text(module)


@pytest.fixture
def other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of ``sys.path`` for such a package, whose module was not imported before."""
    monkeypatch.syspath_prepend(str(tmp_path))
    plugins.find_plugins.cache_clear()
    yield tmp_path
    plugins.find_plugins.cache_clear()
    sys.modules.pop("rmpa_other", None)


def test_a_package_adds_a_command(place: Place, agent: Callable[..., None], hello: Path) -> None:
    agent()
    place.environ["PYTHONPATH"] = str(hello)
    assert place.run_apart("hello", "you") == (0, "hello you, from base\n", "")
    assert json.loads(place.run_apart("hello", "--json")[1]) == {"hello": "world", "from": "base"}
    assert re.search(r"hello +Of the package rmpa-hello 1.0.\n", place.run_apart("--help")[1])


def test_a_package_adds_a_web_socket_protocol(place: Place, hello: Path) -> None:
    port = free_port()
    place.environ["PYTHONPATH"] = str(hello)

    async def ask() -> tuple[str, str]:
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"http://127.0.0.1:{port}/", protocols=("hello.v1",)) as socket,
        ):
            asked = await socket.receive_str(timeout=DEADLINE)
            await socket.send_str("you")
            return asked, await socket.receive_str(timeout=DEADLINE)

    with running(place, "web", "--port", str(port)) as web:
        assert web.stdout is not None
        assert web.stdout.readline()
        assert asyncio.run(ask()) == ("who is there?", "hello 'you', there are 0 topics")


def test_what_a_package_adds_replaces_no_command(place: Place, other: Path) -> None:
    write_package(other, plugins.VERBS, "thing = None", "peer = rmpa_other:thing")
    assert "See the peers" in place.run("peer", "--help")[1]
    assert "rmpa-other" not in place.run("--help")[1]


@pytest.mark.parametrize(
    ("module", "why"),
    [
        ("raise ValueError('of\\nthat')", "ValueError: of that"),
        ("import rmpa_missing", "ModuleNotFoundError: No module named 'rmpa_missing'"),
        ("", "AttributeError: module 'rmpa_other' has no attribute 'thing'"),
        ("thing = 5", "TypeError: rmpa_other:thing is no click.Command"),
    ],
)
def test_a_broken_package_is_told_in_one_line(place: Place, other: Path, module: str, why: str) -> None:
    write_package(other, plugins.VERBS, module)
    told = f"rmpa: other of the package rmpa-other 2.0 failed: {why} [plugin-broken]\n"
    assert place.run("other") == (1, "", told)
    assert "rmpa-other 2.0" in place.run("--help")[1]
    assert place.run("--version")[0] == 0


def test_a_package_with_a_broken_list_is_left_out(other: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_package(other, plugins.VERBS, entry="no list at all")
    assert plugins.find_plugins(plugins.VERBS) == {}
    assert f"{other}/rmpa_other-2.0.dist-info failed: " in caplog.text


def test_packages_in_the_working_directory_do_not_count(other: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_package(other, plugins.VERBS)
    assert set(plugins.find_plugins(plugins.VERBS)) == {"other"}
    for here in (str(other), "", ".", f"{other}/."):
        monkeypatch.setattr(sys, "path", [here])
        monkeypatch.chdir(other)
        plugins.find_plugins.cache_clear()
        assert plugins.find_plugins(plugins.VERBS) == {}


def checks(module: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[Check]:
    """What doctor says when a package's checks are the only ones."""
    monkeypatch.setattr("rmpa.observe.doctor.checks.CHECKS", {})
    write_package(folder, plugins.DOCTOR_CHECKS, module)
    return [*examine(None)]  # type: ignore[arg-type] # the checks do not look


def test_a_package_adds_a_check(other: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = "from rmpa.observe.check import *\ndef thing(given): yield Check('other', CheckLevel.OK, 'all is well')"
    assert [str(found.text) for found in checks(module, other, monkeypatch)] == ["all is well"]


@pytest.mark.parametrize(
    ("module", "why"), [("def thing(given): 1/0", "division by zero"), ("def thing(given): yield 5", "5 is no Check")]
)
def test_a_broken_check_is_a_warning(other: Path, monkeypatch: pytest.MonkeyPatch, module: str, why: str) -> None:
    (found,) = checks(module, other, monkeypatch)
    assert (found.name, found.level, found.code) == ("other", "warn", "plugin-broken")
    assert why in found.text


def test_a_class_that_is_no_session_is_left_out(other: Path, caplog: pytest.LogCaptureFixture) -> None:
    from rmpa.web.server.process import other_protocols

    write_package(other, plugins.WEB_PROTOCOLS, "thing = dict")
    assert other_protocols() == []
    assert "rmpa-other 2.0 failed: TypeError: rmpa_other:thing is no Session [plugin-broken]" in caplog.text
