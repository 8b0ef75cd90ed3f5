"""``python -m tests.fuzz [--seconds N] [--seed N] [TARGET ...]``: attack parsers for longer than the tests do.

A failing input is written to a file, with the command that replays it: ``python -m tests.fuzz TARGET --replay FILE``.
"""

from __future__ import annotations

import argparse
import hashlib
import logging
import random
import sys
import time
import traceback
from pathlib import Path

from tests.fuzz import targets
from tests.fuzz.mutate import mutate

_PROGRESS_EVERY = 1.0


def main() -> int:
    """Run; 1 if some target failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Fuzz the parsers.")
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(targets.names())}; default: all")
    parser.add_argument("--seconds", type=float, default=10.0, help="for each target (default: 10)")
    parser.add_argument("--seed", type=int, default=None, help="of the mutations (default: a new one, printed)")
    parser.add_argument("--replay", type=Path, help="run one input from this file instead")
    parser.add_argument("--crashes", type=Path, default=Path(), help="where failing inputs are written")
    options = parser.parse_args()
    if unknown := set(options.targets) - set(targets.names()):
        parser.error(f"no target {', '.join(sorted(unknown))}; there are {', '.join(targets.names())}")
    chosen = options.targets or targets.names()
    if options.replay is not None:
        if len(options.targets) != 1:
            parser.error("--replay needs the one target that the file is for")
        targets.load(chosen[0]).fuzz(options.replay.read_bytes())
        print(f"{chosen[0]}: {options.replay} does no harm")
        return 0
    logging.disable()  # refusals are what hostile bytes are meant to get: thousands of lines that tell nothing
    seed = options.seed if options.seed is not None else random.SystemRandom().randrange(1 << 32)
    try:
        failed = [name for name in chosen if not attack(name, seed, options.seconds, options.crashes)]
    except KeyboardInterrupt:
        return 130
    return 1 if failed else 0


def attack(name: str, seed: int, seconds: float, crashes: Path) -> bool:
    """Fuzz one target until the time is over or it fails; say how it went."""
    target = targets.load(name)
    rng = random.Random(f"{seed} {name}")
    begin = shown = time.monotonic()
    count = 0
    slowest = 0.0
    while (now := time.monotonic()) - begin < seconds:
        data = mutate(rng, target.seeds) if rng.random() < 0.95 else rng.randbytes(rng.randrange(512))
        try:
            target.fuzz(data)
        except Exception:  # noqa: BLE001 - whatever it is, it is what we look for
            path = crashes / f"crash-{name}-{hashlib.sha256(data).hexdigest()[:12]}.bin"
            path.write_bytes(data)
            traceback.print_exc()
            print(f"\n{name}: FAILED after {count} inputs (seed {seed})")
            print(f"replay: {sys.executable} -m tests.fuzz {name} --replay {path}")
            return False
        count += 1
        slowest = max(slowest, time.monotonic() - now)
        if sys.stderr.isatty() and now - shown > _PROGRESS_EVERY:
            shown = now
            print(
                f"\r{name}: {count} inputs, {now - begin:.0f} of {seconds:.0f} s", end="", file=sys.stderr, flush=True
            )
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr)
    print(
        f"{name}: {count} inputs, {count / seconds:.0f}/s, slowest {slowest * 1000:.1f} ms, seed {seed}: no failure"
    )
    return True


if __name__ == "__main__":
    sys.exit(main())
