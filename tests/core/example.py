"""The settings file that we show."""

from __future__ import annotations

from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "src" / "rmpa" / "config" / "rmpa.toml"


def uncommented(text: str) -> str:
    """The example with the lists of tables that it shows in comments."""
    shown, inside = [], False
    for line in text.split("\n"):
        inside = line.startswith("# [[") or (inside and line.startswith("# "))
        shown.append(line.removeprefix("# ") if inside else line)
    return "\n".join(shown)
