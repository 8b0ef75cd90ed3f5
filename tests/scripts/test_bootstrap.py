"""``scripts/bootstrap`` in a clone of its own, on a PATH of fake interpreters: which one builds the environment."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest

_SCRIPT: Final = Path(__file__).parents[2] / "scripts/bootstrap"
# An interpreter as far as the script asks it: version, modules, a virtual environment, and pip, which brings uv.
_PYTHON: Final = """#!/bin/sh
[ -z "${{PYTHONPATH:-}}" ] || exit 3
case "$*" in
    *version_info\\ *) exit {old} ;;
    *ensurepip*) exit {bare} ;;
    --version) echo Python {version} ;;
    "-m venv"*) mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
    "-m pip --version") exit {no_pip} ;;
    *--target*) mkdir -p .uv/bin && cp {uv} .uv/bin/uv ;;
    "-m pip"*) echo pip of {version} ;;
esac
"""
_UV: Final = """#!/bin/sh
case "$*" in
    "python find"*) {find} ;;
    "python install"*) {install} ;;
esac
"""


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """The folder of a clone; the PATH has the script's own tools, and no interpreter yet."""
    (tmp_path / "scripts").mkdir()
    shutil.copy(_SCRIPT, tmp_path / "scripts")
    (tmp_path / "bin").mkdir()
    for tool in ("cat", "cp", "dirname", "ls", "mkdir", "readlink", "sh", "uname"):
        (tmp_path / "bin" / tool).symlink_to(shutil.which(tool) or tool)
    write(tmp_path / "bin/id", "#!/bin/sh\necho 1000\n")  # without root, so that nothing is installed here
    return tmp_path


def write(path: Path, text: str) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)
    return str(path)


def interpreter(path: Path, version: str, *, bare: bool = False, no_pip: bool = False, uv: str = "/dev/null") -> str:
    old = int(version.split(".")[1]) < 11
    return write(path, _PYTHON.format(version=version, old=int(old), bare=int(bare), no_pip=int(no_pip), uv=uv))


def bootstrap(clone: Path, python: str = "python3") -> subprocess.CompletedProcess[str]:
    env = {"PATH": str(clone / "bin"), "HOME": str(clone / "home"), "PYTHONPATH": "/opt/ros/noetic"}
    command = ["/bin/sh", "scripts/bootstrap", python, ".venv"]
    return subprocess.run(command, cwd=clone, env=env, capture_output=True, text=True, check=False, timeout=30)


@pytest.mark.parametrize(
    "there",
    [
        "bin/python3.12",
        "home/.pyenv/versions/3.12.1/bin/python3",
        "usr/lib/rmpa/python/bin/python3",  # the package's program is on the PATH
        f"dist/rmpa-0.2.0-linux-{os.uname().machine}/python/bin/python3",
    ],
)
def test_an_older_python3_gives_way_to_one_that_is_there(clone: Path, there: str) -> None:
    interpreter(clone / "bin/python3", "3.9.2")
    interpreter(clone / there, "3.12.1")
    write(clone / "usr/lib/rmpa/rmpa", "")
    (clone / "bin/rmpa").symlink_to("../usr/lib/rmpa/rmpa")
    done = bootstrap(clone)
    assert done.returncode == 0, done.stderr
    assert re.search(rf"Building .venv with \S*{there}, Python 3.12.1", done.stderr)
    assert "pip of 3.12.1" in done.stdout


def test_a_python3_without_the_venv_module_gives_way_too(clone: Path) -> None:
    interpreter(clone / "bin/python3", "3.12.1", bare=True)
    interpreter(clone / "bin/python3.11", "3.11.2")
    assert "bin/python3.11, Python 3.11.2" in bootstrap(clone).stderr


def test_without_the_venv_module_it_says_what_to_install(clone: Path) -> None:
    interpreter(clone / "bin/python3", "3.12.1", bare=True)
    done = bootstrap(clone)
    assert done.returncode == 1
    assert "python3 lacks the venv module" in done.stderr


