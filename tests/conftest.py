"""What every test gets: leaks fail the test that made them; what cannot run here is skipped and counted."""

from __future__ import annotations

import asyncio
import gc
import inspect
import itertools
import os
import signal
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest
from blockbuster import blockbuster_ctx
from hypothesis import HealthCheck, settings

import lab.bed.user.sitecustomize  # noqa: F401 - in these processes too
from lab.bed import namespaces
from lab.bed.agents import USER
from tests import probes
from tests.interop import ros

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

_PROBES: Final = {
    "ros": ros.why_not,
    "netns": namespaces.why_not,
    "nat": namespaces.why_no_nat,
    "pty": probes.why_no_pty,
    "git": probes.why_no_git,
}
"""For each marker, why the tests that carry it cannot run here; empty where they can."""
_TESTS: Final = Path(__file__).parent
_ROOMS: Final = {"core", "runtime", "discovery", "mesh", "ros", "bridge", "resource"}
"""Rooms whose coroutine tests fail when code of rmpa blocks the event loop."""
_WAITING: Final = {"docs", "interop", "examples", "agent", "lab", "cli"}
"""Rooms whose tests mostly wait for the processes that they start."""
_LONG: Final = 10.0
"""Seconds from which on a file is named at the end."""
_TAKEN: Final = ("CMAKE_PREFIX_PATH", "NOTIFY_SOCKET", "PYTHONPATH", "SUDO_UID")
"""Settings of the user that no test may depend on, beside those of ROS and rmpa."""
_numbers = itertools.count(1)
# Hypothesis has chosen its profile by now ("ci" where the variable CI is set), and tests take the rest from it. On a
# loaded machine an example takes any time: pytest's time-out bounds a test.
settings.register_profile("rmpa", settings(), deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("rmpa")
_SETTLE_ROUNDS: Final = 10
"""Turns of the loop that cancelled tasks and closed transports get before they count as leaked."""


def pytest_configure() -> None:
    """Let signals end or reload the programs of the tests: a shell's background jobs inherit some of them ignored."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_itemcollected(item: pytest.Item) -> None:
    """Put the guards around every coroutine test: named first, they are set up first and torn down last."""
    if not isinstance(item, pytest.Function) or not inspect.iscoroutinefunction(item.function):
        return
    if _room(item.path) in _ROOMS and "no_blocking" not in item.fixturenames:
        item.fixturenames.insert(0, "no_blocking")
    item.fixturenames.insert(0, "no_leaks")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skip what cannot run here, as the probes say that something asks for; mix what waits with what computes."""
    for marker, probe in _PROBES.items():
        marked = [item for item in items if item.get_closest_marker(marker)]
        if marked and (reason := probe()):
            for item in marked:
                item.add_marker(pytest.mark.skip(reason=reason))
    if hasattr(config, "workerinput"):  # of several processes, which take the files in this order
        sizes = Counter(item.path for item in items)
        places: dict[Path, float] = {}
        for waits in (True, False):
            paths = [path for path, _ in sizes.most_common() if (_room(path) in _WAITING) is waits]
            end = 0.9 if waits else 1.0  # no process waits for long where nothing else is left to do
            places |= {path: end * place / len(paths) for place, path in enumerate(paths)}
        items.sort(key=lambda item: places[item.path])


def pytest_collection_finish() -> None:
    """Spare ``no_leaks`` the look through thousands of collected tests; the end of an agent would thaw them again."""
    gc.collect()
    gc.freeze()
    patch = pytest.MonkeyPatch()
    for name in ("freeze", "unfreeze"):
        patch.setattr(gc, name, lambda: None)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how many tests were skipped and why, and how long each room and each long file took."""
    reasons: Counter[str] = Counter()
    for report in terminalreporter.getreports("skipped"):
        where = report.longrepr
        text = where[2] if isinstance(where, tuple) else str(where)
        reasons[str(text).removeprefix("Skipped: ")] += 1
    if reasons:
        terminalreporter.section("not run on this machine", sep="-", yellow=True)
        for reason, count in reasons.most_common():
            terminalreporter.line(f"{count} test{'s' if count > 1 else ''} skipped: {reason}")
    seconds: Counter[str] = Counter()
    for report in itertools.chain.from_iterable(terminalreporter.stats.values()):
        if isinstance(report, pytest.TestReport):
            file = report.nodeid.partition("::")[0]
            seconds.update({file: report.duration, "/".join(file.split("/")[:2]): report.duration})
    if terminalreporter.config.getoption("durations"):
        terminalreporter.section("seconds of rooms and long files", sep="-")
        for name, took in seconds.most_common():
            if took > _LONG or not name.endswith(".py"):
                terminalreporter.line(f"{took:7.1f} s  {name}")


def _room(path: Path) -> str:
    """The folder of tests/ that a file is in; empty if it is elsewhere."""
    return path.relative_to(_TESTS).parts[0] if path.is_relative_to(_TESTS) else ""


def _open_sockets() -> dict[int, str]:
    """The inode of each socket that this process holds, by file descriptor."""
    sockets: dict[int, str] = {}
    for entry in Path("/proc/self/fd").iterdir():
        try:
            target = str(entry.readlink())
        except OSError:
            continue
        if target.startswith("socket:"):
            sockets[int(entry.name)] = target
    return sockets


@pytest.fixture
async def no_leaks() -> AsyncIterator[None]:
    """Fail the test if it leaves a task running or a socket open."""
    tasks = asyncio.all_tasks()
    sockets = set(_open_sockets().values())
    yield
    for _ in range(_SETTLE_ROUNDS):
        await asyncio.sleep(0)
    leaked = [task for task in asyncio.all_tasks() - tasks if task is not asyncio.current_task() and not task.done()]
    if not set(_open_sockets().values()) <= sockets:
        gc.collect()  # takes long: thousands of tests have none that is still open
    open_still = {fd: inode for fd, inode in _open_sockets().items() if inode not in sockets}
    if leaked:
        pytest.fail(f"{len(leaked)} task(s) left running: {[f'{t.get_name()}: {t.get_coro()}' for t in leaked]}")
    if open_still:
        pytest.fail(f"{len(open_still)} socket(s) left open: {open_still}")


@pytest.fixture
def no_blocking() -> Iterator[None]:
    """Raise ``BlockingError`` where code of rmpa blocks the event loop; used by itself in the tests of ``_ROOMS``."""
    with blockbuster_ctx("rmpa"):
        yield


@pytest.fixture(scope="session", autouse=True)
def state_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where programs of the tests keep what is to survive their end, those of fixtures of a module too."""
    home = tmp_path_factory.mktemp("state")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(home))
        patch.setenv("PYTHONPATH", USER)
        yield home


@pytest.fixture(autouse=True)
def clean_environment(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, state_home: Path) -> None:
    """Take the user's ROS and rmpa settings away, so that no test depends on them; nothing is kept in his home."""
    monkeypatch.setenv("XDG_STATE_HOME", str(state_home / str(next(_numbers))))
    for name in list(os.environ):
        if name.startswith(("ROS_", "RMPA_")) or name in _TAKEN:
            monkeypatch.delenv(name)
    if _room(request.path) not in _ROOMS:  # those start no programs, and messages' types are searched there
        monkeypatch.setenv("PYTHONPATH", USER)
