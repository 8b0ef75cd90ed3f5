"""Limits of what an agent runs beside itself. Seconds."""

from __future__ import annotations

from typing import Final

WEB_RESTART_FIRST: Final = 0.5
"""Until rmpa web is started anew after it ended; each further time it is twice as long."""
WEB_RESTART_CAP: Final = 30.0
"""The longest such time."""
WEB_STEADY: Final = 60.0
"""After a run of this length the next wait is the first one again."""
WEB_END_TIMEOUT: Final = 5.0
"""For rmpa web to end when the agent ends; then it is killed."""
