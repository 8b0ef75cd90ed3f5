"""``rmpa run``: runs the Smart Resources of a Python file, with the agent of their module."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import logging
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn, Self

import click

from rmpa.cli.main import verb
from rmpa.cli.options import argument, flag, option
from rmpa.cli.output import print_error, printable
from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.runtime import limits
from rmpa.runtime.interpreter import own_command

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import FrameType

    from rmpa.resource.declare import Parameter
    from rmpa.resource.resource import Resource

_log = logging.getLogger("rmpa.run")
# Seconds that an agent may take to start.
_STARTS: Final = 20.0
# Seconds that it may take to end after SIGTERM.
_ENDS: Final = 10.0
# Seconds that a user's function may go on after its resource has ended.
_THREADS: Final = 1.0
_PR_SET_PDEATHSIG: Final = 1
# Modules of ROS that users import, beside those of messages.
_ROS_MODULES: Final = {
    "actionlib",
    "cv_bridge",
    "genpy",
    "message_filters",
    "rosgraph",
    "roslib",
    "rospkg",
    "rospy",
    "tf",
}


@verb(
    argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path)),
    option("--name", "NAME", "The module's name. [default: as rmpa up, else the first resource's]"),
    option("--master", "URI", "Run on this ROS core; no agent is started."),
    option("--set given", "[RESOURCE.]PARAMETER=VALUE", "Start with this value; repeatable.", multiple=True),
    option("--state", "DIR", "Where resources keep their state. [env: RMPA_STATE_DIR; default: ~/.local/state/rmpa]"),
    flag("--no-state", "The resources store nothing; for an empty core add -- --keep never."),
    option(
        "--log-level",
        help="Of the resources; that of the agent comes after --. [default: info]",
        default="info",
        type=click.Choice(["debug", "info", "warning", "error"]),
    ),
    argument("options", nargs=-1, type=click.UNPROCESSED, metavar="[-- OPTIONS OF rmpa up]"),
    context_settings={"ignore_unknown_options": False},
)
def run(
    file: Path,
    name: str | None,
    master: str | None,
    given: tuple[str, ...],
    state: str | None,
    no_state: bool,
    log_level: str,
    options: tuple[str, ...],
) -> int:
    """Run the Smart Resources of FILE as nodes of this module's own core.

    ---
    The file declares one or more rmpa.resource.Resource; see docs/guides/smart-resources.md#tutorial.
    Without --name and --master the module is named as for rmpa up, or else as its first resource. An agent of that
    name that runs already is used, and stays; else one is started with the options after --, and ends with the
    resources. An exception in a task, a profile or a hook is logged, and ends neither of them. A second Ctrl-C ends
    at once.

    Exit codes: 0 ended in order; 1 the agent or a resource could not start, the agent ended, or a function of the
    file did not return at the end; 2 a mistake in the file or in an option; 130 interrupted before it ran, or twice.

    Examples:
      rmpa run sonar.py                            with an agent of its own, named sonar
      rmpa run sonar.py --name nose -- --interface wlan0 --realtime
      rmpa run sonar.py --name base                on the agent base, if that runs
      rmpa run sonar.py --set cone=0.2             with another value of a parameter
      rmpa run sonar.py --master http://127.0.0.1:11311    on any ROS core, without an agent
    """
    from rmpa.core.log import configure_logging

    gc.disable()  # imports leave no garbage; collection is on again when the resources are active
    configure_logging(log_level, sys.stderr, as_json=False)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)

    def state_of(module: str) -> Path | None:
        return None if no_state else _state_dir(module, state)

    if master is not None:
        if options:
            raise ConfigError("--", "options of an agent, but --master starts none", "leave one of them out")
        resources = prepared(file, given)
        return asyncio.run(_run(resources, master, None, state_of(name or resources[0].name)))
    module = name or _module_name(options)
    resources = prepared(file, given) if not module else []
    with ModuleAgent(module or resources[0].name, options) as agent:
        if not resources:  # the agent starts meanwhile
            resources = prepared(file, given)
        return asyncio.run(_run(resources, agent.core(), agent, state_of(agent.name)))


def _module_name(options: Sequence[str]) -> str:
    """The module's name as ``rmpa up`` would have it, but for the host's; empty: the first resource names it."""
    from rmpa.config.module_name import NameSource, choose_name
    from rmpa.config.read import load_settings

    file = next((after for before, after in pairwise(options) if before == "--config"), None)
    chosen = choose_name(load_settings({"config": file}, os.environ, host_name="").names)
    return "" if chosen.source is NameSource.DEFAULT else chosen.name


def prepared(path: Path, given: Sequence[str] = ()) -> list[Resource]:
    """Load the resources of a file, set the given parameters, and import and compile all that they need.

    Raises:
        ConfigError: The file cannot be run, or a parameter cannot have its value.
    """
    import rmpa.resource.node  # noqa: F401 - the first import takes long

    resources = load(path)
    for text in given:
        _set(resources, text)
    for resource in resources:
        kinds = [topic.known for topics in (resource.outputs, resource.inputs) for topic in topics.values()]
        for kind in kinds:
            if kind is not None:
                kind.deserialize(kind.serialize(kind.make()))
    return resources


def load(path: Path) -> list[Resource]:
    """The resources that a file declares, in order: one in TOML, or those of a Python file, which is run.

    Raises:
        ConfigError: It cannot be run, declares none, two of one name, or one without a profile.
    """
    import runpy

    if path.suffix == ".toml":
        from rmpa.resource.description import read_description

        described = read_description(path.read_bytes(), path)
        described.folder = path.resolve().parent
        return [described]

    from rmpa.resource.resource import Resource

    sys.path.insert(0, str(path.resolve().parent))
    try:
        names = runpy.run_path(str(path), run_name="__rmpa__")
    except RmpaError as error:
        cause = error if isinstance(error, ConfigError) else ConfigError("the file", str(error))
        raise ConfigError(cause.source, cause.problem, cause.remedy, path, _line_in(path, error)) from error
    except (Exception, SystemExit) as error:
        what = f"{type(error).__name__}: {error}"
        remedy = _instead_of_ros(error)
        raise ConfigError("the file", f"it cannot be run: {what}", remedy, path, _line_in(path, error)) from error
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
        resource.file = path.name
        resource.folder = path.resolve().parent
        if not resource.profiles:
            remedy = "declare one: @NAME.profile(offers={…})"
            raise ConfigError(f"resource {resource.name}", "it has no System Profile", remedy, path)
    return found


def _instead_of_ros(error: BaseException) -> str:
    """What to do where a module of ROS was not found, which the system's Python alone has; else nothing."""
    missing = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    if missing not in _ROS_MODULES and not missing.endswith(("_msgs", "_srvs")):
        return ""
    return (
        "a resource needs no module of ROS: it names types as text, 'std_msgs/String'. A node that does runs beside "
        f"rmpa up, by the system's Python (python3 FILE); this is {sys.executable}"
    )


