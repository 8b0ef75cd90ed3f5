"""Callers of a peer's services that come and go at random: ``make soak-services`` does it for longer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.agent.service_storm import rage

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.config.settings import Settings


@pytest.mark.timeout(120)
@pytest.mark.parametrize("seed", [1, 2])
async def test_no_caller_that_stays_is_left_without_an_answer_or_an_end(
    settings: Callable[..., Settings], seed: int, caplog: pytest.LogCaptureFixture
) -> None:
    storm = await rage(2.0, seed, settings("a"), settings("b"))
    assert not storm.wrong
    assert storm.ends["answer"]
    assert not [record for record in caplog.records if record.levelname == "ERROR"]
