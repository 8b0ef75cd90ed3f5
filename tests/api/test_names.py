"""Public names and their types."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path
from typing import Final

import pytest

import rmpa
from tests.api.names import GOLDEN, MODULES, described


def test_the_exported_names_and_signatures_are_those_that_are_promised() -> None:
    """After a change that CHANGELOG.md names: ``python -m tests.api.names``."""
    now, promised = (set(text.splitlines()) for text in (described(), GOLDEN.read_text(encoding="utf-8")))
    assert promised - now == set()
    field = re.compile(r"rmpa\.client\.\w+\.\w+: ")  # snapshots may get more of them
    assert {line for line in now - promised if not field.match(line)} == set()


@pytest.mark.parametrize("name", MODULES)
def test_every_exported_name_is_there_and_no_other(name: str) -> None:
    module = importlib.import_module(name)
    assert set(module.__all__) <= set(dir(module)) | {one for one in module.__all__ if getattr(module, one, None)}
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        module.nothing  # noqa: B018


def test_the_types_of_the_package_are_those_of_its_stub() -> None:
    stub = ast.parse(Path(rmpa.__file__ or "").with_suffix(".pyi").read_text(encoding="utf-8"))
    names = {
        alias.name: item.module for item in stub.body if isinstance(item, ast.ImportFrom) for alias in item.names
    }
    assert names == rmpa.__dict__["_LAZY"]
    (exported,) = (ast.literal_eval(item.value) for item in stub.body if isinstance(item, ast.Assign))
    assert exported == rmpa.__all__


def test_the_page_has_every_class_and_function() -> None:
    page = (Path(__file__).parents[2] / "docs/reference/python.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"^::: (\S+)$", page, re.MULTILINE))
    assert shown >= set(MODULES) - {"rmpa"}
    classes = {name for name in rmpa.__all__ if inspect.isclass(getattr(rmpa, name))}
    errors = {name for name in classes if issubclass(getattr(rmpa, name), BaseException)}
    assert set(re.findall(r"^\| `([A-Z]\w+)` \|", page, re.MULTILINE)) == errors - {"RmpaError"}
    names = {name for name in rmpa.__all__ if callable(getattr(rmpa, name))} - errors
    assert {name.removeprefix("rmpa.") for name in shown} - {"client", "resource"} == names


def test_importing_the_package_loads_nothing_else() -> None:
    heavy = {"asyncio", "msgspec", "typing", "importlib.util", "rmpa.sync", "rmpa.ros", "rmpa.core"}
    program = f"import sys; before = set(sys.modules); import rmpa; print({heavy} & (set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


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
