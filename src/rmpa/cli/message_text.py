"""Messages as text: the YAML-like form and the CSV form of ``rostopic echo``, and single fields of a message."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from rmpa.cli.output import printable
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.ros.types.messages import Plain

_PART: Final = re.compile(r"(?P<name>\w+)(?P<indices>(?:\[[0-9]+\])*)", re.ASCII)
_TIME: Final = {"secs", "nsecs"}


def pick(plain: Plain, path: list[str]) -> Plain:
    """Return one field of a message.

    Args:
        plain: The message.
        path: Names from the outside in, each perhaps with indices: ``["pose", "covariance[0]"]``.

    Raises:
        RmpaError: There is no such field or element.
    """
    for part in path:
        match = _PART.fullmatch(part)
        if match is None:
            raise RmpaError(f"{part!r} is not a field; one looks like name or name[0]")
        if not isinstance(plain, dict) or match["name"] not in plain:
            known = ", ".join(plain) if isinstance(plain, dict) else "none"
            raise RmpaError(f"no field {match['name']!r} in the message; it has {known}")
        plain = plain[match["name"]]
        for index in re.findall(r"[0-9]+", match["indices"]):
            if not isinstance(plain, list) or int(index) >= len(plain):
                raise RmpaError(f"no element {index} in {match['name']!r}")
            plain = plain[int(index)]
    return plain


def shorten(plain: Plain, *, arrays: bool, strings: bool) -> Plain:
    """A copy of a message in which a note of the length replaces each array, and each string, if wanted."""
    if isinstance(plain, dict):
        return {name: shorten(value, arrays=arrays, strings=strings) for name, value in plain.items()}
    if isinstance(plain, list):
        if arrays:
            return _Note(f"<array length: {len(plain)}>")
        return [shorten(value, arrays=arrays, strings=strings) for value in plain]
    if isinstance(plain, str) and strings:
        return _Note(f"<string length: {len(plain)}>")
    return plain


class _Note(str):
    """A text in place of a value, printed without quotes."""

    __slots__ = ()


def to_text(plain: Plain, indent: str = "") -> str:
    """A message in the format of ``rostopic echo``, with control characters escaped."""
    if isinstance(plain, dict):
        return "\n".join(_field(name, value, indent) for name, value in plain.items())
    if isinstance(plain, list):
        return indent + _scalar_list(plain)
    return indent + _scalar(plain)


def _field(name: str, value: Plain, indent: str) -> str:
    if isinstance(value, dict):
        return f"{indent}{name}:" + ("\n" + to_text(value, indent + "  ") if value else " {}")
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return f"{indent}{name}:\n" + "\n".join(f"{indent}  -\n{to_text(item, indent + '    ')}" for item in value)
    return f"{indent}{name}: {_scalar_list(value) if isinstance(value, list) else _scalar(value)}"


def _scalar_list(values: list[Plain]) -> str:
    if any(isinstance(value, dict) for value in values):
        return "\n".join(f"-\n{to_text(value, '  ')}" for value in values)
    return f"[{', '.join(map(_scalar, values))}]"


def _scalar(value: Plain) -> str:
    if isinstance(value, _Note):
        return str(value)
    if isinstance(value, str):
        escaped = "\n".join(printable(line) for line in value.replace("\\", "\\\\").replace('"', '\\"').split("\n"))
        return f'"{escaped}"' if "\n" not in value else '"' + escaped.replace("\n", "\\n") + '"'
    return str(value)


def flatten(plain: Plain, name: str = "field") -> Iterator[tuple[str, str]]:
    """Columns and cells in the format of ``rostopic echo -p``: times in nanoseconds, elements of arrays numbered."""
    if isinstance(plain, dict) and plain.keys() == _TIME:
        secs, nsecs = plain["secs"], plain["nsecs"]
        assert isinstance(secs, int)  # noqa: S101 - as to_plain makes them
        assert isinstance(nsecs, int)  # noqa: S101 - likewise
        yield name, str(secs * 1_000_000_000 + nsecs)
    elif isinstance(plain, dict):
        for field, value in plain.items():
            yield from flatten(value, f"{name}.{field}")
    elif isinstance(plain, list):
        for index, value in enumerate(plain):
            yield from flatten(value, f"{name}{index}")
    else:
        text = str(int(plain)) if isinstance(plain, bool) else str(plain)
        yield name, printable(text) if isinstance(plain, str) else text
