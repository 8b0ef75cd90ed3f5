"""What another package adds to RMPA: the command ``rmpa hello``, and the WebSocket protocol ``hello.v1``."""

from rmpa.cli.options import Options, agent_verb, argument
from rmpa.web.hub.connection import Session
from rmpa.web.hub.frame_writer import Opcode


@agent_verb(argument("name", default="world"))
def hello(name: str, options: Options) -> None:
    """Greet NAME from this machine's module."""
    with options.client() as client:
        module = client.agent().name
    options.show({"hello": name, "from": module}, f"hello {name}, from {module}")


class Greeter(Session):
    """A client of ``rmpa web`` that says a name and is told how many topics there are."""

    kind = "hello"
    subprotocols = ("hello.v1",)

    def opened(self) -> None:
        """Ask for the name."""
        self.warn("who is there?", "")

    def received_frame(self, data: str | bytes, now: float) -> None:  # noqa: ARG002
        """Greet."""
        self.warn(f"hello {data!r}, there are {len(self.hub.graph.topics)} topics", "")

    def warn(self, text: str, subject: str) -> None:  # noqa: ARG002
        """Send a text."""
        self.connection.push((Opcode.TEXT, (text.encode(),)))
