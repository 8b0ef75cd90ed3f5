"""One name, one thing: no two public classes of ``src`` have one name."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import rmpa


def test_no_two_public_classes_have_one_name() -> None:
    source = Path(rmpa.__path__[0])
    places: defaultdict[str, list[str]] = defaultdict(list)
    for path in sorted(source.rglob("*.py")):
        for item in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(item, ast.ClassDef) and not item.name.startswith("_"):
                places[item.name].append(str(path.relative_to(source)))
    assert {name: files for name, files in places.items() if len(files) > 1} == {}
