"""No two modules need each other, not even for their types: imports under ``TYPE_CHECKING`` count."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Final

import rmpa

SOURCE: Final = Path(rmpa.__path__[0])


def _module(path: Path) -> str:
    parts = ("rmpa", *path.relative_to(SOURCE).with_suffix("").parts)
    return ".".join(parts).removesuffix(".__init__")


def test_no_modules_import_each_other() -> None:
    modules = {_module(path): ast.parse(path.read_text(encoding="utf-8")) for path in SOURCE.rglob("*.py")}
    imports: dict[str, set[str]] = {name: set() for name in modules}
    for name, tree in modules.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("rmpa"):
                found = {f"{node.module}.{alias.name}" for alias in node.names} & modules.keys()
                imports[name] |= found or {node.module}
    assert sum(map(len, imports.values())) > len(modules), "too few imports were found to prove anything"
    TopologicalSorter(imports).prepare()  # raises CycleError, which names the circle
