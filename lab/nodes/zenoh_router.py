"""A bare Zenoh router, with nothing of ours: ``zenoh_router.py ENDPOINT``. Event: ``up``."""

from __future__ import annotations

import json
import sys
import threading
from typing import TYPE_CHECKING

import zenoh

from node import say

if TYPE_CHECKING:
    from collections.abc import Mapping


def settings_of(mode: str, settings: Mapping[str, object]) -> zenoh.Config:
    """Settings of a session that does not scout."""
    config = zenoh.Config()
    for key, value in {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        **settings,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def main() -> None:
    session = zenoh.open(settings_of("router", {"listen/endpoints": [sys.argv[1]]}))
    say("up")
    try:
        threading.Event().wait()
    finally:
        session.close()


if __name__ == "__main__":
    main()
