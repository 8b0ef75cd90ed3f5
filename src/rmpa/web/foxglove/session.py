"""The session of a Foxglove client: subscribes, publishes, calls, and has parameters and assets; no I/O, no clock.

It decodes no message: payloads cross as they come from TCPROS.
"""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.core.identity import is_global_name, is_type_name
from rmpa.core.timers import TokenBucket
from rmpa.web.foxglove import limits, protocol
from rmpa.web.foxglove.protocol import ENCODING, ERROR, WARNING, message, status
from rmpa.web.hub.connection import ClientStream, Session, decoder_of, ops_of
from rmpa.web.hub.params import CLOCK, CLOCK_TYPE, clock_ns

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Mapping

    from rmpa.web.foxglove.channels import Channel, ChannelTable
    from rmpa.web.hub.frame_writer import OutFrame
    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.node_link import Follower, ParamValue, Payload, Rights
    from rmpa.web.hub.topics import ClientPublication, ClientSubscription, ReceivedMessage

_T = TypeVar("_T")
_U = TypeVar("_U")
# A WebSocket's close code, RFC 6455, section 7.4.1.
_POLICY_VIOLATION: Final = 1008


class _Subscription(ClientStream):
    """A subscription of the client, with the number that it chose. One that failed keeps its number."""

    def __init__(self, session: FoxgloveSession, number: int, channel: Channel) -> None:
        self._session = session
        self.id = number
        self.channel = channel
        self.topic = channel.topic
        self.subscription: ClientSubscription | None = None

    def frames(self, message: ReceivedMessage) -> Iterable[OutFrame]:
        """The frame of a message; none of another version of its type."""
        channel = self.channel
        if message.md5sum not in ("", channel.md5sum):
            self._session.table.other_version(channel, message.md5sum)
            return ()
        channel.delivered = True
        stamp = message.stamp_ns if self._session.time_ns is None else self._session.time_ns
        return (protocol.message_data(self.id, stamp, message.payload),)

    def close(self) -> None:
        """End it, and what waits for it."""
        self._session.connection.queue.end(self)
        if self.subscription is not None:
            self.subscription.close()


class _Clock(ClientStream):
    """``/clock``, which is sent on."""

    topic = CLOCK

    def __init__(self, session: FoxgloveSession) -> None:
        self._session = session

    def frames(self, message: ReceivedMessage) -> Iterable[OutFrame]:
        """The server's time."""
        time_ns = clock_ns(message.payload)
        if time_ns is None:
            return ()
        self._session.time_ns = time_ns
        return (protocol.server_time(time_ns),)


