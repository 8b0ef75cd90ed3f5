"""What peers ask about parameters and answer to that, in portions."""

from __future__ import annotations

import json
from typing import Any

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.params import transfer
from rmpa.bridge.params.rules import key_problem
from rmpa.core.errors import RmpaError
from rmpa.ros.master.parameters import leaves

SEEDS: list[bytes] = [
    json.dumps(seed).encode()
    for seed in (
        {"size": 3, "text": "abc", "reading": 0},
        [{"size": 6, "text": "abc", "reading": 1}, {"text": "def"}],
        [
            {"writing": 1, "offset": 0, "text": "ab"},
            {"writing": 1, "offset": 2, "text": "c"},
            {"writing": 1, "size": 3},
        ],
        [{"reading": 1, "offset": 0}, {"reading": -1}, {"writing": 2, "offset": 0, "text": 5}],
        {"a": {"b": [1, {"c": 2}]}, "": {"/x": None}},
    )
]


def fuzz(data: bytes) -> None:
    """Whatever comes, an ``RmpaError`` or a value of the size that was told; nothing grows beyond its limit."""
    try:
        said: Any = msgspec.json.decode(data)  # as messages between agents are decoded
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return
    answers = said if isinstance(said, list) else [said]
    _read(answers)
    _write(answers)
    _serve(answers)
    for key, _ in leaves("/x", said if isinstance(said, dict) else {}):
        if not key_problem(key) and ("//" in key or not key.startswith("/")):
            raise AssertionError(f"{key!r} would be taken for a parameter's name")


def _read(answers: list[Any]) -> None:
    steps = transfer.reading(transfer.GET, {"key": "/x"})
    try:
        next(steps)
        for answer in answers:
            steps.send(answer)
    except StopIteration as done:
        if len(done.value) != answers[0]["size"]:
            raise AssertionError("a text of another size than was told") from None
    except RmpaError as error:
        str(error)
    finally:
        steps.close()


def _write(answers: list[Any]) -> None:
    steps = transfer.writing("/x", "x" * (limits.PARAM_PORTION + 10), 1)
    try:
        next(steps)
        for answer in answers:
            steps.send(answer)
    except (StopIteration, RmpaError):
        pass
    finally:
        steps.close()


def _serve(questions: list[Any]) -> None:
    transfers = transfer.Transfers()
    transfers.answer("y" * (2 * limits.PARAM_PORTION), 0.0)
    for number, args in enumerate(questions):
        if not isinstance(args, dict):
            continue
        for serve in (transfers.put, transfers.more, transfers.written):
            try:
                serve(args, float(number))
            except RmpaError as error:
                str(error)
    if len(transfers._writings) > limits.PARAM_TRANSFERS:
        raise AssertionError("more is kept than may be")
