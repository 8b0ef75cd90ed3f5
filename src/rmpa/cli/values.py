"""Messages as text, as rostopic writes and reads them."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from rmpa.cli.output import printable
from rmpa.core.errors import ConfigError, RmpaError

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
            raise RmpaError(f"{part!r} is not a field; one looks like name or name[0]", code="invalid-value")
        if not isinstance(plain, dict) or match["name"] not in plain:
            known = ", ".join(plain) if isinstance(plain, dict) else "none"
            raise RmpaError(f"no field {match['name']!r} in the message; it has {known}", code="invalid-value")
        plain = plain[match["name"]]
        for index in re.findall(r"[0-9]+", match["indices"]):
            if not isinstance(plain, list) or int(index) >= len(plain):
                raise RmpaError(f"no element {index} in {match['name']!r}", code="invalid-value")
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
    return _Note(f"<string length: {len(plain)}>") if isinstance(plain, str) and strings else plain


class _Note(str):
    """A text in place of a value, printed without quotes."""

    __slots__ = ()


def to_text(plain: Plain, indent: str = "") -> str:
    """A message in the format of ``rostopic echo``, with control characters escaped."""
    if isinstance(plain, dict):
        return "\n".join(_field(name, value, indent) for name, value in plain.items())
    return indent + _scalar(plain)


def _field(name: str, value: Plain, indent: str) -> str:
    if isinstance(value, dict):
        return f"{indent}{name}:" + ("\n" + to_text(value, indent + "  ") if value else " {}")
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return f"{indent}{name}:\n" + "\n".join(f"{indent}  -\n{to_text(item, indent + '    ')}" for item in value)
    return f"{indent}{name}: {_scalar(value)}"


def _scalar(value: Plain) -> str:
    if isinstance(value, list):
        if any(isinstance(item, dict) for item in value):
            return "\n".join(f"-\n{to_text(item, '  ')}" for item in value)
        return f"[{', '.join(map(_scalar, value))}]"
    if isinstance(value, str) and not isinstance(value, _Note):
        lines = value.replace("\\", "\\\\").replace('"', '\\"').split("\n")
        return '"' + "\\n".join(map(printable, lines)) + '"'
    return str(value)


def flatten(plain: Plain, name: str = "field") -> Iterator[tuple[str, str]]:
    """Columns and cells in the format of ``rostopic echo -p``: times in nanoseconds, elements of arrays numbered."""
    if isinstance(plain, dict) and plain.keys() == _TIME:
        yield name, str(plain["secs"] * 1_000_000_000 + plain["nsecs"])  # type: ignore[operator] # both are numbers
    elif isinstance(plain, dict):
        for field, value in plain.items():
            yield from flatten(value, f"{name}.{field}")
    elif isinstance(plain, list):
        for index, value in enumerate(plain):
            yield from flatten(value, f"{name}{index}")
    else:
        yield name, printable(str(int(plain) if isinstance(plain, bool) else plain))


def read_values(texts: tuple[str, ...]) -> Plain:
    """Read a message's values from the command line: none, one YAML value, or one for each field in order.

    Raises:
        ConfigError: It is not YAML.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    values: list[Plain] = []
    for text in texts:
        try:
            values.append(YAML(typ="safe", pure=True).load(text))
        except (YAMLError, ValueError) as error:
            problem = getattr(error, "problem", None) or str(error)
            raise ConfigError("VALUES", f"not YAML: {problem}", f"in {text!r}") from None
    if len(values) == 1 and values[0] is not None:
        return values[0]
    return values or None


def fill_stamps(values: Plain, now_ns: int) -> Plain:
    """Replace ``auto`` (a header) and ``now`` (a stamp) by the time, as rostopic does."""
    secs, nsecs = divmod(now_ns, 1_000_000_000)
    stamp: dict[str, Plain] = {"secs": secs, "nsecs": nsecs}
    if isinstance(values, list):
        return [fill_stamps(value, now_ns) for value in values]
    if not isinstance(values, dict):
        return {"stamp": stamp} if values == "auto" else values
    filled: dict[str, Plain] = {}
    for name, value in values.items():
        if name == "header" and value == "auto":
            filled[name] = {"stamp": stamp}
        elif name == "stamp" and value == "now":
            filled[name] = stamp
        else:
            filled[name] = fill_stamps(value, now_ns) if isinstance(value, dict | list) else value
    return filled
