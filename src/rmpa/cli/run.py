"""``rmpa run``: the Smart Resources of a file, with the agent of their module."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.output import printable
from rmpa.core.errors import ConfigError, RmpaError, StartError, UnreachableError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from rmpa.resource.declare import Resource

_log = logging.getLogger("rmpa.run")
_STARTS: Final = 20.0
"""Seconds that an agent may take until it answers."""
_ENDS: Final = 10.0
"""Seconds that it may take to say goodbye."""
EPILOG = """\
\b
The file declares one or more rmpa.resource.Resource; see docs/tutorials/resources.md.
Without --name and --master the module is named as its first resource. An agent of that name that runs already
is used; else one is started with the options behind --, and ended with the resources.

\b
Examples:
  rmpa run sonar.py                            with an agent of its own, named sonar
  rmpa run sonar.py --name nose -- --interface wlan0 --realtime
  rmpa run sonar.py --name base                on the agent base, if that runs
  rmpa run sonar.py --master http://127.0.0.1:11311    on any ROS core, without an agent
"""


@click.command(epilog=EPILOG, context_settings={"ignore_unknown_options": False})
@click.argument("file", type=click.Path(exists=True, dir_okay=False))
@click.option("--name", metavar="NAME", help="The module's name. [default: the first resource's]")
@click.option("--master", metavar="URI", help="Run on this ROS core, whosever it is; no agent is started.")
@click.option("--log-level", default="info", type=click.Choice(["debug", "info", "warning", "error"]))
@click.argument("options", nargs=-1, type=click.UNPROCESSED, metavar="[-- OPTIONS OF rmpa up]")
def run(file: str, name: str | None, master: str | None, log_level: str, options: tuple[str, ...]) -> int:
    """Run the Smart Resources of FILE as nodes of this module's own core."""
    from pathlib import Path

    from rmpa.core.log import configure_logging

    configure_logging(log_level, sys.stderr, as_json=False)
    resources = load(Path(file))
    if master is not None:
        if options:
            raise ConfigError("--", "options of an agent, but --master starts none", "leave one of them out")
        return asyncio.run(_run(resources, master, None))
    with module_agent(name or resources[0].name, options) as (uri, process):
        return asyncio.run(_run(resources, uri, process))


def load(path: Path) -> list[Resource]:
    """The resources that a Python file declares, in order.

    Raises:
        ConfigError: It cannot be run, declares none, or two of one name.
    """
    import runpy

    from rmpa.resource.declare import Resource

    sys.path.insert(0, str(path.resolve().parent))
    try:
        names = runpy.run_path(str(path), run_name="__rmpa__")
    except RmpaError as error:
        raise ConfigError(str(path), str(error), "", path, _line_in(path, error)) from error
    except (Exception, SystemExit) as error:
        what = f"{type(error).__name__}: {error}"
        raise ConfigError("the file", f"it cannot be run: {what}", "", path, _line_in(path, error)) from error
    found: list[Resource] = []
    for value in names.values():
        if isinstance(value, Resource) and value not in found:
            found.append(value)
    if not found:
        raise ConfigError(
            "the file", "it declares no resource", 'sonar = Resource("sonar", role="sensing") is one', path
        )
    seen: set[str] = set()
    for resource in found:
        if resource.name in seen:
            raise ConfigError(f"resource {resource.name}", "there are two of this name", "rename one of them", path)
        seen.add(resource.name)
    return found


def _line_in(path: Path, error: BaseException) -> int | None:
    """The line of the user's file at which something was raised."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return error.lineno
    line = None
    trace = error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == str(path):
            line = trace.tb_lineno
        trace = trace.tb_next
    return line


@contextlib.contextmanager
def module_agent(name: str, options: Sequence[str]) -> Iterator[tuple[str, subprocess.Popen[bytes] | None]]:
    """The core's URI of the agent ``name``, which is started (and ended) unless it runs.

    Yields:
        The URI, and the agent's process if it is ours.

    Raises:
        StartError: It does not start.
        ConfigError: It runs already, so that options for it come too late.
    """
    uri = _core_of(name)
    if uri is not None:
        if options:
            text = f"an agent {name} runs already; its options were given when it was started"
            raise ConfigError("--", text, "leave them out, or choose another --name")
        _log.info("= using the agent %s, %s", name, uri)
        yield uri, None
        return
    command = [sys.executable, "-m", "rmpa.cli.main", "up", "--name", name, *options]
    # A session of its own: Ctrl-C is ours, and the agent ends when the resources have ended.
    process = subprocess.Popen(command, start_new_session=True)  # noqa: S603 - our own program
    try:
        yield _wait_for(name, process), process
    finally:
        _end(process)


def _wait_for(name: str, process: subprocess.Popen[bytes]) -> str:
    deadline = time.monotonic() + _STARTS
    while (uri := _core_of(name)) is None:
        if process.poll() is not None:
            text = f"it ended with code {process.returncode}"
            raise StartError(f"agent {name}", text, "what it said stands above")
        if time.monotonic() > deadline:
            raise StartError(f"agent {name}", f"it does not answer after {_STARTS:g} s", "what it said stands above")
        time.sleep(0.02)
    return uri


def _core_of(name: str) -> str | None:
    """The core's URI of a running agent, or ``None``."""
    from rmpa.monitor.aio.control_client import ControlClient, find_agents

    for found in find_agents(os.environ):
        if found.name == name:
            try:
                with ControlClient(found.path) as client:
                    return client.snapshot().agent.core_uri
            except (UnreachableError, RmpaError):
                return None
    return None


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_ENDS)
        except subprocess.TimeoutExpired:
            process.kill()
    process.wait()


async def _run(resources: list[Resource], uri: str, process: subprocess.Popen[bytes] | None) -> int:
    from rmpa.resource.aio.member import run_all

    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    died = asyncio.create_task(_watch(process, stop)) if process is not None else None

    def ready() -> None:
        _log.info("= %s: active on %s", ", ".join(printable(r.name) for r in resources), uri)

    try:
        await run_all(resources, uri, stop, ready)
    finally:
        if died is not None:
            died.cancel()
            await asyncio.wait([died])
    if process is not None and process.poll() is not None:
        raise StartError("the module's agent", f"it ended with code {process.returncode}", "its log says why")
    return 0


async def _watch(process: subprocess.Popen[bytes], stop: asyncio.Event) -> None:
    """End with the agent: a resource without its core serves nobody."""
    while process.poll() is None:  # noqa: ASYNC110 - the kernel's event is SIGCHLD, which is the interpreter's own
        await asyncio.sleep(0.25)
    stop.set()
