"""Seeds: addresses of other agents in the settings. Host names are looked up in threads, again and again."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
import socket
import threading
from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING

from rmpa.core.counters import Backoff
from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.config.values import HostPort
    from rmpa.discovery.beacon import Address

_log = logging.getLogger(__name__)


def resolve_ipv4(host: str) -> list[str]:
    """The IPv4 addresses of a host name; blocks.

    Raises:
        OSError: The name cannot be resolved now.
    """
    found = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_DGRAM)
    return list(dict.fromkeys(str(entry[4][0]) for entry in found))


class SeedResolver:
    """Keeps the numeric addresses of the seeds up to date.

    Args:
        seeds: As the user wrote them.
        default_port: For seeds without a port.
        on_change: Called in the loop with all addresses known so far, when they change.
        resolve: Looks up a host name; runs in a thread.
    """

    def __init__(
        self,
        seeds: tuple[HostPort, ...],
        default_port: int,
        on_change: Callable[[tuple[Address, ...]], None],
        *,
        resolve: Callable[[str], list[str]] = resolve_ipv4,
    ) -> None:
        self._seeds = seeds
        self._default_port = default_port
        self._on_change = on_change
        self._resolve = resolve
        self._hosts: dict[str, list[str]] = {}
        self._tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Report the numeric addresses at once; start to look up the names."""
        names = []
        for host in dict.fromkeys(seed.host for seed in self._seeds):
            try:
                self._hosts[host] = [str(IPv4Address(host))]
            except AddressValueError:
                names.append(host)
        if self._hosts:
            self._report()
        self._tasks = [asyncio.get_running_loop().create_task(self._follow(host)) for host in names]

    async def close(self) -> None:
        """Stop. A look-up in progress ends by itself, in its thread."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _report(self) -> None:
        self._on_change(
            tuple((a, s.port or self._default_port) for s in self._seeds for a in self._hosts.get(s.host, ()))
        )

    async def _follow(self, host: str) -> None:
        backoff = Backoff(limits.SEED_RETRY_FIRST, limits.SEED_RETRY_MAX, random.random)
        failed = False
        while True:
            try:
                addresses = await self._look_up(host)
            except OSError as error:
                if not failed:
                    _log.warning("! seed %s: cannot be resolved (%s); tried again for ever", host, error)
                failed = True
                await asyncio.sleep(backoff.delay())
                continue
            failed = False
            backoff.reset()
            if addresses != self._hosts.get(host):
                _log.info("= seed %s is %s", host, ", ".join(addresses))
                self._hosts[host] = addresses
                self._report()
            await asyncio.sleep(limits.SEED_RESOLVE_INTERVAL)

    async def _look_up(self, host: str) -> list[str]:
        """Look up a name in a daemon thread: a name server that never answers must not delay the end."""
        loop = asyncio.get_running_loop()
        done: asyncio.Future[list[str]] = loop.create_future()

        def settle(result: list[str] | OSError) -> None:
            if done.cancelled():
                return
            if isinstance(result, OSError):
                done.set_exception(result)
            else:
                done.set_result(result)

        def work() -> None:
            result: list[str] | OSError
            try:
                result = self._resolve(host)
            except OSError as error:
                result = error
            except UnicodeError as error:  # a label that is empty or too long
                result = OSError(str(error))
            with contextlib.suppress(RuntimeError):  # the loop has ended meanwhile
                loop.call_soon_threadsafe(settle, result)

        threading.Thread(target=work, name=f"resolve {host}", daemon=True).start()
        return await done
