"""The types of the API as other people's checkers see them: at an installed wheel, not in this repository."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).parents[2]
CONSUMER: Final = Path(__file__).parent / "consumer"
# Mistakes that a checker has to find: it could not if the package had no types for it.
WRONG: Final = """
import rmpa
from rmpa.client import AgentClient
import rmpa.nothing

async def main() -> None:
    async with rmpa.Node("talker") as node:
        publisher = await node.advertise("/chatter", 7)
        publisher.publsh(data="hello")
    with rmpa.connect("listener") as one:
        text: str = one.has_param("/gain")
    async with AgentClient(name=3) as agent:
        (await agent.snapshot()).peer
    rmpa.Nod
"""
MISTAKES: Final = (4, 8, 9, 11, 12, 13, 14)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment in which the wheel is installed, and what it depends on."""
    place = tmp_path_factory.mktemp("typing")
    tree = place / "clone"
    shutil.copytree(ROOT / "src" / "rmpa", tree / "src" / "rmpa", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE", "scripts/version"):
        (tree / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tree / name)
    command = ["setup.py", "-q", "bdist_wheel", "-d", str(place)]
    built = subprocess.run([sys.executable, *command], cwd=tree, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    (wheel,) = place.glob("*.whl")
    venv.create(place / "env")
    folder = f"python{sys.version_info.major}.{sys.version_info.minor}"
    packages = place / "env" / "lib" / folder / "site-packages"
    shutil.unpack_archive(wheel, packages, "zip")
    (packages / "needed.pth").write_text(sysconfig.get_path("purelib"))
    shutil.copytree(CONSUMER, place / "consumer")
    (place / "consumer" / "wrong.py").write_text(WRONG)
    return place


def check(installed: Path, *command: str) -> str:
    """What a checker says of the right program and of the wrong one."""
    place = installed / "consumer"
    done = subprocess.run([sys.executable, "-m", *command], cwd=place, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def mistakes(said: str) -> list[tuple[str, int]]:
    """The file and line of each."""
    return sorted({(file, int(line)) for file, line in re.findall(r"(\w+\.py):(\d+):.*?(?:error|warning):", said)})


@pytest.mark.timeout(240)
def test_mypy_strict_finds_each_type_and_each_mistake(installed: Path) -> None:
    command = ["mypy", "--strict", f"--python-executable={installed / 'env/bin/python'}"]
    command += ["--config-file=", f"--cache-dir={installed / 'cache'}"]
    said = check(installed, *command, "program.py", "wrong.py")
    assert mistakes(said) == [("wrong.py", line) for line in MISTAKES], said


@pytest.mark.timeout(240)
def test_pyright_does_too(installed: Path) -> None:
    if shutil.which("node") is None:
        pytest.skip("pyright needs node, which is not here")
    if not re.search(r"pyright \d", check(installed, "pyright", "--version")):
        pytest.skip("pyright is not here (pip install pyright; it fetches its program from npm once)")
    settings = '{"typeCheckingMode": "strict", "reportUnknownLambdaType": false, "reportUnknownMemberType": false}'
    (installed / "consumer" / "pyrightconfig.json").write_text(settings)
    python = f"--pythonpath={installed / 'env/bin/python'}"
    said = check(installed, "pyright", python, "program.py", "wrong.py")
    assert mistakes(said) == [("wrong.py", line) for line in MISTAKES], said
