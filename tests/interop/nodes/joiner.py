"""Join a secured mesh as ``rmpa trust join`` does: joiner.py NAME; the token is the first line of standard input.

Events: ``code`` (``code``), then ``joined`` or ``refused`` (``text``). The second line is ``yes`` for equal codes.
"""

import asyncio
import json
import sys

from rmpa.core.errors import RmpaError
from rmpa.runtime.system_clock import SystemClock
from rmpa.trust.io.joining import join_mesh
from rmpa.trust.tokens import Token


def say(event: str, **fields: object) -> None:
    """Tell the test."""
    print("@ " + json.dumps({"event": event, **fields}), flush=True)


async def compare(code: str) -> bool:
    """Show the code, and ask."""
    say("code", code=code)
    answer: str = await asyncio.to_thread(sys.stdin.readline)
    return answer.strip() == "yes"


token = Token.parse(sys.stdin.readline())
try:
    asyncio.run(join_mesh(token, sys.argv[1], SystemClock(), compare))
except RmpaError as error:
    say("refused", text=str(error))
else:
    say("joined")