class FoxgloveSession(Session):
    """One client. Each JSON message of it is a method whose keywords are the message's fields.

    Args:
        hub: The hub.
        rights: What the client may do.
        address: The client's, for logs.
        table: What all clients are offered.
    """

    kind = "foxglove"
    frame_max = limits.BINARY_MAX

    # More than 12 fields: what the client has of each kind.
    def __init__(self, hub: Hub, rights: Rights, address: str, table: ChannelTable) -> None:
        super().__init__(hub, rights, address)
        self.table = table
        # The time by ``/clock``, where that gives it: it stamps the messages.
        self.time_ns: int | None = None
        self._now = 0.0
        self._errors = TokenBucket(limits.STATUS_RATE, limits.STATUS_BURST)
        self._subscriptions: dict[int, _Subscription] = {}
        self._published: dict[int, ClientPublication | None] = {}
        # Requests of each kind that have no answer yet.
        self._waiting: Counter[str] = Counter()
        # The parameters that are followed, or that are left out where all are followed.
        self._names: set[str] = set()
        self._all = False
        self._follower: Follower | None = None

    def opened(self) -> None:
        """Tell what the server is and offers."""
        view, control, simulated = self.rights.view, self.rights.control, self.hub.time.simulated
        offered = {"clientPublish": control, "parameters": view, "parametersSubscribe": view, "services": control}
        offered |= {"time": simulated, "connectionGraph": True, "assets": view}
        about = {
            "name": self.table.server,
            "capabilities": [each for each, given in offered.items() if given],
            "supportedEncodings": [ENCODING],
            "metadata": {"ROS_DISTRO": "noetic"},  # a client knows by it that the data are ROS 1's
            "sessionId": self.table.run,
        }
        self.connection.push(message("serverInfo", **about))
        self.table.join(self, self._withdrawn)
        if simulated:
            self.subscribe(CLOCK, CLOCK_TYPE, partial(self.connection.push_message, _Clock(self)), self._tell)

    def closing(self) -> None:
        """The client has gone."""
        self.table.leave(self)

    def received_frame(self, data: Payload | str, now: float) -> None:
        """Handle a frame of the client: text as ``str``, binary as bytes.

        What is wrong with it is told to the client as a status, at most ``limits.STATUS_RATE`` times a
        second in the long run; a client that sends malformed messages at a higher rate is disconnected.
        """
        self._now = now
        try:
            if isinstance(data, str):
                received = protocol.parse_text(data, DECODER)
                getattr(self, type(received).__name__)(**msgspec.structs.asdict(received))
            else:
                match protocol.parse_binary(data):
                    case channel, payload:
                        self._publish(channel, payload)
                    case service, call, encoding, payload:
                        self._call(service, call, encoding, payload)
        except RmpaError as error:
            self._refuse(error)

    def warn(self, text: str, subject: str) -> None:
        """Send a warning, which a later one of the same subject replaces."""
        self.connection.push(status(WARNING, text, subject))

    def _withdrawn(self, channels: Iterable[int]) -> None:
        """These channels have ended, and their subscriptions with them."""
        gone = {*channels}
        for number, subscription in [*self._subscriptions.items()]:
            if subscription.channel.id in gone:
                del self._subscriptions[number]
                subscription.close()

    def _tell(self, error: RmpaError) -> None:
        self.connection.push(status(ERROR, str(error)))

    def _refuse(self, error: RmpaError) -> None:
        if self._errors.take(self._now):
            self._tell(error)
        elif isinstance(error, RemoteProtocolError):
            self.connection.end(_POLICY_VIOLATION, "too many malformed messages", "message")

    def _each(self, do: Callable[[Any], None], items: Iterable[Any]) -> None:
        """Do something with each, refusing those with which it cannot be done."""
        for item in items:
            try:
                do(item)
            except RmpaError as error:
                self._refuse(error)

    def _await(
        self,
        what: str,
        most: int,
        work: Coroutine[Any, Any, _T],
        done: Callable[[_T], None],
        failed: Callable[[RmpaError], None],
    ) -> None:
        """Answer when something is done; of its kind only so many wait."""
        if self._waiting[what] >= most:
            work.close()
            failed(
                RmpaError(f"{self._waiting[what]} {what} wait for their answer, which is the limit; try again later")
            )
            return
        self._waiting[what] += 1

        def answered(answer: Callable[[_U], None], value: _U) -> None:
            self._waiting[what] -= 1
            answer(value)

        self.run(work, partial(answered, done), partial(answered, failed))

    def op_subscribe(self, *, subscriptions: protocol.Subscriptions) -> None:
        """Begin to send the messages of channels."""
        self._each(self._subscribe, subscriptions)

    def _subscribe(self, wanted: protocol.FoxgloveSubscription) -> None:
        channel = self.table.channels.by_id.get(wanted.channel_id)
        if channel is None:
            raise RmpaError(f"there is no channel {wanted.channel_id}; its topic may be gone")
        if wanted.id in self._subscriptions:
            raise RmpaError(f"subscription {wanted.id} exists; end it first, or choose another number")
        if any(each.channel is channel for each in self._subscriptions.values()):
            raise RmpaError(f"channel {wanted.channel_id} ({channel.topic}) has a subscription of this client")
        if len(self._subscriptions) >= limits.SUBSCRIPTIONS_MAX:
            raise RmpaError(f"{len(self._subscriptions)} subscriptions are the limit of one client; end some first")
        made = self._subscriptions[wanted.id] = _Subscription(self, wanted.id, channel)
        take = partial(self.connection.push_message, made)
        made.subscription = self.subscribe(channel.topic, channel.type, take, self._tell)

    def op_unsubscribe(self, *, subscription_ids: protocol.Ids) -> None:
        """End subscriptions."""
        self._each(self._unsubscribe, subscription_ids)

    def _unsubscribe(self, number: int) -> None:
        subscription = self._subscriptions.pop(number, None)
        if subscription is None:
            raise RmpaError(f"there is no subscription {number} to end")
        subscription.close()

    def op_subscribe_connection_graph(self) -> None:
        """Tell the graph and its changes."""
        self.table.follow_graph(self)

    def op_unsubscribe_connection_graph(self) -> None:
        """Tell no more of the graph."""
        self.table.unfollow_graph(self)

    def op_advertise(self, *, channels: protocol.ClientChannels) -> None:
        """Begin to publish topics."""
        self.check_control("publish")
        self._each(self._advertise, channels)

    def _advertise(self, channel: protocol.ClientChannel) -> None:
        topic = channel.topic if channel.topic.startswith("/") else f"/{channel.topic}"
        if channel.id in self._published:
            raise RmpaError(f"channel {channel.id} is advertised; withdraw it first, or choose another number")
        if channel.encoding != ENCODING:
            raise RmpaError(f"{channel.topic}: the encoding {channel.encoding!r} is not {ENCODING!r}")
        if not is_global_name(topic) or topic == "/":
            raise RmpaError(f"{channel.topic!r} is not a topic's name; write it like /cmd_vel")
        if not is_type_name(channel.schema_name):
            raise RmpaError(f"{topic}: {channel.schema_name!r} is not a type; write it like std_msgs/String")
        if len(self._published) >= limits.ADVERTISED_MAX:
            raise RmpaError(f"{len(self._published)} published topics are the limit of one client")
        # The client may send messages before it reads that this failed: they are dropped.
        self._published[channel.id] = None
        self._published[channel.id] = self.advertise(topic, channel.schema_name, self._tell)

    def op_unadvertise(self, *, channel_ids: protocol.Ids) -> None:
        """Publish topics no longer."""
        self._each(self._unadvertise, channel_ids)

    def _unadvertise(self, number: int) -> None:
        if number not in self._published:
            raise RmpaError(f"channel {number} is not advertised, so it cannot be withdrawn")
        if (publication := self._published.pop(number)) is not None:
            publication.close()

    def _publish(self, channel: int, payload: Payload) -> None:
        self.check_control("publish")
        if channel not in self._published:
            raise RmpaError(f"channel {channel} is not advertised; advertise it before its messages")
        if (publication := self._published[channel]) is not None:
            publication.publish(payload)

    def _call(self, service: int, call: int, encoding: str, payload: Payload) -> None:
        def done(response: Payload) -> None:
            self.connection.push(protocol.service_response(service, call, response))

        def failed(error: RmpaError) -> None:
            self.connection.push(message("serviceCallFailure", serviceId=service, callId=call, message=str(error)))

        try:
            work = self._service_call(service, encoding, payload)
        except RmpaError as error:
            failed(error)
        else:
            self._await("calls", limits.CALLS_MAX, work, done, failed)

    def _service_call(self, number: int, encoding: str, payload: Payload) -> Coroutine[Any, Any, Payload]:
        self.check_control("call services")
        service = self.table.services.by_id.get(number)
        if service is None:
            raise RmpaError(f"there is no service {number}; it may be gone")
        if encoding != ENCODING:
            raise RmpaError(f"the encoding {encoding[:80]!r} is not {ENCODING!r}")
        return self.call(service.name, service.kind.name, payload)

    def op_fetch_asset(self, *, uri: protocol.Text, request_id: protocol.Id) -> None:
        """Send a file of a ROS package."""

        def done(data: bytes) -> None:
            self.connection.push(protocol.asset_response(request_id, data))

        def failed(error: RmpaError) -> None:
            self.connection.push(protocol.asset_failure(request_id, str(error)))

        work = self.fetch_asset(uri, limits.ASSET_MAX)
        self._await("assets", limits.ASSETS_MAX, work, done, failed)

    def op_get_parameters(self, *, parameter_names: protocol.Names = (), id_: protocol.Text | None = None) -> None:
        """Send parameters; all where no name is given."""
        names = self._readable(parameter_names)
        if names or not parameter_names:
            self._await_values(self.get_params(names), id_)
        else:
            self.connection.push(protocol.parameter_values({}, id_))

    def op_set_parameters(self, *, parameters: protocol.FoxgloveParameters, id_: protocol.Text | None = None) -> None:
        """Set parameters, and delete those without a value; one that is malformed leaves all as they are."""
        self.check_command("set parameters")
        values = {each.name: protocol.from_parameter(each) for each in parameters}
        if values:
            self._await_values(self._set(values), id_, answered=id_ is not None)

    async def _set(self, values: Mapping[str, ParamValue]) -> Mapping[str, ParamValue]:
        """Set parameters; returns those that could be set."""
        taken: dict[str, ParamValue] = {}
        for name, value in values.items():
            try:
                if value is None:
                    await self.hub.params.delete(name)
                else:
                    await self.hub.params.set(name, value)
                    taken[name] = value
            except RmpaError as error:
                self._tell(error)
        return taken

    def _await_values(
        self, work: Coroutine[Any, Any, Mapping[str, ParamValue]], identity: str | None, *, answered: bool = True
    ) -> None:
        def done(values: Mapping[str, ParamValue]) -> None:
            if answered:
                self.connection.push(protocol.parameter_values(values, identity))

        def failed(error: RmpaError) -> None:
            self._tell(error)
            done({})

        self._await("requests for parameters", limits.PARAMETER_REQUESTS_MAX, work, done, failed)

    def op_subscribe_parameter_updates(self, *, parameter_names: protocol.Names = ()) -> None:
        """Send changes of parameters; of all where no name is given."""
        names = self._readable(parameter_names)
        if names or not parameter_names:
            self._follow_also(names, wanted=True)

    def op_unsubscribe_parameter_updates(self, *, parameter_names: protocol.Names = ()) -> None:
        """End updates of parameters; of all where no name is given."""
        self._follow_also(parameter_names, wanted=False)

    def _readable(self, names: protocol.Names) -> tuple[str, ...]:
        """Those that the client may read, each once; the others are refused."""
        for name in names:
            protocol.check_name(name)
        found: list[str] = []

        def take(name: str) -> None:
            self.read_param(name)
            found.append(name)

        self._each(take, dict.fromkeys(names))
        return tuple(found)

    def _follow_also(self, names: Iterable[str], *, wanted: bool) -> None:
        if not names:
            self._follow(set(), all_=wanted)
        elif wanted is self._all:  # the names are those that are left out, where all are followed
            self._follow(self._names.difference(names), all_=self._all)
        else:
            self._follow(self._names.union(names), all_=self._all)

    def _follow(self, names: set[str], *, all_: bool) -> None:
        if len(names) > limits.PARAMETERS_MAX:
            raise RmpaError(
                f"{len(names)} parameters are more than the {limits.PARAMETERS_MAX} that a client may name;"
                " follow all by an empty list"
            )
        if self._follower is not None:
            self._follower.close()
        self._follower = None
        self._names, self._all = names, all_
        if all_ or names:
            self._follower = self.follow_params(() if all_ else tuple(sorted(names)), self._params_changed)

    def _params_changed(self, values: Mapping[str, ParamValue]) -> None:
        shown = {name: value for name, value in values.items() if not (self._all and name in self._names)}
        if shown:
            self.connection.push(protocol.parameter_values(shown))


def _camel(name: str) -> str:
    first, *further = name.removesuffix("_").split("_")
    return first + "".join(map(str.capitalize, further))


# The fields of each JSON message of a client.
OPS: Final = ops_of(FoxgloveSession, _camel, tagged=True)
DECODER: Final = decoder_of(OPS)
