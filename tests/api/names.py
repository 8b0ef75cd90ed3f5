"""The Python API as text, a line for each name and method; ``python -m tests.api.names`` writes ``names.txt``."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import Final

import msgspec

MODULES: Final = ("rmpa", "rmpa.client", "rmpa.resource")
# What ``with``, ``async with`` and ``async for`` call.
_SPECIAL: Final = {"__aenter__", "__aiter__", "__enter__"}
# What a node and its publishers, subscribers and services call of each other.
_INSIDE: Final = {
    *("ended", "first_subscriber", "join", "key", "last_subscriber", "listeners_changed", "mismatch"),
    *("register", "remove", "request", "serve", "withdraw"),
}
# Classes whose objects others make.
_MADE: Final = {"Publisher", "Received", "Service", "ServiceClient", "Subscriber", "SyncNode", "SyncPublisher"}
_OURS: Final = r"rmpa\.[a-z._]+\."
GOLDEN: Final = Path(__file__).with_name("names.txt")


def described() -> str:
    """All of it."""
    done: set[str] = set()
    return "\n".join(line for name in MODULES for line in _module(importlib.import_module(name), done)) + "\n"


def _module(module: ModuleType, done: set[str]) -> Iterator[str]:
    for name in sorted(module.__all__):
        value = getattr(module, name)
        yield f"{module.__name__}.{name}{_text(value)}"
        if inspect.isclass(value) and name not in done and not issubclass(value, BaseException | Enum):
            done.add(name)
            yield from sorted(f"{module.__name__}.{name}.{member}" for member in _members(value))


def _members(kind: type) -> Iterator[str]:
    if issubclass(kind, msgspec.Struct):
        for field in msgspec.structs.fields(kind):
            plain = field.type.__origin__ if hasattr(field.type, "__metadata__") else field.type
            yield f"{field.name}: {re.sub(_OURS, '', inspect.formatannotation(plain))}"
        return
    for name in dir(kind):
        found = inspect.getattr_static(kind, name)
        public = name in _SPECIAL or not (name.startswith("_") or name in _INSIDE)
        if public and hasattr(found, "__get__") and not inspect.ismemberdescriptor(found):
            yield f"{name}{_text(getattr(kind, name, found))}"


def _text(value: object) -> str:
    if inspect.isclass(value) and issubclass(value, Enum):
        return f": {', '.join(member.name for member in value)}"
    if inspect.isclass(value) and issubclass(value, msgspec.Struct):
        return ""
    if inspect.isclass(value) and issubclass(value, BaseException):
        return f"({', '.join(base.__name__ for base in value.__bases__)})"
    if callable(value) and getattr(value, "__name__", "") not in _MADE:
        text = re.sub(r"<object object at \w+>", "...", str(inspect.signature(value)))
        return re.sub(r"''|'(.+?)'", lambda found: found[1] or found[0], text)
    return ""


if __name__ == "__main__":
    GOLDEN.write_text(described(), encoding="utf-8")