def _line_in(path: Path, error: BaseException) -> int | None:
    """The line of the user's file at which an exception was raised."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return error.lineno
    frames = traceback.extract_tb(error.__traceback__)
    return next((frame.lineno for frame in reversed(frames) if frame.filename == str(path)), None)


def _set(resources: Sequence[Resource], text: str) -> None:
    """Set the initial value of a parameter, ``[RESOURCE.]PARAMETER=VALUE``.

    Raises:
        ConfigError: There is no such parameter, there are several, or the value does not fit.
    """
    from rmpa.cli.graph import suggestion

    key, equals, value = text.partition("=")
    if not equals:
        raise ConfigError("--set", f"{text!r} gives no value", "for example --set cone=0.2")
    known = {f"{r.name}.{p.name}": p for r in resources for p in r.parameters.values()}
    fits = [name for name in known if key in (name, name.partition(".")[2])]
    if len(fits) != 1:
        if fits:
            raise ConfigError("--set", f"{key} is a parameter of several resources", f"say {' or '.join(fits)}")
        names = [*known, *(name.partition(".")[2] for name in known)]
        remedy = suggestion(key, names, f"there are {', '.join(known) or 'none'}")
        raise ConfigError("--set", f"there is no parameter {key}", remedy)
    known[fits[0]].value = _read(known[fits[0]], value)
    known[fits[0]].given = True


def _read(parameter: Parameter, text: str) -> bool | int | float | str:
    """Convert a text to the parameter's type."""
    is_bool = isinstance(parameter.default, bool)
    words = {"true": True, "false": False, "1": True, "0": False}
    try:
        return words[text.lower()] if is_bool else type(parameter.default)(text)
    except (KeyError, ValueError):
        what = "bool" if is_bool else parameter.type
        example = "true or false" if is_bool else f"for example {parameter.default!r}"
        raise ConfigError(f"parameter {parameter.name}", f"{text!r} is no {what}", example) from None


