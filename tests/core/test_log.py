"""How log lines look."""

from __future__ import annotations

import io
import json
import logging
import re
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from rmpa.core.counters import _room_of, configure_logging

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def stream() -> Iterator[io.StringIO]:
    root = logging.getLogger()
    before, level, raising = root.handlers[:], root.level, logging.raiseExceptions
    yield io.StringIO()
    root.handlers[:] = before
    root.setLevel(level)
    logging.raiseExceptions = raising


def test_rooms() -> None:
    assert [_room_of(n) for n in ("rmpa.mesh.io.mesh", "rmpa", "asyncio")] == ["mesh", "rmpa", "asyncio"]


def test_text(stream: io.StringIO) -> None:
    configure_logging("info", stream, as_json=False)
    logging.getLogger("rmpa.mesh.io.mesh").warning("! %s", "it\nis \x1b[31m")
    logging.getLogger("rmpa.mesh").debug("hidden")
    assert re.fullmatch(r"\d\d:\d\d:\d\d\.\d{3} warning mesh      ! it\\nis \\x1b\[31m\n", stream.getvalue())


def test_a_journal_gets_priorities_and_no_time(stream: io.StringIO) -> None:
    configure_logging("debug", stream, as_json=False, in_journal=True)
    log = logging.getLogger("rmpa.mesh.io.dial")
    log.debug("> a")
    log.warning("! b")
    try:
        int("x")
    except ValueError:
        log.exception("! c")
    first, second, third, *trace = stream.getvalue().splitlines()
    assert (first, second) == ("<7>debug   mesh      > a", "<4>warning mesh      ! b")
    assert third == "<3>error   mesh      ! c [internal-error]"
    assert {line[:3] for line in trace} == {"<3>"}


def test_json_with_a_traceback(stream: io.StringIO) -> None:
    configure_logging("debug", stream, as_json=True)
    try:
        int("x")
    except ValueError:
        logging.getLogger("rmpa.bridge").exception("! failed\nat it")
    (line,) = stream.getvalue().splitlines()
    record = json.loads(line)
    assert {k: record[k] for k in ("level", "room", "logger", "text")} == {
        "level": "error",
        "room": "bridge",
        "logger": "rmpa.bridge",
        "text": "! failed\nat it [internal-error]",
    }
    assert "ValueError: invalid literal" in record["traceback"]
    assert record["time"].endswith("+00:00")


def test_a_line_to_escape_is_written_without_file_descriptors() -> None:
    """The codec's module was loaded at its first use: asyncio's line about too many open files never came."""
    script = (
        "import logging, resource, sys\n"
        "from rmpa.core.counters import configure_logging\n"
        "configure_logging('info', sys.stderr, as_json=False)\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (3, 3))\n"
        "logging.error('too many\\nopen files')\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=30)
    assert r"too many\nopen files" in done.stderr
