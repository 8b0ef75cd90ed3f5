"""Fuzz target: files that describe a Smart Resource, and the mistakes that authors of them make."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from rmpa.core.errors import ConfigError
from rmpa.resource.description import read_description

ROOT: Final = Path(__file__).parents[2]
# The one with every key first.
FILES: Final = (
    ROOT / "tests/resource/robot.resource.toml",
    *sorted((ROOT / "examples/resources").glob("*.resource.toml")),
)
SEEDS: Final = [path.read_bytes() for path in FILES]
# Seconds in which a file of any size is refused.
QUICK: Final = 1.0
_VALUES: Final = (
    "[]", "{}", "nan", "inf", "-1", "0", "1e400", '""', '"\\u0000"', "99999999999999999999", "1979-05-27", "true",
    '"30 parsecs"', '"-3 Hz"', '"/a//b"', '"~"', '"("', '"cpu("', '["a", 1]', "{ a = {} }", '"\U0001f916"',
    "[[[[1]]]]",
    '"/a == 1 and"', '">= 5 Hz hard hard"', '"no/Type"', '"std_msgs/Nothing"', '"' + "x" * 5000 + '"',
    '"' + "(" * 200 + '"', "{ rate = 3, rate_ = 4 }", "[" * 60 + "]" * 60, '{ "" = 1 }', "1.5", "'''\n'''",
)  # fmt: skip


def fuzz(data: bytes) -> None:
    """A resource, or a ConfigError that names a line of the file, within a second."""
    refused(data)


def refused(data: bytes) -> ConfigError | None:
    """Why a file is refused; ``None``: it is a resource."""
    begin = time.process_time()
    error = None
    try:
        read_description(data, Path("robot.resource.toml"))
    except ConfigError as found:
        error = found
        if error.line is None or not 1 <= error.line <= data.count(b"\n") + 1:
            raise AssertionError(f"line {error.line} is not in the file") from error
        if not error.problem or not error.source or error.path is None:
            raise AssertionError(f"it does not say what is wrong: {error!r}") from error
    if (took := time.process_time() - begin) > QUICK:
        raise AssertionError(f"{took:.1f} s for {len(data)} bytes: {error}")
    return error


def mistaken(rng: random.Random, text: str) -> str:
    """The text of a file with one to three mistakes of an author."""
    lines = text.split("\n")
    for _ in range(rng.randint(1, 3)):
        rng.choice(_MISTAKES)(rng, lines)
    return "\n".join(lines)


def _some(rng: random.Random, lines: list[str], sign: str) -> int:
    found = [number for number, line in enumerate(lines) if sign in line and line[0] != "#"]
    return rng.choice(found) if found else 0


def _key(rng: random.Random, lines: list[str]) -> None:
    at = _some(rng, lines, " = ")
    key, _, value = lines[at].partition(" = ")
    place = rng.randrange(len(key) + 1)
    lines[at] = f"{key[:place]}{rng.choice('xq_.-')}{key[place + rng.randint(0, 1) :]} = {value}"


def _value(rng: random.Random, lines: list[str]) -> None:
    at = _some(rng, lines, " = ")
    lines[at] = f"{lines[at].partition(' = ')[0]} = {rng.choice(_VALUES)}"


def _unit(rng: random.Random, lines: list[str]) -> None:
    at = _some(rng, lines, '"')
    for unit in (' Hz"', ' s"', ' ms"', ' K"'):
        lines[at] = lines[at].replace(unit, rng.choice((' hz"', ' m"', ' Hz Hz"', '"', ' s"')))


def _header(rng: random.Random, lines: list[str]) -> None:
    at = _some(rng, lines, "[")
    lines[at] = rng.choice(
        (
            "[profle.a]",
            "[profile]",
            "[[profile.a]]",
            "[a.b.c.d]",
            "[]",
            "[profile.'']",
            '[output."/x y"]',
            "[start.now]",
        )
    )


def _move(rng: random.Random, lines: list[str]) -> None:
    lines.insert(rng.randrange(len(lines)), lines.pop(rng.randrange(len(lines))))


def _remove(rng: random.Random, lines: list[str]) -> None:
    at = rng.randrange(len(lines))
    del lines[at : at + rng.choice((1, 1, 3, 30))]
    lines.append("")


def _repeat(rng: random.Random, lines: list[str]) -> None:
    at = rng.randrange(len(lines))
    lines[at:at] = lines[at : at + rng.randint(1, 8)]


def _truncate(rng: random.Random, lines: list[str]) -> None:
    at = rng.randrange(len(lines))
    lines[at:] = [lines[at][: rng.randrange(len(lines[at]) + 1)]]


def _many(rng: random.Random, lines: list[str]) -> None:
    kind = rng.choice(("output", "parameter", "profile", "context", "alarm", "ask"))
    keys = {
        "output": 'topic = "/t{}"\ntype = "std_msgs/String"',
        "parameter": "default = {}",
        "profile": "offers = {{ }}",
        "context": 'when = "true"',
        "alarm": 'when = "false"',
        "ask": 'rate = ">= 1 Hz"',
    }[kind]
    for number in range(rng.choice((10, 300, 3000))):
        lines += [f"[{kind}.n{number}]", *keys.format(number).split("\n")]


def _deep(rng: random.Random, lines: list[str]) -> None:
    depth = rng.choice((100, 3000))
    lines.insert(0, rng.choice(("x = " + "[" * depth, "x" + ".x" * depth + " = 1", "x = " + "{a = " * depth)))


_MISTAKES: Final[tuple[Callable[[random.Random, list[str]], None], ...]] = (
    *(_key, _value, _unit) * 6,
    *(_header, _move, _remove, _repeat, _truncate) * 3,
    _many,
    _deep,
)
