"""Results as JSON, and where they go."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Final

from lab import machine

RESULTS: Final = Path(__file__).parent / "results"


def path_of(name: str, suffix: str) -> Path:
    """``results/<date>-<name><suffix>``, in a directory that exists."""
    RESULTS.mkdir(exist_ok=True)
    stamp = datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    return RESULTS / f"{stamp}-{name}{suffix}"


def write(name: str, settings: dict[str, object], result: dict[str, object], extra: Path | None = None) -> Path:
    """Write one measurement with everything needed to read it later; also to ``extra`` if given."""
    document = {
        "measurement": name,
        "when": datetime.now().astimezone().isoformat(timespec="seconds"),
        "machine": machine.facts(),
        "settings": settings,
        "result": result,
    }
    text = json.dumps(document, indent=1) + "\n"
    path = path_of(name, ".json")
    path.write_text(text, encoding="utf-8")
    if extra:
        extra.write_text(text, encoding="utf-8")
    return path
