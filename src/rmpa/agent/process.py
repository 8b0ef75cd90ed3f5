"""The process of an agent: start, end, reload of settings, and the programs that run beside it.

Limits of what an agent runs beside itself. Seconds.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import logging
import os
import select
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Self

from rmpa import __version__
from rmpa.config.settings import SETTINGS
from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.core.timers import Backoff
from rmpa.observe.control import ReloadReply
from rmpa.observe.control_client import runtime_dir
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import is_shortage, open_files_advice, raise_file_limit
from rmpa.runtime.interpreter import own_command
from rmpa.runtime.loop import AgentLoop, make_realtime, worker_pool
from rmpa.runtime.programs import ended, keep_capabilities
from rmpa.runtime.systemd import SERVICE_VARIABLES, feed_watchdog, notify_service_manager
from rmpa.runtime.tasks import end_tasks, keep_task, start_task

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
    from pathlib import Path

    from rmpa.config.read import Loaded
    from rmpa.config.settings import Settings

_log = logging.getLogger(__name__)

# Until rmpa web is started again after it ended; each further time it is twice as long.
WEB_RESTART_FIRST: Final = 0.5
# The longest such time.
WEB_RESTART_CAP: Final = 30.0
# After a run of this length the next wait is the first one again.
WEB_STEADY: Final = 60.0
# For rmpa web to end when the agent ends; then it is killed.
WEB_END_TIMEOUT: Final = 5.0


# Reads the settings again while the agent runs, and applies those that it can (SIGHUP, ``rmpa reload``).


# The fields of ``Settings`` that a running agent takes; all others need a restart.
LIVE: Final = frozenset(setting.path[0] for setting in SETTINGS if setting.live)
# The most characters of a value in a text for the user.
_VALUE_SHOWN: Final = 60


class Reloader:
    """Reads the settings again; requests are served one after the other.

    Args:
        settings: Those that the agent runs with.
        load: Reads all sources again; may take long and raise ``ConfigError``.
        apply: Called with the settings that hold from now on; only those of ``LIVE`` differ.
        check: Raises ``RmpaError`` where an agent that now runs with the first could not start with the second.

    Attributes:
        waiting: The settings that need a restart to take effect, as of the last reload.
    """

    def __init__(
        self,
        settings: Settings,
        load: Callable[[], Loaded] | None,
        apply: Callable[[Settings], None],
        check: Callable[[Settings, Settings], Awaitable[None]],
    ) -> None:
        self._settings = settings
        self._load = load
        self._apply = apply
        self._check = check
        self._one = asyncio.Lock()
        self.waiting: tuple[str, ...] = ()

    async def reload(self, *, check: bool = False) -> ReloadReply:
        """Read the settings and apply those of ``LIVE``; if they have an error or would not start, nothing changes.

        Args:
            check: Whether to report only what would change, and to apply nothing.

        Raises:
            ConfigError: This agent was started from a program, without a file to read again.
        """
        if self._load is None:
            raise ConfigError("the settings", "this agent was given them by a program", "change them there")
        async with self._one:
            try:
                # In a thread: reading a long file takes long, and finding the line of an error takes longer.
                loaded = await asyncio.to_thread(self._load)
                await self._check(self._settings, loaded.settings)
            except RmpaError as error:
                if not check:
                    _log.error("! the settings stay as they are: %s [%s]", error, error.code)
                return ReloadReply(problem=str(error), code=error.code)
            reply = self._compare(loaded)
            if not check:
                self._take(loaded.settings, reply)
            return reply

    def _compare(self, loaded: Loaded) -> ReloadReply:
        values = [(each, each.value_in(self._settings), each.value_in(loaded.settings)) for each in SETTINGS]
        differences = [(setting, old, new) for setting, old, new in values if old != new]
        return ReloadReply(
            file=str(loaded.settings.config_file or ""),
            changed=tuple(setting.title for setting, _, _ in differences if setting.live),
            restart=tuple(
                f"{setting.title} ({_shown(new)} instead of {_shown(old)})"
                for setting, old, new in differences
                if not setting.live
            ),
            notes=loaded.notes,
        )

    def _take(self, settings: Settings, reply: ReloadReply) -> None:
        tables = {name: _taken(name, getattr(self._settings, name), getattr(settings, name)) for name in LIVE}
        self._settings = replace(self._settings, config_file=settings.config_file, **tables)
        self.waiting = reply.restart
        if reply.changed:
            self._apply(self._settings)
        _log.info("= settings read again: %s", ", ".join(reply.changed) if reply.changed else "nothing has changed")
        for note in reply.notes:
            _log.warning("! %s [doubtful-setting]", note)
        for key in reply.restart:
            _log.warning("! %s takes effect after a restart [needs-restart]", key)

    async def follow(self, came: asyncio.Event, stop: Callable[[], object], *, had_terminal: bool) -> None:
        """Read the settings again at each SIGHUP, until cancelled.

        Args:
            came: Set by the signal.
            stop: Called if the terminal was closed, which sends the signal to end its programs.
            had_terminal: Whether there was one when the process began.
        """
        while await came.wait():
            came.clear()
            if had_terminal and not has_terminal():
                _log.info("= the terminal is gone")
                stop()
                return
            notify_service_manager(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")
            try:
                await self.reload()
            except ConfigError as error:
                _log.error("! the settings stay as they are: %s [%s]", error, error.code)
            except Exception:  # noqa: BLE001 - a fault of one reload must not stop the next one
                _log.exception("! the settings could not be read again")
            finally:
                notify_service_manager("READY=1")


def has_terminal() -> bool:
    """Whether this process has a controlling terminal that is still there."""
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY | os.O_CLOEXEC))
    except OSError:
        return False
    return True


def _taken(name: str, old: Any, new: Any) -> Any:
    """A field of ``Settings`` as it holds from now on: of a table, what is not live stays as it was."""
    kept = [setting.path[1] for setting in SETTINGS if setting.path[0] == name and not setting.live]
    return replace(new, **{key: getattr(old, key) for key in kept}) if kept else new


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        text = "[" + ", ".join(map(str, value)) + "]"
    else:
        text = str(value).lower() if isinstance(value, bool) else str(value) or "nothing"
    return text if len(text) <= _VALUE_SHOWN else text[: _VALUE_SHOWN - 3] + "..."


# Runs ``rmpa web`` and ``rmpa record`` as child processes of the agent, which does not depend on them. They end with
# an agent that ends in order. An agent that is killed leaves them, with their clients, to the next one: the file
# ``<name>.web`` beside the control socket notes the process, and is locked as long as that runs, which has inherited
# the descriptor.


# The exit code of a command that cannot run as it is written: another start would end alike.
_USAGE: Final = 2
# Names of variables that the child reads begin so: with other ones it is another child.
_READ: Final = ("RMPA_", "ROS_", "XDG_")


def web_command(settings: Settings) -> list[str]:
    """The command line of ``rmpa web``: all that the agent's own options may have changed is given."""
    web = settings.web
    command = own_command("web", "--agent", settings.name)
    command += ["--port", str(web.port), "--listen", web.listen]
    if web.token_file:
        command += ["--token-file", web.token_file]
    return [*command, *_config(settings)]