def test_a_python3_that_is_new_enough_is_taken(clone: Path) -> None:
    interpreter(clone / "bin/python3", "3.11.2")
    interpreter(clone / "bin/python3.13", "3.13.0")
    assert "with python3, Python 3.11.2" in bootstrap(clone).stderr


def test_one_that_was_named_is_taken_or_refused(clone: Path) -> None:
    interpreter(clone / "bin/python3", "3.11.2")
    interpreter(clone / "bin/python3.12", "3.12.1")
    interpreter(clone / "bin/python3.8", "3.8.10")
    assert "with python3.12, Python 3.12.1" in bootstrap(clone, "python3.12").stderr
    shutil.rmtree(clone / ".venv")
    done = bootstrap(clone, "python3.8")
    assert done.returncode == 1
    assert "'python3.8' is Python 3.8.10" in done.stderr
    assert not (clone / ".venv").exists()


def test_an_environment_that_is_there_stays(clone: Path) -> None:
    interpreter(clone / ".venv/bin/python", "3.13.0")
    done = bootstrap(clone)
    assert (done.returncode, "Building" in done.stderr) == (0, False)
    assert "pip of 3.13.0" in done.stdout


def test_uv_of_the_path_names_one(clone: Path) -> None:
    interpreter(clone / "bin/python3", "3.9.2")
    other = interpreter(clone / "elsewhere/python", "3.13.0")
    write(clone / "bin/uv", _UV.format(find=f"echo {other}", install="exit 2"))
    assert f"with {other}, Python 3.13.0" in bootstrap(clone).stderr


def test_uv_comes_from_pypi_and_fetches_one_into_the_clone(clone: Path) -> None:
    interpreter(clone / "model", "3.12.9")
    find = (
        f'[ -x .uv/python/python ] && [ "$UV_PYTHON_INSTALL_DIR" = "{clone}/.uv/python" ] && echo .uv/python/python'
    )
    uv = write(clone / "uv", _UV.format(find=find, install="mkdir -p .uv/python && cp model .uv/python/python"))
    interpreter(clone / "bin/python3", "3.9.2", uv=uv)
    done = bootstrap(clone)
    assert "with .uv/python/python, Python 3.12.9" in done.stderr


@pytest.mark.parametrize("no_pip", [True, False])
def test_where_all_fail_one_line_says_what_to_do(clone: Path, *, no_pip: bool) -> None:
    uv = write(clone / "uv", _UV.format(find="exit 2", install="exit 2"))
    interpreter(clone / "bin/python3", "3.9.2", no_pip=no_pip, uv=uv)
    done = bootstrap(clone)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert "needs Python 3.11 or later; 'python3' is Python 3.9.2." in last
    assert "make PYTHON=python3.12" in last
    assert "docs/start/install.md" in last
    assert len(done.stderr.splitlines()) == (1 if no_pip else 2)  # the other one says that uv tries


def test_without_any_python(clone: Path) -> None:
    done = bootstrap(clone)
    assert done.returncode == 1
    assert "'python3' is not there" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize(("there", "builder"), [(False, ".venv-build"), (True, ".venv")])
@pytest.mark.parametrize("target", ["wheel", "bundle", "deb"])
def test_what_is_built_needs_no_developer_s_environment(
    tmp_path: Path, target: str, there: bool, builder: str
) -> None:
    shutil.copy(_SCRIPT.parents[1] / "Makefile", tmp_path)
    for name in ("pyproject.toml", "constraints.txt", "scripts/bootstrap"):
        write(tmp_path / name, "")
    if there:
        write(tmp_path / ".venv/.installed", "")
    done = subprocess.run(["make", "-n", target], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert ("scripts/bootstrap python3 .venv-build small" in done.stdout) is not there
    assert "scripts/bootstrap python3 .venv\n" not in done.stdout
    assert f"{builder}/bin/python" in done.stdout
