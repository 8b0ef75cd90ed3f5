"""The bundle runs from anywhere, and neither its Python nor pip's heeds the variables of another one.

RMPA_BUNDLE names a bundle that is there; else one is made around the interpreter that runs the tests.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Final

import pytest

from lab.bed.processes import DEADLINE, Process, eventually, run
from tests.cli.conftest import free_port

ROOT: Final = Path(__file__).resolve().parents[2]
GIVEN: Final = os.environ.get("RMPA_BUNDLE")
POISON: Final = "import os\nos.write(2, b'poison: ' + __file__.encode() + b'\\n')\nos._exit(99)\n"
MODULES: Final = ("json", "click", "ssl", "asyncio", "msgspec", "aiohttp", "zenoh", "cryptography", "numpy", "rmpa")
AT_START: Final = ("sitecustomize", "usercustomize")
LIBRARIES: Final = ("ssl.so.3", "crypto.so.3", "sqlite3.so.0", "z.so.1", "ffi.so.8", "lzma.so.5", "bz2.so.1.0")
LIBRARIES_OF_WHEELS: Final = ("gcc_s.so.1", "stdc++.so.6")
NODE: Final = """\
from rmpa.resource import Resource
import os, sys
camera = Resource("camera", role="sensing", physical=False)
frames = camera.output("frames", "std_msgs/UInt8MultiArray")
@camera.profile(offers={"rate": "10 Hz"}, best_effort=True)
def full() -> None: pass
@camera.task(rate="10 Hz")
def shoot() -> None: frames.publish(data=b"1")
print("the file has", os.environ["PYTHONPATH"], flush=True)
"""

pytestmark = pytest.mark.timeout(900)  # the first one builds the bundle


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if GIVEN:
        return Path(GIVEN).resolve()
    out = tmp_path_factory.mktemp("a folder with spaces")
    words = ["--folder-only", "--python", sys.base_prefix, str(out)]
    done = subprocess.run(
        [sys.executable, ROOT / "packaging/bundle/build", *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return Path(done.stdout.strip())


@pytest.fixture
def environ(tmp_path: Path) -> dict[str, str]:
    """Variables that name another Python, one that must not be heard."""
    user = tmp_path / f"home/.local/lib/python3.{sys.version_info.minor}/site-packages"
    for folder, names in ((tmp_path / "poison", (*MODULES, *AT_START)), (user, (*MODULES, *AT_START))):
        folder.mkdir(parents=True)
        for name in names:
            (folder / f"{name}.py").write_text(POISON)
    (tmp_path / "libraries").mkdir()
    for name in (*LIBRARIES, *LIBRARIES_OF_WHEELS) if GIVEN else ():
        (tmp_path / "libraries" / f"lib{name}").write_text("poison")
    kept = {
        name: value for name, value in os.environ.items() if not name.startswith(("ROS_", "RMPA_", "XDG_", "PYTHON"))
    }
    (tmp_path / "run").mkdir()
    return kept | {
        "HOME": str(tmp_path / "home"),
        "LD_LIBRARY_PATH": str(tmp_path / "libraries"),
        "PYTHONHOME": str(tmp_path / "nowhere"),
        "PYTHONPATH": str(tmp_path / "poison"),
        "PYTHONSTARTUP": str(tmp_path / "poison/json.py"),
        "RMPA_RUNTIME_DIR": str(tmp_path / "run"),
        "RMPA_WEB_PORT": str(free_port()),
    }


@pytest.fixture
def pip_environ(environ: dict[str, str], tmp_path: Path) -> dict[str, str]:
    """The same without what Python itself heeds before any module of ours."""
    for name in (*AT_START, "rmpa"):
        (tmp_path / f"poison/{name}.py").unlink()
    for library in (tmp_path / "libraries").iterdir():  # heeded by the loader of the system's Python
        library.unlink()
    return environ | {"PYTHONHOME": "", "PYTHONNOUSERSITE": "1"}


@pytest.fixture(params=["bundle", "pip"])
def program(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[list[Path | str], dict[str, str]]:
    """The program as the bundle and as pip have it, at home in a directory of the test, and its environment.

    No variable leads it away from the home that the password database names, so it has one of its own.
    """
    script, environ = Path(sys.executable).with_name("rmpa"), "pip_environ"
    if request.param == "bundle":
        script, environ = request.getfixturevalue("bundle") / "rmpa", "environ"
    elif not script.exists():
        pytest.skip("rmpa is not installed beside this Python")
    users = tmp_path / "passwd"
    users.write_text(f"root:x:0:0:root:{tmp_path / 'home'}:/bin/sh\n")
    as_root = ["--map-root-user"] if os.geteuid() else []
    bind = 'mount --bind "$0" /etc/passwd && exec "$@"'
    return ["unshare", "--mount", *as_root, "sh", "-c", bind, users, script], request.getfixturevalue(environ)


def test_agent_page_gateway_and_trust_are_deaf_and_hand_the_variables_on(
    program: tuple[list[Path | str], dict[str, str]], tmp_path: Path
) -> None:
    command, environ = program
    local = ["--interface", "lo"]
    site = ["--site", "hall", "--listen", f"tcp/127.0.0.1:{free_port()}", "--insecure", *local]
    words = ["up", "--name", "a", "--core-port", str(free_port()), "--web", *local]
    with Process([*command, *words], env=environ, name="agent") as agent:
        core = agent.wait_for("ROS_MASTER_URI=(\\S+)")[1]
        _page_and_definitions(command, environ, agent, core, tmp_path)
        with Process([*command, "gateway", *site], env=environ, name="gateway") as gateway:
            gateway.wait_for("leads site hall")
            assert "poison" not in gateway.output + agent.output
    run([*command, "trust", "init", "--name", "a"], env=environ)


def _page_and_definitions(
    command: list[Path | str], environ: dict[str, str], agent: Process, core: str, tmp_path: Path
) -> None:
    address = f"http://127.0.0.1:{environ['RMPA_WEB_PORT']}/metrics"
    page = eventually(lambda: _get(address), what="an answer of the page")
    assert "rmpa_" in page
    child = next(pid for pid in _children(agent.pid) if "web" in _words(pid))
    theirs = dict(
        entry.split("=", 1) for entry in Path(f"/proc/{child}/environ").read_text().split("\0") if "=" in entry
    )
    for name in ("PYTHONPATH", "LD_LIBRARY_PATH", "PYTHONSTARTUP"):
        assert theirs[name] == environ[name]
    assert "/rosout" in run([*command, "topic", "list"], env=environ)
    module = tmp_path / "poison/my_msgs/msg/_Thing.py"
    module.parent.mkdir(parents=True)
    module.write_text('class Thing(object):\n  _type = "my_msgs/Thing"\n  _full_text = """int8 x"""\n')
    words = ["topic", "pub", "--master", core, "-1", "/thing", "my_msgs/Thing", "{x: 1}"]
    run([*command, *words], env=environ)


def test_a_file_of_the_user_runs_and_has_the_variables(
    program: tuple[list[Path | str], dict[str, str]], tmp_path: Path
) -> None:
    command, environ = program
    (tmp_path / "camera.py").write_text(NODE)
    options = ["--", "--interface", "lo", "--core-port", str(free_port())]
    with Process([*command, "run", tmp_path / "camera.py", "--no-state", *options], env=environ, name="run") as node:
        node.wait_for(f"the file has {re.escape(environ['PYTHONPATH'])}")
        node.wait_for("camera: active")


def test_it_starts_by_a_symlink_in_any_folder_and_writes_nothing(
    bundle: Path, environ: dict[str, str], tmp_path: Path
) -> None:
    before = {path: path.lstat().st_mtime_ns for path in bundle.rglob("*")}
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/rmpa").symlink_to(os.path.relpath(bundle / "rmpa", tmp_path / "bin"))
    by_path = environ | {"PATH": f"{tmp_path}/bin:{environ['PATH']}"}
    for words, folder in (
        (["rmpa", "--version"], tmp_path),
        (["./rmpa", "doctor"], bundle),
        (["sh", "rmpa", "--version"], bundle),
    ):
        done = subprocess.run(words, cwd=folder, env=by_path, capture_output=True, text=True, check=False)
        assert "rmpa" in done.stdout, done.stderr
        assert "poison" not in done.stderr
    assert {path: path.lstat().st_mtime_ns for path in bundle.rglob("*")} == before


def test_its_python_makes_virtual_environments(bundle: Path, tmp_path: Path) -> None:
    environ = {"PATH": os.environ["PATH"], "HOME": str(tmp_path)}
    run([bundle / "python/bin/python3", "-m", "venv", tmp_path / "venv"], env=environ, timeout=120)
    words = ["-c", "import sqlite3, ssl, sys, zoneinfo; print(sys.prefix, sys.getfilesystemencoding())"]
    assert run([tmp_path / "venv/bin/python", *words], env=environ).split() == [str(tmp_path / "venv"), "utf-8"]
    assert "pip" in run([tmp_path / "venv/bin/pip", "--version"], env=environ)


def test_no_file_asks_for_a_newer_glibc_than_2_27(bundle: Path) -> None:
    folder = bundle if GIVEN else next(bundle.glob("python/lib/python3*/*-packages"))
    done = subprocess.run(
        [ROOT / "packaging/bundle/elf.py", folder, "2.27"], capture_output=True, text=True, check=False
    )
    if GIVEN:
        assert (done.returncode, done.stdout.splitlines()[1:]) == (0, [])
    assert "GLIBC_" not in done.stdout
    assert re.match(r"glibc 2\.(2[0-7]|1\d)\b", done.stdout)


@pytest.mark.long
def test_the_same_commit_gives_the_same_bytes_in_any_folder(tmp_path: Path) -> None:
    for folder in ("one", "another place/deeper"):
        words = ["--python", sys.base_prefix, str(tmp_path / folder)]
        run([sys.executable, ROOT / "packaging/bundle/build", *words], timeout=600)
    one, other = (path.read_bytes() for path in tmp_path.rglob("rmpa-*.tar.xz"))
    assert one == other


def test_the_licences_of_all_parts_are_in_it(bundle: Path) -> None:
    owners = {path.name for path in (bundle / "LICENSES").iterdir()}
    parts = {path.name.split("-")[0] for path in bundle.glob("python/lib/python3*/*-packages/*.dist-info")}
    assert {"python", "numpy", "cryptography"} < owners
    assert not parts - owners


def _get(url: str) -> str:
    try:
        with urllib.request.urlopen(url, timeout=DEADLINE) as answer:
            return str(answer.read().decode())
    except OSError:
        return ""


def _words(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/cmdline").read_text().split("\0")


def _children(pid: int) -> list[int]:
    """Processes that a process has started, and those that they have."""
    lists = Path(f"/proc/{pid}/task").glob("*/children")  # of each thread
    direct = [int(word) for found in lists for word in found.read_text().split()]
    return [*direct, *(each for child in direct for each in _children(child))]
