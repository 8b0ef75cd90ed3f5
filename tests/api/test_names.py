"""What the Python API exports, and that no release loses a name or changes a signature without a word."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

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
