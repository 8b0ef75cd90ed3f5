"""JSON merge patches (RFC 7396), as a page applies them."""

from __future__ import annotations

from typing import Any


def apply(state: Any, patch: Any) -> Any:
    """``state`` with a merge patch applied; neither argument is changed."""
    if not isinstance(patch, dict):
        return patch
    result = dict(state) if isinstance(state, dict) else {}
    for key, value in patch.items():
        if value is None:
            result.pop(key, None)
        else:
            result[key] = apply(result.get(key), value)
    return result
