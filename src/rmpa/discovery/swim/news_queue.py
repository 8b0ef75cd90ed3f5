"""The news that the failure detector's packets carry with them (SWIM, section 4.1: infection-style dissemination)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.discovery import limits
from rmpa.discovery.swim.packets import MemberState

if TYPE_CHECKING:
    from rmpa.discovery.swim.packets import News

_Key = tuple[int, bytes, bytes]


class NewsQueue:
    """News to be sent; the news that was sent least often comes first. Newer news of a member replaces older news.

    Suspicions of one member by different accusers count as different news, because each confirms the others.
    """

    def __init__(self) -> None:
        self._news: dict[_Key, News] = {}
        self._sent: dict[_Key, int] = {}
        self._by_sent: list[dict[_Key, None]] = [{}]  # the keys of news that was sent n times, oldest first
        self._accused: dict[tuple[int, bytes], set[bytes]] = {}

    def __len__(self) -> int:
        return len(self._news)

    def add(self, news: News) -> None:
        """Spread news; what the queue has of the same member is replaced."""
        member = (news.guid.place, news.run)
        if news.state is MemberState.SUSPECT:
            self._remove((*member, b""))
        else:
            for accuser in tuple(self._accused.get(member, ())):
                self._remove((*member, accuser))
        key = (*member, news.accuser)
        self._remove(key)
        if len(self._news) >= limits.NEWS_QUEUE_MAX:
            most = next(keys for keys in reversed(self._by_sent) if keys)
            self._remove(next(iter(most)))
        if news.accuser:
            self._accused.setdefault(member, set()).add(news.accuser)
        self._news[key] = news
        self._sent[key] = 0
        self._by_sent[0][key] = None

    def take(self, room: int, limit: int) -> list[News]:
        """News for one packet, which counts as sent.

        Args:
            room: Bytes that it may have.
            limit: How often news is sent; after that the queue drops it.
        """
        chosen: list[_Key] = []
        for keys in self._by_sent:
            for key in keys:
                size = self._news[key].size
                if size > room:
                    break
                room -= size
                chosen.append(key)
        return [self._mark_sent(key, limit) for key in chosen]

    def _mark_sent(self, key: _Key, limit: int) -> News:
        news = self._news[key]
        count = self._sent[key] + 1
        if count >= limit:
            self._remove(key)
            return news
        del self._by_sent[count - 1][key]
        if count == len(self._by_sent):
            self._by_sent.append({})
        self._by_sent[count][key] = None
        self._sent[key] = count
        return news

    def _remove(self, key: _Key) -> None:
        if self._news.pop(key, None) is None:
            return
        del self._by_sent[self._sent.pop(key)][key]
        place, run, accuser = key
        accusers = self._accused.get((place, run))
        if accuser and accusers is not None:
            accusers.discard(accuser)
            if not accusers:
                del self._accused[place, run]
