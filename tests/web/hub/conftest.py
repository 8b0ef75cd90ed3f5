from __future__ import annotations

import pytest

from rmpa.web import limits


@pytest.fixture(autouse=True)
def _withdrawn_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "UNADVERTISE_DELAY", 0.0)
