"""A plain Zenoh program that has nothing of RMPA but what its page on sites says.

Runs with RMPA's interpreter: ``zenoh_end.py ENDPOINT``. Reads lines of JSON; payloads are hexadecimal:

* ``{"do": "subscribe", "key"}``: then ``sample`` with ``key``, ``payload`` and ``attachment``;
* ``{"do": "get", "key", "payload"}``: then ``replies`` with ``ok`` (payloads) and ``errors`` (texts);
* ``{"do": "tokens", "key"}``: then ``tokens`` with those that are alive.

Events beside: ``up``; ``done`` after each line.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import zenoh

from node import say

_kept: list[Any] = []


def _hex(data: zenoh.ZBytes | None) -> str:
    return data.to_bytes().hex() if data is not None else ""


def _subscribe(session: zenoh.Session, told: dict[str, Any]) -> None:
    def take(sample: zenoh.Sample) -> None:
        say("sample", key=str(sample.key_expr), payload=_hex(sample.payload), attachment=_hex(sample.attachment))

    _kept.append(session.declare_subscriber(told["key"], take))


def _get(session: zenoh.Session, told: dict[str, Any]) -> None:
    ok, errors = [], []
    payload = bytes.fromhex(told["payload"]) if "payload" in told else None
    for reply in session.get(told["key"], payload=payload, timeout=5.0):
        if reply.ok is not None:
            ok.append(_hex(reply.ok.payload))
        else:
            errors.append(reply.err.payload.to_string())
    say("replies", ok=ok, errors=errors)


def _tokens(session: zenoh.Session, told: dict[str, Any]) -> None:
    replies = session.liveliness().get(told["key"], timeout=2.0)
    say("tokens", keys=sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None))


DO = {"subscribe": _subscribe, "get": _get, "tokens": _tokens}


def main() -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
    config.insert_json5("scouting/multicast/enabled", "false")
    session = zenoh.open(config)
    say("up")
    for line in sys.stdin:
        told = json.loads(line)
        DO[told["do"]](session, told)
        say("done", do=told["do"])
    session.close()


if __name__ == "__main__":
    main()
