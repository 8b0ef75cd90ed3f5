"""Tasks, and work in threads."""

from __future__ import annotations

import ast
import asyncio
import contextvars
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

import rmpa
from rmpa.runtime import tasks
from rmpa.runtime.accept import in_thread
from rmpa.runtime.tasks import OwnedTasks, end_tasks, keep_task, start_task

_SOURCE = Path(rmpa.__file__).parent
_STARTERS = {"create_task", "ensure_future", "TaskGroup", "start_server", "start_unix_server"}


async def _fail(error: Exception) -> None:
    raise error


async def test_the_failure_of_a_task_is_logged_with_its_name(caplog: pytest.LogCaptureFixture) -> None:
    await asyncio.wait([start_task(_fail(ValueError("no such thing")), "count the sheep")])
    (record,) = caplog.records
    assert record.message == "! count the sheep failed"
    assert record.levelname == "ERROR"
    assert "no such thing" in caplog.text


async def test_neither_a_result_nor_an_end_that_was_asked_for_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(OSError, match="away"):
        await start_task(_fail(ConnectionError("away")), "dial", raises=(OSError,))
    await end_tasks(start_task(asyncio.Event().wait(), "wait"), None)
    assert not caplog.records


async def test_what_must_go_on_runs_again_after_a_failure(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tasks, "_KEEP_FIRST", 0.001)
    runs = 0

    async def work() -> None:
        nonlocal runs
        runs += 1
        if runs < 3:
            raise KeyError(runs)

    await keep_task(work, "work")
    assert runs == 3
    assert [record.exc_info is not None for record in caplog.records] == [True, True]
    assert all("work failed; it goes on in" in record.message for record in caplog.records)


async def test_a_kept_task_ends_also_while_it_rests() -> None:
    failed = asyncio.Event()

    async def work() -> None:
        failed.set()
        raise KeyError

    task = keep_task(work, "work")
    await failed.wait()
    await asyncio.sleep(0)
    await end_tasks(task)
    assert task.cancelled()


async def test_tasks_of_one_owner_end_together() -> None:
    owned = OwnedTasks()
    first = owned.start(asyncio.Event().wait(), "first")
    second = owned.start(asyncio.sleep(0), "second")
    await second
    await asyncio.sleep(0)
    assert set(owned) == {first}
    await owned.close()
    assert first.cancelled()
    assert not owned


def _unseen(tree: ast.AST) -> Iterator[ast.AST]:
    """The places that start a task by themselves, or throw away what tasks have ended with."""
    for node in ast.walk(tree):
        named = node.attr if isinstance(node, ast.Attribute) else node.name if isinstance(node, ast.alias) else ""
        if named in _STARTERS or (isinstance(node, ast.Expr) and "return_exceptions=True" in ast.unparse(node)):
            yield node


def test_tasks_are_started_in_one_place_only() -> None:
    found = [
        f"{path.relative_to(_SOURCE)}:{getattr(node, 'lineno', 0)}"
        for path in sorted(_SOURCE.rglob("*.py"))
        if path.relative_to(_SOURCE) != Path("runtime/tasks.py")
        for node in _unseen(ast.parse(path.read_text()))
    ]
    assert not found, "rmpa.runtime.tasks starts tasks, so that each failure is logged"


WHERE: contextvars.ContextVar[str] = contextvars.ContextVar("where", default="nowhere")


async def test_a_function_runs_elsewhere_and_in_the_same_context() -> None:
    WHERE.set("here")
    name, where = await in_thread(lambda: (threading.current_thread().name, WHERE.get()), "worker")
    assert (name, where) == ("worker", "here")


@pytest.mark.parametrize(
    ("function", "error"),
    [
        (lambda: 1 / 0, ZeroDivisionError),
        (lambda: next(iter(())), RuntimeError),
        (lambda: sys.exit(3), RuntimeError),
    ],
)
async def test_what_it_raises_is_raised_here(function: object, error: type[Exception]) -> None:
    with pytest.raises(error):
        await in_thread(function, "worker")  # type: ignore[arg-type]


async def test_any_number_may_hang() -> None:
    release = threading.Event()
    hung = [asyncio.create_task(in_thread(release.wait, f"hung {number}")) for number in range(50)]
    await asyncio.sleep(0)
    for task in hung:
        task.cancel()
    await asyncio.gather(*hung, return_exceptions=True)
    assert await in_thread(lambda: "well", "worker") == "well"
    release.set()
    for thread in threading.enumerate():
        if thread.name.startswith("hung"):
            await asyncio.to_thread(thread.join, 20)
