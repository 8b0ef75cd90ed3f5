"""How a measurement of ``lab.bench`` ends: verdicts on the terminal, and the result as JSON."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lab import machine
from lab.tables import dash

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from lab.findings import Claim

RESULTS: Final = Path(__file__).parent / "results"
_WORDS: Final = {True: "reached", False: "not reached", None: "too few samples to say"}
_COLOURS: Final = {True: "green", False: "red", None: "yellow"}


def finish(
    console: Console,
    name: str,
    settings: dict[str, object],
    result: dict[str, object],
    file: Path | None = None,
    *,
    claims: Sequence[Claim] = (),
) -> dict[str, object]:
    """Print the verdicts, write ``results/DATE-NAME.json``; return the result.

    Args:
        console: Where to print.
        name: The measurement's.
        settings: What decided about the figures.
        result: What came out; the claims are added to it as ``targets``.
        file: Gets the JSON as well.
        claims: What was to be reached.
    """
    for claim in claims:
        sign = "≥" if claim.at_least else "≤"
        told = f"{claim.text}: {dash(claim.value)} (to reach: {sign} {claim.limit:g}): {_WORDS[claim.reached]}"
        console.print(told, style=_COLOURS[claim.reached])
    if claims:
        result = {**result, "targets": [_target(claim) for claim in claims]}
    written = write(name, settings, result, file)
    console.print(f"written: {written}")
    return result


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


def _target(claim: Claim) -> dict[str, object]:
    return {
        "what": claim.text,
        "value": claim.value,
        "limit": claim.limit,
        "at_least": claim.at_least,
        "reached": claim.reached,
    }
