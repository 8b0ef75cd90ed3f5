"""Join a secured mesh as ``rmpa trust join`` does: joiner.py NAME; the token is the first line of standard input.

Events: ``joined`` or ``refused`` (``text``).
"""

import asyncio
import json
import sys

from rmpa.core.errors import RmpaError
from rmpa.trust.joining import join_mesh
from rmpa.trust.tokens import Token


def say(event: str, **fields: object) -> None:
    """Tell the test."""
    print("@ " + json.dumps({"event": event, **fields}), flush=True)


token = Token.parse(sys.stdin.readline())
try:
    asyncio.run(join_mesh(token, sys.argv[1]))
except RmpaError as error:
    say("refused", text=str(error))
else:
    say("joined")
