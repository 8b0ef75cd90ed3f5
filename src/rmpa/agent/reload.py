"""Reads the settings again while the agent runs, and applies those that it can (SIGHUP, ``rmpa reload``)."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.settings import SETTINGS
from rmpa.core.errors import ConfigError
from rmpa.observe.reload_reply import ReloadReply
from rmpa.runtime.process import notify_service_manager

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.config.read import Loaded
    from rmpa.config.schema import Setting
    from rmpa.config.settings import Settings

_log = logging.getLogger(__name__)

LIVE: Final = frozenset(setting.path[0] for setting in SETTINGS if setting.live)
"""The fields of ``Settings`` that a running agent takes; all others need a restart."""
_VALUE_SHOWN: Final = 60
"""The most characters of a value in a text for the user."""


class Reloader:
    """Reads the settings again; requests are served one after the other.

    Args:
        settings: Those that the agent runs with.
        load: Reads all sources again; may take long and raise ``ConfigError``.
        apply: Called with the settings that hold from now on; only those of ``LIVE`` differ.
    """

    def __init__(
        self, settings: Settings, load: Callable[[], Loaded] | None, apply: Callable[[Settings], None]
    ) -> None:
        self._settings = settings
        self._load = load
        self._apply = apply
        self._one = asyncio.Lock()
        self.waiting: tuple[str, ...] = ()
        """The settings that need a restart to take effect, as of the last reload."""

    async def reload(self, *, check: bool = False) -> ReloadReply:
        """Read the settings and apply those of ``LIVE``. Settings with an error change nothing.

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
            except ConfigError as error:
                if not check:
                    _log.error("! the settings stay as they are: %s", error)
                return ReloadReply(problem=str(error))
            reply = self._compare(loaded)
            if not check:
                self._take(loaded.settings, reply)
            return reply

    def _compare(self, loaded: Loaded) -> ReloadReply:
        differences = list(_differences(self._settings, loaded.settings))
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
            _log.warning("%s", note)
        for key in reply.restart:
            _log.warning("! %s only holds after a restart", key)


class SighupHandler:
    """Reads the settings again at SIGHUP; ends the agent if its terminal was closed, as that ends any program.

    Args:
        reloader: Reads them.
        stop: Ends the agent.
    """

    def __init__(self, reloader: Reloader, stop: Callable[[], object]) -> None:
        self._reloader = reloader
        self._stop = stop
        self._had_terminal = _has_terminal()
        self._running: set[asyncio.Task[None]] = set()

    def start(self) -> None:
        """Handle the signal from now on, unless it is ignored (``nohup``)."""
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, self._on_signal)

    async def close(self) -> None:
        """Stop handling the signal."""
        asyncio.get_running_loop().remove_signal_handler(signal.SIGHUP)
        for task in self._running:
            task.cancel()
        await asyncio.gather(*self._running, return_exceptions=True)

    def _on_signal(self) -> None:
        if self._had_terminal and not _has_terminal():
            _log.info("= the terminal is gone")
            self._stop()
            return
        task = asyncio.create_task(self._reload(), name="read the settings again")
        self._running.add(task)
        task.add_done_callback(self._running.discard)

    async def _reload(self) -> None:
        notify_service_manager(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")
        try:
            await self._reloader.reload()
        except ConfigError as error:
            _log.error("! the settings stay as they are: %s", error)
        except Exception:  # noqa: BLE001 - the task's top
            _log.exception("! the settings could not be read again")
        finally:
            notify_service_manager("READY=1")


def _has_terminal() -> bool:
    """Whether this process has a controlling terminal that is still there."""
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY | os.O_CLOEXEC))
    except OSError:
        return False
    return True


def _differences(old: Settings, new: Settings) -> Iterator[tuple[Setting, object, object]]:
    """``(setting, old value, new value)`` of each that differs."""
    for setting in SETTINGS:
        before, after = setting.value_in(old), setting.value_in(new)
        if before != after:
            yield setting, before, after


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
