"""An agent that counts its own calls: ``profiled.py FILE up ...``.

SIGUSR1 begins, SIGUSR2 ends and writes FILE, as of ``cProfile``. Its times are the profiler's more than the agent's;
its counts are exact.
"""

from __future__ import annotations

import cProfile
import signal
import sys
from pathlib import Path

from rmpa.cli.main import main


def run() -> int:
    target = Path(sys.argv[1])
    profile = cProfile.Profile()

    def end(_number: int, _frame: object) -> None:
        profile.disable()
        unfinished = target.with_suffix(".part")
        profile.dump_stats(unfinished)
        unfinished.replace(target)

    signal.signal(signal.SIGUSR1, lambda _number, _frame: profile.enable())
    signal.signal(signal.SIGUSR2, end)
    return main(sys.argv[2:])


if __name__ == "__main__":
    sys.exit(run())
