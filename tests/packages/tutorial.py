"""A page for people who sit before several machines, read as they read it: what is typed where, and what is shown.

A table headed by the machines' names has a column of commands for each; in a block the prompt names the machine,
and a bare ``$`` means all. The reader's hands are comments: ``<!-- ctrl-c: rmpa topic -->`` (Ctrl-C in the terminals
in which such a command runs), ``<!-- cable: robot2 out -->``, ``<!-- browser -->``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

# Words a minute, of one who reads in a second language.
READING: Final = 200.0
# Seconds to copy a command into the terminal where it belongs, or to type a short one.
COPYING: Final = 5.0
_PART: Final = re.compile(
    r"^```(?P<kind>\w+)\n(?P<block>.*?)^```$|^<!-- (?P<hand>ctrl-c|cable|browser)(?:: (?P<what>[^>]*))? -->$|"
    r"^\|(?P<head>(?: \w+ \|)+)\n\|[-|]+\n(?P<rows>(?:\|[^\n]*\|\n)+)",
    re.MULTILINE | re.DOTALL,
)
_COMMAND: Final = re.compile(r"^(\w*)\$ (.*)\n((?:(?!\w*\$ ).*\n)*)", re.MULTILINE)
_NUMBER: Final = re.compile(r"\d+(?:\.\d+)?(?: (?:µs|ms|s|min|h))?")


@dataclass
class Step:
    """What the reader does.

    Args:
        machines: Where.
        command: What is typed; for a hand of the reader, its name.
        shown: What the page shows then.
        hand: Whether it is no command, but ``ctrl-c``, ``cable`` or ``browser``, with ``shown`` as its argument.
    """

    machines: tuple[str, ...]
    command: str
    shown: str = ""
    hand: bool = field(default=False, kw_only=True)


def steps(page: str, machines: tuple[str, ...]) -> list[Step]:
    """All steps of a page, in order."""
    found: list[Step] = []
    for part in _PART.finditer(page):
        if part["hand"]:
            found.append(Step((), part["hand"], part["what"] or "", hand=True))
        elif part["kind"] == "console":
            commands = _COMMAND.findall(part["block"])
            found += [Step((name,) if name else machines, line, shown) for name, line, shown in commands]
        elif part["kind"] == "text":
            found[-1].shown = part["block"]
        elif part["head"] and tuple(part["head"].replace("|", " ").split()) == machines:
            found += _columns(part["rows"], machines)
    return found


def _columns(rows: str, machines: tuple[str, ...]) -> Iterator[Step]:
    for row in rows.splitlines():
        for machine, cell in zip(machines, re.findall(r"\| (?:`([^`]*)`)? *(?=\|)", row), strict=True):
            if cell:
                yield Step((machine,), cell)


def shows(output: str, shown: str) -> bool:
    """Whether an output has what the page shows; numbers may differ, ``…`` stands for anything."""
    wanted = ".*".join(re.escape(_plain(part)) for part in shown.split("…"))
    return re.search(wanted, _plain(output), re.DOTALL) is not None


def _plain(text: str) -> str:
    return " ".join(_NUMBER.sub("N", text).split())


def reading_minutes(page: str) -> float:
    """How long a reader takes for a page without its blocks."""
    prose = re.sub(r"^```.*?^```$|<!--.*?-->", "", page, flags=re.MULTILINE | re.DOTALL)
    return len(prose.split()) / READING
