"""The names of the requests between two agents about parameters.

Values cross as the text of an XML-RPC response (``ros.wire.xmlrpc``), so that their types survive: JSON has neither
binary data nor dates. ``bridge.session.peer_rpc`` carries large ones aside of commands. ::

    param.get {key}                       → {text}
    param.names {}                        → {text}        a list of the names of all parameters that may be read
    param.set {key, text}                 → {count}
    param.delete {key}                    → {}
    param.follow {keys}                   → {refused}     from now on their changes, as below
    notification param.value {key, exists, size, text}    without text: it is large; read it

A gateway that asks for another site adds ``site`` (empty for a program that names none) and ``askers``, modules of
that site. Then the owner asks the permissions of the gateway, of the site, and denials of those modules.
"""

from __future__ import annotations

from typing import Final

from rmpa.bridge import limits
from rmpa.core.errors import LimitExceeded, RemoteProtocolError

GET: Final = "param.get"
NAMES: Final = "param.names"
SET: Final = "param.set"
DELETE: Final = "param.delete"
FOLLOW: Final = "param.follow"
VALUE: Final = "param.value"
QUESTIONS: Final = (GET, NAMES, SET, DELETE)
"""The requests that the command line may have its agent send."""


def text_of(fields: object) -> str:
    """The value in a request to set a parameter, or in the answer to ``param.get`` or ``param.names``.

    Raises:
        RemoteProtocolError: There is none.
        LimitExceeded: It is above ``limits.PARAM_TEXT_MAX``.
    """
    text = fields.get("text") if isinstance(fields, dict) else None
    if not isinstance(text, str):
        raise RemoteProtocolError("the text of a parameter's value is missing")
    if len(text) > limits.PARAM_TEXT_MAX:
        raise LimitExceeded("parameter", len(text), limits.PARAM_TEXT_MAX)
    return text


def count_of(answer: object) -> int:
    """How many parameters were set.

    Raises:
        RemoteProtocolError: The answer does not say it.
    """
    count = answer.get("count") if isinstance(answer, dict) else None
    if not isinstance(count, int):
        raise RemoteProtocolError(f"an answer about a parameter that is none: {str(answer)[:100]!r}")
    return count


def too_large(key: str, size: int) -> str:
    """The error text for a value that is too large to cross."""
    most = limits.PARAM_TEXT_MAX
    return (
        f"{key} has {size} characters as XML-RPC text, above the {most} ({most >> 20} MiB) that cross between "
        "modules; take its parts one by one, or let a latched topic carry it"
    )
