"""Run a program of rmpa, the first argument, as a release that does not know direct transport."""

import runpy
import sys
from typing import Any

from rmpa.bridge.rpc import PeerRpc
from rmpa.bridge.topics.direct import TopicPaths

TopicPaths.kind = "earlier"  # what nobody asks for is not answered
_on_request = PeerRpc.on_request


def on_request(rpc: PeerRpc, what: str, *args: Any) -> None:
    """Know no question about direct transport."""
    if not what.startswith("direct."):
        _on_request(rpc, what, *args)


PeerRpc.on_request = on_request  # type: ignore[method-assign, assignment]

sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
