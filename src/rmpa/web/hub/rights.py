"""What a client may do."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Rights:
    """What a client may do beyond reading topics and the graph; nothing unless it is said.

    Attributes:
        publish: Publish messages.
        call_services: Call services.
        read_parameters: Read parameters.
        set_parameters: Set and delete them.
        fetch_assets: Read files of ROS packages.
        serve_services: Offer services.
        configure_resources: Choose the profile and the context of a Smart Resource.
        drive: Command a robot by the monitor's joystick.
    """

    publish: bool = False
    call_services: bool = False
    read_parameters: bool = False
    set_parameters: bool = False
    fetch_assets: bool = False
    serve_services: bool = False
    configure_resources: bool = False
    drive: bool = False


READ_ONLY = Rights()
FULL = Rights(
    publish=True,
    call_services=True,
    read_parameters=True,
    set_parameters=True,
    fetch_assets=True,
    serve_services=True,
    configure_resources=True,
)
"""Everything but ``drive``, which has a setting of its own."""
CONTROL_REMEDY = "start rmpa web with --control, and give its token"
"""For clients that want to change something."""
READ_REMEDY = "send the token of rmpa web; where it has none, start it with --token-file FILE or --control"
"""For clients that want to read what only clients with the token may."""