def record_command(settings: Settings) -> list[str]:
    """The command line of ``rmpa record``."""
    return [*own_command("record", "--agent", settings.name), *_config(settings)]


def _config(settings: Settings) -> list[str]:
    return ["--config", str(settings.config_file.absolute())] if settings.config_file is not None else []


def child_environment(settings: Settings, environ: Mapping[str, str]) -> dict[str, str]:
    """The environment of the child: the agent's, with its log's level and format; systemd hears the agent alone."""
    own = {name: value for name, value in environ.items() if name not in SERVICE_VARIABLES}
    return {**own, "RMPA_LOG_LEVEL": settings.log_level, "RMPA_LOG_JSON": str(settings.log_json).lower()}


class ChildProcess:
    """A child, started again with a growing delay whenever it ends; that of an agent before is taken over.

    Args:
        name: Of the command: ``rmpa web``.
        code: Of the warning that it has ended, by ``core.codes``.
        command: Its command line.
        rng: Uniform numbers in [0, 1), for the delays.
        file: Where its process is noted.
        environ: Its environment; ``None``: the agent's.

    Attributes:
        pid: The child's process id, while it runs.
    """

    def __init__(
        self,
        name: str,
        code: str,
        command: Sequence[str],
        rng: Callable[[], float],
        file: Path,
        environ: Mapping[str, str] | None = None,
    ) -> None:
        self._name = name
        self._code = code
        self._command = command
        self._environ = environ
        self._file = file
        self._one = threading.Lock()  # a start that was cancelled goes on in its thread
        self._process: subprocess.Popen[bytes] | None = None  # ``None`` too if an agent before has started it
        self._backoff = Backoff(WEB_RESTART_FIRST, WEB_RESTART_CAP, rng)
        self._task: asyncio.Task[None] | None = None
        self.pid: int | None = None

    @classmethod
    def web(cls, settings: Settings, rng: Callable[[], float]) -> Self:
        """``rmpa web`` of an agent with these settings."""
        return cls("rmpa web", "web-stopped", web_command(settings), rng, *_place(settings, "web"))

    @classmethod
    def recorder(cls, settings: Settings, rng: Callable[[], float]) -> Self:
        """``rmpa record`` of an agent with these settings."""
        return cls("rmpa record", "recording-stopped", record_command(settings), rng, *_place(settings, "record"))

    async def start(self) -> None:
        """Start the child, and look after it until ``close()``."""
        self._task = keep_task(self._supervise, self._name)

    def reload(self) -> None:
        """Have the child read its settings again; one that is not there reads them when it starts."""
        if self.pid is not None:
            with contextlib.suppress(OSError):
                os.kill(self.pid, signal.SIGHUP)

    async def close(self) -> None:
        """End the child, also one that an agent before has left, and wait until it has ended."""
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
            self._task = None
        with contextlib.suppress(OSError):
            await asyncio.to_thread(self._end_former)

    async def _supervise(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            began = loop.time()
            try:
                code = await self._run()
            except OSError as error:
                _log.warning("! %s cannot be started: %s [%s]", self._name, error, self._code)
                code = 1
            if code == _USAGE:
                text = "cannot run with these settings (see above); it is not started again"
                _log.warning("! %s %s [%s]", self._name, text, self._code)
                return
            if loop.time() - began >= WEB_STEADY:
                self._backoff.reset()
            delay = self._backoff.delay()
            text = f"ended with code {code}; it is started again in {delay:.1f} s"
            _log.warning("! %s %s [%s]", self._name, text, self._code)
            await asyncio.sleep(delay)

    async def _run(self) -> int:
        pid = await asyncio.to_thread(self._take_over_or_start)
        try:
            self.pid = pid
            await ended(pid)
        finally:
            self.pid = None
            await asyncio.to_thread(_end, pid)
        return self._process.wait() if self._process is not None else 1

    def _take_over_or_start(self) -> int:
        """The process of the child."""
        words = [*self._command]
        ours = {} if self._environ is None else {k: v for k, v in self._environ.items() if k.startswith(_READ)}
        made_of = [__version__, words, dict(sorted(ours.items()))]
        with self._one, self._file.open("a+b") as file:
            if (former := _noted(file)) is not None:
                pid, other = former
                if other == made_of:
                    if self._process is not None and self._process.pid != pid:
                        self._process = None
                    _log.info("= %s (process %d) goes on, of the agent before", self._name, pid)
                    os.kill(pid, signal.SIGHUP)  # what is in rmpa.toml may have changed
                    return pid
                _end(pid)
                fcntl.flock(file, fcntl.LOCK_EX)
            # In a session of its own Ctrl-C does not reach it: the agent ends it.
            self._process = process = subprocess.Popen(  # noqa: S603 - our own program
                words,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                env=self._environ,
                pass_fds=(file.fileno(),),
            )
            file.truncate(0)
            file.write(json.dumps([process.pid, made_of]).encode())
        return process.pid

    def _end_former(self) -> None:
        with self._one, self._file.open("r+b") as file:
            if (former := _noted(file)) is not None:
                _end(former[0])
            self._file.unlink()
        if self._process is not None:
            self._process.wait()


def _place(settings: Settings, ending: str) -> tuple[Path, Mapping[str, str]]:
    """The file that notes a child, and the child's environment."""
    file = runtime_dir(os.environ, settings.runtime_dir) / f"{settings.name}.{ending}"
    return file, child_environment(settings, os.environ)


def _noted(file: BinaryIO) -> tuple[int, object] | None:
    """The process that a file notes and what it was made of; ``None``: it has ended, and the file is locked by us.

    Raises:
        OSError: It runs, but the agent that started it was killed before it could note it.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        try:
            pid, made_of = json.loads(file.read())
        except ValueError:
            raise OSError("the one of the agent before runs, and its process is not known") from None
        return int(pid), made_of
    return None


def _end(pid: int) -> None:
    """End a process: it is asked to, and killed if it does not in time."""
    with contextlib.suppress(ProcessLookupError):
        descriptor = os.pidfd_open(pid)
        try:
            signal.pidfd_send_signal(descriptor, signal.SIGTERM)
            ended = select.poll()
            ended.register(descriptor, select.POLLIN)
            if not ended.poll(WEB_END_TIMEOUT * 1000):
                signal.pidfd_send_signal(descriptor, signal.SIGKILL)
                ended.poll()
        finally:
            os.close(descriptor)


# The process of an agent. Its signals, its readiness, and the limits that it sets for itself.


async def serve(
    start: Callable[[], Awaitable[None]],
    close: Callable[[], Awaitable[None]],
    reloader: Reloader,
    watch: Callable[[], Coroutine[None, None, None]] | None = None,
) -> None:
    """Start, run until SIGINT or SIGTERM, and close; systemd is notified.

    Args:
        start: Starts everything; after an exception nothing is left running.
        close: Closes everything.
        reloader: Reads the settings again at SIGHUP.
        watch: Runs meanwhile; its end ends everything, and an exception of it is raised.
    """
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    loop.set_default_executor(worker_pool())
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    came, had_terminal = asyncio.Event(), has_terminal()
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as nohup has it
        loop.add_signal_handler(signal.SIGHUP, came.set)
    await start()
    following = partial(reloader.follow, came, stop.set, had_terminal=had_terminal)
    tasks = [keep_task(following, "read the settings again")]
    if watch is not None:
        tasks.append(start_task(watch(), "watch", raises=(Exception,)))
        tasks[1].add_done_callback(lambda _: stop.set())
    try:
        notify_service_manager("READY=1")
        feed_watchdog(loop)
        await stop.wait()
        notify_service_manager("STOPPING=1")
        _log.info("= ending")
        if watch is not None and tasks[1].done():
            tasks[1].result()
    finally:
        await end_tasks(*tasks)
        await close()


def run_process(
    settings: Settings,
    main: Callable[[tuple[str, ...]], Coroutine[None, None, None]],
) -> int:
    """Run the event loop of a process with an agent; return the exit code.

    Args:
        settings: The agent's settings.
        main: Gets the outcomes of ``--realtime``.

    Raises:
        StartError: The agent cannot start on this machine with these settings.
    """
    raise_file_limit()
    keep_capabilities()
    sys.setswitchinterval(runtime_limits.THREAD_SWITCH)
    wanted = settings.realtime
    outcomes = make_realtime(wanted.priority, lock_memory=wanted.lock_memory) if wanted.enabled else ()
    try:
        with asyncio.Runner(loop_factory=AgentLoop) as runner:
            runner.run(main(outcomes))
    except OSError as error:
        if is_shortage(error):
            raise StartError(
                f"agent {settings.name}", "no file descriptors left", open_files_advice(), code="out-of-descriptors"
            ) from error
        raise
    return 0
