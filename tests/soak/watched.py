"""``rmpa up`` as users run it, but on SIGUSR1 it writes what it holds to the file SOAK_HELD; started by ``stage``."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections import Counter
from pathlib import Path

from rmpa.cli.main import main


def tell(*_: object) -> None:
    """Write the names of all tasks, with how many there are of each."""
    tasks = Counter(getattr(task.get_coro(), "__qualname__", "?") for task in asyncio.all_tasks())
    path = Path(os.environ["SOAK_HELD"])
    written = path.with_suffix(".new")
    written.write_text(json.dumps(tasks), encoding="utf-8")
    written.replace(path)


if __name__ == "__main__":
    signal.signal(signal.SIGUSR1, tell)
    sys.exit(main())
