from __future__ import annotations

import asyncio
import contextvars
import sys
import threading

import pytest

from rmpa.runtime.accept import in_thread

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
