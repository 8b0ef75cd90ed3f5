"""The process of an agent: start, end, reload of settings, and the programs that run beside it.

Limits of what an agent runs beside itself. Seconds.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final, Self

from rmpa import __version__
from rmpa.config.settings import SETTINGS, Settings
from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.core.timers import Backoff
from rmpa.observe.control_client import ReloadReply, runtime_dir
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import is_shortage, open_files_advice, raise_file_limit
from rmpa.runtime.interpreter import own_command
from rmpa.runtime.kept_program import KeptProgram, ProgramNote
from rmpa.runtime.loop import AgentLoop, make_realtime, worker_pool
from rmpa.runtime.programs import end_program, keep_capabilities, start_program
from rmpa.runtime.systemd import SERVICE_VARIABLES, feed_watchdog, notify_service_manager
from rmpa.runtime.tasks import end_tasks, keep_task, start_task

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Awaitable, Callable, Coroutine, Sequence

    from rmpa.config.read import Loaded

_log = logging.getLogger(__name__)

# Until rmpa web or rmpa record is started again after it ended; each further time it is twice as long.
CHILD_RESTART_FIRST: Final = 0.5
# The longest such time.
CHILD_RESTART_CAP: Final = 30.0
# For them to end after SIGINT when the agent ends; SIGTERM and SIGKILL follow.
CHILD_END: Final = 2.0


# Reads the settings again while the agent runs, and applies those that it can (SIGHUP, ``rmpa reload``).


# The most characters of a value in a text for the user.
_VALUE_SHOWN: Final = 60


class Reloader:
    """Reads the settings again; requests are served one after the other.

    Args:
        settings: Those that the agent runs with.
        load: Reads all sources again; may take long and raise ``ConfigError``.
        apply: Called with the settings that hold from now on; only live ones differ.
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
        """Read the settings and apply the live ones; if they have an error or would not start, nothing changes.

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
        taken = replace(self._settings, config_file=settings.config_file)
        for setting in (each for each in SETTINGS if each.live):
            taken = setting.put(taken, setting.value_in(settings))
        self._settings = taken
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


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        text = "[" + ", ".join(map(str, value)) + "]"
    else:
        text = str(value).lower() if isinstance(value, bool) else str(value) or "nothing"
    return text if len(text) <= _VALUE_SHOWN else text[: _VALUE_SHOWN - 3] + "..."


# Names of variables that a child reads begin so: with other ones it is another child.
_READ: Final = ("RMPA_", "ROS_", "XDG_")


class ChildProcess(KeptProgram):
    """``rmpa web`` or ``rmpa record``, which run beside the agent; it does not depend on them.

    Args:
        verb: Which of them.
        code: As of ``KeptProgram``.
        settings: Those of the agent.
        rng: Uniform numbers in [0, 1), for the delays.
        options: What the agent's own options may have changed.
    """

    unusable = "cannot run with these settings (see above)"

    def __init__(
        self, verb: str, code: str, settings: Settings, rng: Callable[[], float], options: Sequence[str] = ()
    ) -> None:
        note = runtime_dir(os.environ, settings.runtime_dir) / f"{settings.name}.{verb}"
        super().__init__(f"rmpa {verb}", code, note, Backoff(CHILD_RESTART_FIRST, CHILD_RESTART_CAP, rng), CHILD_END)
        self.command = own_command(verb, "--agent", settings.name, *options)
        if settings.config_file is not None:
            self.command += ["--config", str(settings.config_file.absolute())]
        # Systemd hears the agent alone.
        self.environ = {name: value for name, value in os.environ.items() if name not in SERVICE_VARIABLES}
        self.environ |= {"RMPA_LOG_LEVEL": settings.log_level, "RMPA_LOG_JSON": str(settings.log_json).lower()}

    @classmethod
    def web(cls, settings: Settings, rng: Callable[[], float]) -> Self:
        """``rmpa web`` of an agent with these settings."""
        web = settings.web
        options = ["--port", str(web.port), "--listen", web.listen]
        options += ["--token-file", web.token_file] if web.token_file else []
        return cls("web", "web-stopped", settings, rng, options)

    @property
    def made_of(self) -> tuple[str, ...]:
        """As of ``KeptProgram``: release, command line, and the variables that it reads."""
        read = sorted(f"{name}={value}" for name, value in self.environ.items() if name.startswith(_READ))
        return (__version__, *self.command, *read)

    def launch(self) -> subprocess.Popen[bytes]:
        """As of ``KeptProgram``; Ctrl-C does not reach it: the agent ends it."""
        return start_program(self.command, log=None, env=self.environ)

    def begin(self) -> None:
        """Start it, or take over that of an agent before, and look after it until ``stop``."""
        self._keeper = start_task(self._begin(), f"begin {self._what}")

    async def _begin(self) -> None:
        note = await asyncio.to_thread(ProgramNote.load, self._note)
        if note is not None and note.mark.runs:
            if note.made_of == self.made_of:
                self.adopt(note)
                self.reload()  # what is in rmpa.toml may have changed
                return
            await end_program(note.mark, self._end)
        self.keep()

    def reload(self) -> None:
        """Have it read its settings again; one that is not there reads them when it starts."""
        if self.mark is not None and self.runs:
            with contextlib.suppress(OSError):
                os.kill(self.mark.pid, signal.SIGHUP)


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
