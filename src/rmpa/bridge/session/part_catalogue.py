"""The catalogue of one part of the bridge, topics or services, as both sides of a link compare it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.bridge.session.graph_driver import GraphDriver
    from rmpa.bridge.session.peer_session import PeerSession

ActionT = TypeVar("ActionT")
AdvertisementT = TypeVar("AdvertisementT")
_ActionT_co = TypeVar("_ActionT_co", covariant=True)


class CatalogueExports(Protocol[_ActionT_co]):
    """The outbound plan of a part: what this module offers to each peer."""

    @property
    def changes(self) -> int:
        """The number of changes of what this module offers so far."""
        ...

    @property
    def pending(self) -> bool:
        """Whether a linked peer has not been sent all changes."""
        ...

    def digest(self, peer: int) -> int | None:
        """The digest of what a linked peer was told; ``None`` while it was not told all."""
        ...

    def again(self, peer: int) -> Sequence[_ActionT_co]:
        """Begin the advertisement to a linked peer once more; return the actions of its first portion."""
        ...


class CatalogueImports(Protocol):
    """The inbound plan of a part: what the peers offer to this module."""

    def held(self, peer: int) -> Sequence[object] | None:
        """What a peer offers, as it was received; ``None`` if not all of it was kept."""
        ...


class PartCatalogue(Generic[ActionT, AdvertisementT]):
    """A ``SharedCatalogue`` of the two plans of a part and of the driver that carries out their actions.

    Args:
        exports: The outbound plan.
        imports: The inbound plan.
        driver: Has the advertisements of peers that are not applied yet.
    """

    def __init__(
        self,
        exports: CatalogueExports[ActionT],
        imports: CatalogueImports,
        driver: GraphDriver[ActionT, AdvertisementT],
    ) -> None:
        self._exports = exports
        self._imports = imports
        self._driver = driver

    @property
    def changes(self) -> int:
        """The number of changes of what this module offers so far."""
        return self._exports.changes

    @property
    def pending(self) -> bool:
        """Whether a linked peer has not been sent all changes."""
        return self._exports.pending

    def told_digest(self, session: PeerSession) -> int | None:
        """The digest of what a linked peer was told; ``None`` while it was not told all."""
        return self._exports.digest(session.peer)

    def held_offers(self, session: PeerSession) -> Sequence[object] | None:
        """What a peer offers, as it was received; ``None`` if not all of it was kept."""
        return self._imports.held(session.peer)

    def waits(self, session: PeerSession) -> bool:
        """Whether an advertisement of a peer has come and is not applied yet."""
        return self._driver.waits(session)

    def tell_again(self, session: PeerSession) -> None:
        """Begin to send a linked peer the complete catalogue once more."""
        self._driver.act(self._exports.again(session.peer))
        self._driver.schedule()
