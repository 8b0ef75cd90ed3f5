"""Settings of one file, with options and variables beside it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rmpa.config.read import Loaded, load_settings
from rmpa.core.errors import ConfigError

Load = Callable[..., Loaded]
Refuse = Callable[..., str]


@pytest.fixture
def load(tmp_path: Path) -> Load:
    def load(
        text: str | None = None,
        *,
        options: dict[str, object] | None = None,
        environ: dict[str, str] | None = None,
        host_name: str = "base",
    ) -> Loaded:
        if text is not None:
            (tmp_path / "rmpa.toml").write_text(text)
        return load_settings(options or {}, environ or {}, host_name=host_name, cwd=tmp_path)

    return load


@pytest.fixture
def refuse(load: Load, tmp_path: Path) -> Refuse:
    """What is said of settings that cannot be used."""

    def refuse(text: str | None = None, **kwargs: object) -> str:
        with pytest.raises(ConfigError) as info:
            load(text, **kwargs)
        return str(info.value).removeprefix(f"{tmp_path}/")

    return refuse