class ModuleAgent:
    """The agent of a module: one that runs already, or a child process for as long as the ``with`` lasts.

    A child ends with this process in any case: if this process is killed, the kernel sends SIGTERM to the child.

    Args:
        name: The module's name.
        options: Options of ``rmpa up`` for a child.

    Raises:
        ConfigError: The agent runs already, and options are given.
    """

    def __init__(self, name: str, options: Sequence[str]) -> None:
        self.name = name
        # The child, if one was started.
        self.process: subprocess.Popen[bytes] | None = None
        self._uri = _core_of(name)
        self._options = options

    def __enter__(self) -> Self:
        if self._uri is not None:
            if self._options:
                text = f"an agent {self.name} runs already; its options were given when it was started"
                raise ConfigError("--", text, "leave them out, or choose another --name")
            _log.info("= using the agent %s, %s", self.name, self._uri)
            return self
        command = own_command("up", *self._options)
        environ = {**os.environ, "RMPA_NAME": self.name}  # not --name: a file's resources do not name the machine
        libc, us = ctypes.CDLL(None), os.getpid()

        def tie() -> None:
            libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
            if os.getppid() != us:
                os._exit(1)

        # In a session of its own Ctrl-C does not reach the agent: it ends after the resources.
        self.process = subprocess.Popen(command, start_new_session=True, preexec_fn=tie, env=environ)  # noqa: S603, PLW1509
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def core(self) -> str:
        """Wait until the agent answers; return the URI of its core.

        Raises:
            StartError: It ended, or does not answer in time.
        """
        deadline = time.monotonic() + _STARTS
        while self._uri is None:
            text = f"it does not answer after {_STARTS:g} s" if time.monotonic() > deadline else ""
            if self.process is not None and self.process.poll() is not None:
                text = f"it ended with code {self.process.returncode}"
            if text:
                raise StartError(f"agent {self.name}", text, "see its lines above")
            time.sleep(0.02)
            self._uri = _core_of(self.name)
        return self._uri

    def end(self) -> None:
        """End the child, if there is one: by SIGTERM, so that it says goodbye to its peers."""
        if self.process is None or self.process.poll() is not None:
            return
        self.process.terminate()
        try:
            self.process.wait(_ENDS)
        except BaseException as error:
            self.process.kill()  # it hangs, or the user pressed Ctrl-C again
            self.process.wait()
            if not isinstance(error, subprocess.TimeoutExpired):
                raise


def _core_of(name: str) -> str | None:
    """The URI of the core of a running agent, or ``None``."""
    from rmpa.observe.control_client import ControlClient, find_agents

    for found in find_agents(os.environ):
        if found.name == name:
            with contextlib.suppress(RmpaError), ControlClient(found.path) as client:
                return client.agent().core_uri
    return None


def _state_dir(module: str, state: str | None) -> Path | None:
    """The directory in which the resources of a module store their state; ``None`` without a home directory."""
    from rmpa.config.module_name import module_dir, state_dir

    directory = state_dir(os.environ, state)
    if directory is None:
        _log.warning(
            "! there is no home directory to keep state in; set RMPA_STATE_DIR, or --no-state [no-state-directory]"
        )
        return None
    return module_dir(directory, module)


async def _run(resources: list[Resource], uri: str, agent: ModuleAgent | None, stores: Path | None = None) -> int:
    from rmpa.resource.node import run_all
    from rmpa.runtime.accept import raise_file_limit
    from rmpa.runtime.tasks import end_tasks, start_task

    raise_file_limit()
    sys.setswitchinterval(limits.THREAD_SWITCH)  # so that a due task interrupts the event loop's work
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    threads = ThreadPoolExecutor(thread_name_prefix="profile or hook")
    loop.set_default_executor(threads)

    def on_signal(number: int) -> None:
        if stop.is_set():
            _log.warning("! second signal: ending at once [ending-slowly]")
            _leave(128 + number)
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, on_signal, number)
    process = agent.process if agent is not None else None
    died = start_task(_watch(process, stop), "watch the agent") if process is not None else None

    def ready() -> None:
        gc.freeze()  # a full collection then skips what was loaded until now
        gc.enable()
        _log.info("= %s: active on %s", ", ".join(printable(r.name) for r in resources), uri)

    failure: RmpaError | None = None
    try:
        await run_all(resources, uri, stop, ready, stores)
    except RmpaError as error:
        failure = error
    finally:
        await end_tasks(died)
    if failure is None and process is not None and process.poll() is not None:
        failure = StartError("the module's agent", f"it ended with code {process.returncode}", "its log says why")
    threads.shutdown(wait=False, cancel_futures=True)
    if left := await _left_behind():
        _log.warning("! %s does not return; the program ends without it [ending-slowly]", ", ".join(left))
        if failure is not None:
            print_error(failure, failure.code)
        if agent is not None:
            agent.end()
        _leave(1)
    if failure is not None:
        raise failure
    _log.info("= %s: ended", ", ".join(printable(r.name) for r in resources))
    return 0


async def _watch(process: subprocess.Popen[bytes], stop: asyncio.Event) -> None:
    """Set ``stop`` when the agent's process ends: a resource without a core has no clients."""
    while process.poll() is None:  # noqa: ASYNC110 - the kernel's event would be SIGCHLD, which asyncio's child watcher owns
        await asyncio.sleep(0.25)
    stop.set()


async def _left_behind() -> list[str]:
    """Names of the threads in which user's functions hang: the interpreter would wait for them at its exit."""
    loop = asyncio.get_running_loop()
    deadline = loop.time() + _THREADS
    while True:
        alive = [t.name for t in threading.enumerate() if t is not threading.main_thread() and not t.daemon]
        if not alive or loop.time() > deadline:
            return alive
        await asyncio.sleep(0.02)


def _leave(code: int) -> NoReturn:
    """Exit now, whatever threads run; the kernel ends a child agent."""
    logging.shutdown()
    sys.stdout.flush()
    os._exit(code)


def _interrupt(number: int, _frame: FrameType | None) -> NoReturn:
    """Handle a signal before there is a loop: unwind as at Ctrl-C, which ends a child agent."""
    raise KeyboardInterrupt(number)
