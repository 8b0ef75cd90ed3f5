"""The failure detector: which members answer, by SWIM with the extensions of Lifeguard. Sans-I/O.

Das, Gupta, Motivala: "SWIM: Scalable Weakly-consistent Infection-style Process Group Membership Protocol", 2002;
Dadgar, Phillips, Currey: "Lifeguard: Local Health Awareness for More Accurate Failure Detection", 2018.

Each agent probes one member a second, so its cost does not grow with their number. In turn this is the next one of a
random order and the one that follows the agent in the order of runs, which lets no member wait longer than 2 s.

Inputs are ``add``, ``remove``, ``set_linked``, ``set_version``, ``learn_version``, ``set_active``, ``receive``,
``leave`` and ``handle_timer``; after each of them take ``outputs()`` (packets to send) and ``events()``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from rmpa.core.clock import earliest
from rmpa.core.counters import Counters
from rmpa.core.sizes import UINT32_MAX
from rmpa.core.timer_queue import TimerQueue
from rmpa.core.token_bucket import TokenBucket
from rmpa.discovery import limits
from rmpa.discovery.swim.dissemination import Dissemination
from rmpa.discovery.swim.events import (
    DetectorView,
    MemberFailed,
    MemberHeardOf,
    MemberLeft,
    MemberOffers,
    MemberRefuted,
    MemberSuspected,
    MemberView,
    SendSwim,
    SwimEvent,
)
from rmpa.discovery.swim.member_table import GoneMembers, Member, MemberTable
from rmpa.discovery.swim.packets import RUN_BYTES, MemberState, News, SwimKind, SwimPacket
from rmpa.discovery.swim.probing import Probing

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.guid import Guid
    from rmpa.core.identity import Identity
    from rmpa.discovery.beacon import Address

_NEVER: Final = float("-inf")
_ENDED: Final = frozenset({MemberState.FAILED, MemberState.LEFT})


class FailureDetector:
    """Probes the members of a mesh in turn, and spreads what it finds.

    Args:
        identity: This agent's own.
        rng: Uniform numbers in [0, 1); seeded by simulations.
        counters: ``swim.…``: what is refused, and what is found.
    """

    def __init__(self, identity: Identity, *, rng: Callable[[], float], counters: Counters | None = None) -> None:
        self.counters = counters if counters is not None else Counters()
        self._own = identity
        self._run = identity.instance[:RUN_BYTES]
        self._rng = rng
        self._table = MemberTable(self._run, rng)
        self._gone = GoneMembers(limits.MEMBERS_GONE_MAX, limits.MEMBERS_GONE_KEPT)
        self._hearsay = GoneMembers(limits.MEMBERS_HEARSAY_MAX, limits.MEMBERS_GONE_KEPT)
        self._news = Dissemination(identity, self._table, rng)
        self._probing = Probing(rng)
        self._suspicions: TimerQueue[int] = TimerQueue()
        self._extra = TokenBucket(limits.EXTRA_PROBES_PER_SECOND, limits.EXTRA_PROBES_PER_SECOND)
        self._syncs = TokenBucket(limits.SYNCS_PER_SECOND, 2 * limits.SYNCS_PER_SECOND)
        self._health = 0
        self._turn = 0
        self._active = self._closed = False
        self._probe_at: float | None = None
        self._stop_at: float | None = None
        self._heard_at = self._changed_at = self._synced_at = self._failed_at = _NEVER
        self._events: list[SwimEvent] = []

    # --- inputs -----------------------------------------------------------------------------------------------

    def set_active(self, now: float, *, active: bool) -> None:
        """Begin to probe, or stop; probes of others are answered in any case.

        When members have failed lately, or are suspected, it stops ``limits.SWIM_LINGER`` seconds later: often the
        failures are why the mesh has become so small, and more members that are dead are still to be found.
        """
        if self._closed:
            return
        self._stop_at = None
        if active == self._active:
            return
        if active:
            self._active = self._news.active = True
            self._probe_at = now + self._rng() * limits.PROBE_INTERVAL
            self._synced_at = now
        elif len(self._suspicions) or now - self._failed_at < limits.SWIM_LINGER:
            self._stop_at = now + limits.SWIM_LINGER
        else:
            self._stop(now)

    def _stop(self, now: float) -> None:
        self._active = self._news.active = False
        self._probe_at = self._stop_at = None
        self._synced_at = now
        self._news.stop()
        self._probing.clear()
        for member in self._table:
            self._suspicions.set(member.guid.place, None)
            member.state = MemberState.ALIVE
            member.accusers = ()

    def add(self, identity: Identity, now: float, address: Address | None = None, *, linked: bool = False) -> None:
        """Watch a member that is known to answer probes; or update what is known of it.

        Args:
            identity: The run that is a member now.
            now: Monotonic seconds.
            address: Where its packets go; ``None``: to its GUID's endpoint.
            linked: Whether there is a link with it.
        """
        guid = identity.guid
        if self._closed or guid.is_loopback != self._own.guid.is_loopback or guid.place == self._own.guid.place:
            return  # members on other machines could not probe a loopback address, so the tables would never agree
        member = self._table.at(guid.place)
        if member is not None and member.instance == identity.instance:
            member.linked = linked
            member.address = address if address is not None else member.address
            return
        if member is not None:
            self._forget(member)
        member = Member(guid, identity.instance, address if address is not None else guid.endpoint, linked=linked)
        ended = self._gone.pop(member.run)
        heard = ended or self._hearsay.pop(member.run)
        if heard is not None:
            member.incarnation, member.version = heard.incarnation, heard.version
        self._table.add(member)
        self._changed_at = now
        if ended is not None and self._active:
            # It is held to have failed, here and elsewhere, and is there: it has to refute that.
            self._suspect(member, self._run, now)
            self._probe(member, now)

    def remove(self, guid: Guid, instance: bytes, now: float, *, left: bool = False) -> None:
        """Stop watching a run; ``left``: it said goodbye, which is spread as news."""
        member = self._table.get(guid, instance)
        if member is None:
            return
        self._forget(member)
        self._changed_at = now
        if left:
            news = News(guid, member.run, MemberState.LEFT, member.incarnation, member.version)
            self._gone.add(news, now)
            self._news.spread(news, now)
        else:
            self._hearsay.add(member.news(), now)

    def set_linked(self, guid: Guid, instance: bytes, *, linked: bool) -> None:
        """A link with a member is up, or has fallen: while it is up, the member is not held to have failed."""
        member = self._table.get(guid, instance)
        if member is not None:
            member.linked = linked

    def set_version(self, version: int, now: float) -> None:
        """Spread the version of what this agent offers; 32 bits, only ever higher."""
        if version > self._news.version:
            self._news.version = version
            self._spread_own(now)

    def learn_version(self, guid: Guid, instance: bytes, version: int, now: float) -> None:
        """Take in the version of a member's offers that came otherwise than by a packet, such as over its link."""
        member = self._table.get(guid, instance)
        if member is not None:
            self._alive(member, member.incarnation, version, now)

    def leave(self) -> None:
        """Send some members the news that this agent leaves; afterwards nothing is sent, and packets are ignored."""
        if self._active and not self._closed:
            self._news.leave()
        self._closed = True

    def receive(self, packet: SwimPacket, source: Address, now: float) -> None:
        """Take in one packet.

        Args:
            packet: As parsed; of this domain.
            source: The packet's source address and port.
            now: Monotonic seconds.
        """
        if self._closed or packet.instance == self._own.instance:
            self.counters.add("swim.echo")
            return
        sender = self._table.get(packet.guid, packet.instance)
        if sender is not None and sender.instance == packet.instance:
            self._heard_at = sender.heard = now
            self._alive(sender, packet.incarnation, packet.version, now)
            for news in packet.news:
                self._take(news, now, table=packet.kind is SwimKind.TABLE)
            if packet.active and self._active and packet.digest != self._table.digest:
                self._tables_differ(sender, now)
        else:
            sender = None
            self.counters.add("swim.stranger")
            self._stranger(packet, now)
        self._answer(packet, sender, source, now)

    def next_timer(self) -> float | None:
        """When to call ``handle_timer``, in seconds of the clock; ``None``: never."""
        if self._closed:
            return None
        timers = (self._probe_at, self._news.at, self._probing.next_timer(), self._suspicions.next(), self._stop_at)
        return earliest(*timers)

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        due = self.next_timer()
        if due is None:
            return
        if now - due > limits.SWIM_LATE:
            self._excuse(now - due, now)
        for _, number, guid, run, address in self._probing.take_relays(now):
            self._news.send(SwimKind.NACK, address, sequence=number, subject=(guid, run))
        for sequence in self._probing.take_due(now):
            self._no_answer(sequence, now)
        for place in self._suspicions.take(now):
            self._suspicion_over(place, now)
        if self._stop_at is not None and self._stop_at <= now:
            self._stop(now)
        if self._probe_at is not None and self._probe_at <= now:
            self._probe_at = now + limits.PROBE_INTERVAL * (1 + self._health)
            self._turn ^= 1
            member = self._table.successor() if self._turn else self._table.next_in_turn()
            if member is not None:
                self._probe(member, now)
        if self._news.at is not None and self._news.at <= now:
            self._news.gossip(now)

    # --- outputs and views ------------------------------------------------------------------------------------

    def outputs(self) -> list[SendSwim]:
        """The packets to send, in order; each is returned once."""
        return self._news.take()

    def events(self) -> list[SwimEvent]:
        """What happened, in order; each event is returned once."""
        taken, self._events = self._events, []
        return taken

    def knows(self, instance: bytes) -> bool:
        """Whether a run is known to answer probes, though perhaps it is no member yet."""
        run = instance[:RUN_BYTES]
        return self._hearsay.get(run) is not None or self._gone.get(run) is not None

    def vouches(self, guid: Guid, instance: bytes, now: float) -> bool:
        """Whether a run is watched, and this agent has heard a member lately.

        A run that has failed is not watched any more. An agent that hears no member cannot say whether one is alive.
        """
        watched = self._table.get(guid, instance) is not None
        return self._active and watched and now - self._heard_at <= limits.SWIM_DEAF

    def member(self, guid: Guid, instance: bytes) -> MemberView | None:
        """What is known of a watched run; ``None`` if it is not watched."""
        member = self._table.get(guid, instance)
        if member is None:
            return None
        heard = None if member.heard == _NEVER else member.heard
        return MemberView(member.state, member.incarnation, member.version, heard, member.rtt)

    def view(self) -> DetectorView:
        """The state of the detector itself."""
        suspects = len(self._suspicions)
        news = self._news
        return DetectorView(
            self._active, len(self._table), suspects, self._health, news.incarnation, news.version, news.waiting
        )

    @property
    def digest(self) -> int:
        """A hash of the members with their incarnations and versions; of two tables that agree it is the same."""
        return self._table.digest

    # --- probes -----------------------------------------------------------------------------------------------

    def _probe(self, member: Member, now: float) -> None:
        sequence = self._probing.begin(member, now, 1 + self._health)
        self._news.send(SwimKind.PROBE, member.address, to=member, sequence=sequence, subject=_subject(member))

    def _probe_extra(self, member: Member, now: float) -> None:
        """Probe a member beside the regular order, within the rate of such probes."""
        if self._active and self._extra.take(now):
            self._probe(member, now)

    def _no_answer(self, sequence: int, now: float) -> None:
        """A probe was not answered in time: ask others to probe, or else suspect the member."""
        probe = self._probing.get(sequence)
        member = self._table.at(probe.place) if probe is not None else None
        if probe is None or member is None or member.run != probe.run:
            self._probing.end(sequence)
            return
        if member.heard > probe.at:
            # Only the answer got lost, or the probe: on a path that works in one direction each of them would be.
            self._probing.end(sequence)
            self.counters.add("swim.heard")
            return
        if probe.asked is None:
            # If it is dead, the one that it would probe has to be probed by another: many may have died at once.
            self._probe_extra(self._table.next_after(member), now)
            helpers = [m for m in self._table.sample(limits.INDIRECT_PROBES, member) if m.state is MemberState.ALIVE]
            self._probing.ask(sequence, len(helpers), now)
            for helper in helpers:
                subject = _subject(member)
                self._news.send(SwimKind.PROBE_REQUEST, helper.address, to=helper, sequence=sequence, subject=subject)
            return
        self._probing.end(sequence)
        if probe.asked and not probe.nacks:
            self._set_health(self._health + 1)
        if self._heard_at <= probe.at:
            self.counters.add("swim.deaf")  # nothing at all came since: it is this agent that is cut off
            return
        self.counters.add("swim.unanswered")
        self._accused(member, self._run, now)

    def _acked(self, packet: SwimPacket, sender: Member | None, now: float) -> None:
        relay = self._probing.end_relay(packet.sequence)
        if relay is not None:
            _, number, guid, run, address = relay
            if run == packet.run:
                self._news.send(SwimKind.FORWARDED_ACK, address, sequence=number, subject=(guid, run))
            return
        probe = self._probing.get(packet.sequence)
        if probe is None or sender is None or probe.run != sender.run:
            return
        self._probing.end(packet.sequence)
        if probe.asked is None:
            sender.rtt = now - probe.at
            self._probing.measured(sender.rtt)
        self._set_health(self._health - 1)

    def _answer(self, packet: SwimPacket, sender: Member | None, source: Address, now: float) -> None:
        """Do what a packet asks for, or what it answers."""
        match packet.kind:
            case SwimKind.PROBE:
                if packet.subject is not None and packet.subject[1] == self._run:
                    subject = (self._own.guid, self._run)
                    ended = self._gone.get(packet.run) if sender is None else None
                    self._news.send(
                        SwimKind.ACK, source, to=sender, sequence=packet.sequence, subject=subject, ended=ended
                    )
                else:
                    self.counters.add("swim.other_run")
            case SwimKind.ACK:
                self._acked(packet, sender, now)
            case SwimKind.PROBE_REQUEST if sender is not None and packet.subject is not None:
                self._relay(packet.subject, packet.sequence, sender, source, now)
            case SwimKind.FORWARDED_ACK if sender is not None:
                probe = self._probing.get(packet.sequence)
                if probe is not None and packet.subject is not None and packet.subject[1] == probe.run:
                    self._probing.end(packet.sequence)
                    self._set_health(self._health - 1)
            case SwimKind.NACK if sender is not None:
                self._probing.nack(packet.sequence)
            case SwimKind.SYNC if sender is not None and self._active:
                self._compare(packet, sender, now)
            case SwimKind.TABLE if sender is not None and packet.wanted and self._active:
                if self._probing.sync_answered(sender.run, now):
                    self._news.send_table(sender, packet.wanted, 0, self._ended(packet.wanted, now))
            case _:
                pass

    def _relay(self, subject: tuple[Guid, bytes], number: int, sender: Member, source: Address, now: float) -> None:
        """Probe a member for another one, which gets the answer."""
        target = self._table.get(*subject)
        if target is None:
            self._news.send(SwimKind.NACK, source, to=sender, sequence=number, subject=subject)
            return
        sequence = self._probing.begin_relay(target, number, source, now)
        if sequence is None:
            self.counters.add("swim.relays_full")
            return
        self._news.send(SwimKind.PROBE, target.address, to=target, sequence=sequence, subject=_subject(target))

    def _set_health(self, health: int) -> None:
        self._health = min(max(health, 0), limits.HEALTH_MAX)

    def _excuse(self, late: float, now: float) -> None:
        """This process was stopped or had no CPU: what others sent meanwhile is read before any of them is judged."""
        self.counters.add("swim.late")
        self._set_health(self._health + 1)
        more = late + limits.SWIM_LATE_GRACE
        self._probing.postpone(more, now)
        for member in self._table:
            if member.state is MemberState.SUSPECT:
                member.suspected = min(member.suspected + more, now)
                self._set_suspicion(member, at_least=now + limits.SWIM_LATE_GRACE)

    # --- what is held of members ------------------------------------------------------------------------------

    def _alive(self, member: Member, incarnation: int, version: int, now: float) -> None:
        """A member is alive in an incarnation, as itself or others say."""
        newer = incarnation > member.incarnation
        if incarnation < member.incarnation or (version <= member.version and not newer):
            return
        if incarnation - member.incarnation > limits.INCARNATION_LEAP:
            self.counters.add("swim.leap")
            return
        refuted = newer and member.state is MemberState.SUSPECT
        member.incarnation = incarnation
        if newer:
            member.state = MemberState.ALIVE
            member.accusers = ()
            self._suspicions.set(member.guid.place, None)
        if version > member.version:
            self._events.append(MemberOffers(member.guid, member.instance, version))
        member.version = version if newer else max(version, member.version)
        self._table.changed(member)
        self._changed_at = now
        if refuted:
            self.counters.add("swim.refuted")
            self._events.append(MemberRefuted(member.guid, member.instance))
        if member.state is MemberState.ALIVE:
            self._news.spread(member.news(), now)

    def _spread_own(self, now: float) -> None:
        self._changed_at = now
        self._news.spread_own(now)

    def _take(self, news: News, now: float, *, table: bool) -> None:
        """Take in what a member says of another one; ``table``: what it holds, perhaps for long."""
        if news.run == self._run:
            self._refute(news, now)
            return
        member = self._table.get(news.guid, news.run)
        if member is None:
            self._take_hearsay(news, now)
            return
        if news.incarnation - member.incarnation > limits.INCARNATION_LEAP:
            self.counters.add("swim.leap")
            return
        self._alive(member, news.incarnation, news.version, now)
        if news.incarnation < member.incarnation or news.state is MemberState.ALIVE or not self._active:
            return
        if news.state is MemberState.LEFT and not member.linked:
            self._end(member, MemberState.LEFT, now)
        elif table:
            if member.state is MemberState.ALIVE:
                self._probe_extra(member, now)
        elif news.state is MemberState.SUSPECT:
            self._accused(member, news.accuser, now)
        elif member.state is MemberState.SUSPECT and not member.linked:
            self._end(member, MemberState.FAILED, now)
        else:
            # It came without a suspicion before it, perhaps from a part of the mesh that was cut off: it may refute.
            self._accused(member, self._run, now, sure=True)

    def _take_hearsay(self, news: News, now: float) -> None:
        """Take in news of a run that is no member here."""
        ended = self._gone.get(news.run)
        if news.guid.is_loopback != self._own.guid.is_loopback or not self._active:
            return
        if news.state in _ENDED:
            if ended is None or (news.incarnation, news.state) > (ended.incarnation, ended.state):
                self._hearsay.pop(news.run)
                self._gone.add(news, now)
                self._news.spread(news, now)
            return
        if news.state is MemberState.SUSPECT or (ended is not None and news.incarnation <= ended.incarnation):
            return
        known = self._hearsay.get(news.run)
        if known is None or (news.incarnation, news.version) > (known.incarnation, known.version):
            self._gone.pop(news.run)
            self._hearsay.add(news, now)
            self._news.spread(news, now)
            self._events.append(MemberHeardOf(news.guid, news.run))

    def _stranger(self, packet: SwimPacket, now: float) -> None:
        """A packet of a run that is no member here shows that it answers probes."""
        if packet.guid.is_loopback != self._own.guid.is_loopback:
            return
        ended = self._gone.get(packet.run)
        if ended is not None and packet.incarnation <= ended.incarnation:
            return
        known = self._hearsay.get(packet.run)
        if known is None or packet.incarnation > known.incarnation:
            news = News(packet.guid, packet.run, MemberState.ALIVE, packet.incarnation, packet.version)
            self._hearsay.add(news, now)
            self._gone.pop(packet.run)
            self._events.append(MemberHeardOf(packet.guid, packet.run))

    def _refute(self, news: News, now: float) -> None:
        """Refute wrong news of this agent, such as that it has failed, by a higher incarnation."""
        false = news.state is not MemberState.ALIVE or news.version > self._news.version
        if not false or news.incarnation < self._news.incarnation:
            return
        if news.incarnation - self._news.incarnation > limits.INCARNATION_LEAP or news.incarnation == UINT32_MAX:
            self.counters.add("swim.leap")
            return
        self.counters.add("swim.accused")
        if news.state is not MemberState.ALIVE:
            self._set_health(self._health + 1)
        self._news.incarnation = news.incarnation + 1
        self._spread_own(now)

    def _accused(self, member: Member, accuser: bytes, now: float, *, sure: bool = False) -> None:
        """An agent had no answer of a member; ``sure``: as many as are needed had none."""
        if accuser in member.accusers or (sure and member.state is MemberState.SUSPECT):
            return
        begins = member.state is MemberState.ALIVE
        if not begins and len(member.accusers) > limits.CONFIRMATIONS_MAX:
            return
        self._suspect(member, accuser, now, sure=sure)
        self._news.spread(member.news(accuser), now)
        if begins:
            self.counters.add("swim.suspected")
            self._events.append(MemberSuspected(member.guid, member.instance))
            if accuser != self._run and self._rng() * len(self._table) < limits.CONFIRMING_PROBES:
                self._probe_extra(member, now)

    def _suspect(self, member: Member, accuser: bytes, now: float, *, sure: bool = False) -> None:
        if member.state is MemberState.ALIVE:
            member.state = MemberState.SUSPECT
            member.suspected = now
        sure_of = tuple(bytes((number,)) for number in range(limits.CONFIRMATIONS_MAX)) if sure else ()
        member.accusers = (*member.accusers, accuser, *sure_of)
        self._set_suspicion(member)

    def _set_suspicion(self, member: Member, *, at_least: float = _NEVER) -> None:
        """Set when the suspicion of a member is over: the more accusers, the sooner (Lifeguard, section 4)."""
        shortest = limits.SUSPICION_TIME * max(1.0, math.log10(len(self._table) + 1)) * (1 + self._health)
        confirmed = min(len(member.accusers) - 1, limits.CONFIRMATIONS_MAX)
        share = math.log(confirmed + 1) / math.log(limits.CONFIRMATIONS_MAX + 1)
        length = shortest * (limits.SUSPICION_FACTOR - (limits.SUSPICION_FACTOR - 1) * share)
        self._suspicions.set(member.guid.place, max(member.suspected + length, at_least))

    def _suspicion_over(self, place: int, now: float) -> None:
        member = self._table.at(place)
        if member is None or member.state is not MemberState.SUSPECT:
            return
        if member.linked:
            self._suspicions.set(place, now + limits.SUSPICION_LINKED)
        else:
            self._end(member, MemberState.FAILED, now)

    def _end(self, member: Member, state: MemberState, now: float) -> None:
        """A member has failed, or left."""
        self._forget(member)
        self._changed_at = now
        news = News(member.guid, member.run, state, member.incarnation, member.version)
        self._gone.add(news, now)
        self._news.spread(news, now)
        failed = state is MemberState.FAILED
        if failed:
            self._failed_at = now
            self._stop_at = now + limits.SWIM_LINGER if self._stop_at is not None else None
        self.counters.add("swim.failed" if failed else "swim.left")
        event = MemberFailed if failed else MemberLeft
        self._events.append(event(member.guid, member.instance))

    def _forget(self, member: Member) -> None:
        self._table.remove(member)
        self._suspicions.set(member.guid.place, None)

    # --- news and tables --------------------------------------------------------------------------------------

    def _tables_differ(self, other: Member, now: float) -> None:
        """The table of another member differs: compare them, unless news is still under way."""
        since = now - self._synced_at
        quiet = now - self._changed_at >= limits.SYNC_QUIET
        if since < limits.SYNC_INTERVAL or not (quiet or since >= limits.SYNC_OVERDUE):
            return
        self._synced_at = now
        self.counters.add("swim.syncs")
        self._probing.sync_begun(other.run, now)
        self._news.send(SwimKind.SYNC, other.address, to=other, buckets=self._table.buckets)

    def _compare(self, packet: SwimPacket, sender: Member, now: float) -> None:
        """Answer with the parts of the table that differ, and ask for the sender's."""
        if not self._syncs.take(now):
            self.counters.add("swim.syncs_limited")
            return
        wanted = 0
        for number, (ours, theirs) in enumerate(zip(self._table.buckets, packet.buckets, strict=True)):
            wanted |= (ours != theirs) << number
        if wanted:
            self._news.send_table(sender, wanted, wanted, self._ended(wanted, now))

    def _ended(self, parts: int, now: float) -> list[News]:
        return self._gone.in_buckets(parts, now - limits.SYNC_OVERDUE)


def _subject(member: Member) -> tuple[Guid, bytes]:
    return member.guid, member.run
