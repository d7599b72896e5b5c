"""Passes messages between the thread that simulates and the pages, which a server's thread serves."""

from __future__ import annotations

import asyncio
import queue
import threading
from collections import deque

MOST_REQUESTS = 100  # that wait for the simulation
LATEST = ("moment", "future")  # kinds of which a slow page gets the newest message only


class Page:
    """One open page; every method but `post` is called in the server's thread."""

    def __init__(self) -> None:
        self._loop, self._is_ready = asyncio.get_running_loop(), asyncio.Event()
        self._latest: dict[str, str] = {}
        self._others: deque[str] = deque(maxlen=MOST_REQUESTS)

    def post(self, kind: str, text: str) -> None:
        """Sends a message to the page soon; any thread may call this.

        Args:
            kind: What the message is about; of the kinds in `LATEST` a newer message replaces one that waits.
            text: The message.
        """
        try:
            self._loop.call_soon_threadsafe(self._keep, kind, text)
        except RuntimeError:  # the server has ended
            return

    async def next_messages(self) -> list[str]:
        """The messages that wait, oldest first; waits for one."""
        await self._is_ready.wait()
        self._is_ready.clear()
        texts = [*self._others, *self._latest.values()]
        self._others.clear()
        self._latest.clear()
        return texts

    def _keep(self, kind: str, text: str) -> None:
        if kind in LATEST:
            self._latest[kind] = text
        else:
            self._others.append(text)
        self._is_ready.set()


class Hub:
    """The open pages, and what they ask for.

    Attributes:
        requests: Requests in order, each with its page; `""` asks for the present settings.
    """

    def __init__(self) -> None:
        self.requests: queue.Queue[tuple[Page, str]] = queue.Queue(MOST_REQUESTS)
        self._pages: set[Page] = set()
        self._is_watched = threading.Event()

    def open(self, page: Page) -> None:
        """Adds a page, which asks for the settings."""
        self._pages = self._pages | {page}
        self.ask(page, "")
        self._is_watched.set()

    def close(self, page: Page) -> None:
        """Removes a page."""
        self._pages = self._pages - {page}
        if not self._pages:
            self._is_watched.clear()

    def ask(self, page: Page, text: str) -> None:
        """Passes on a request of a page; of a page that asks faster than the simulation answers, some are dropped."""
        try:
            self.requests.put_nowait((page, text))
        except queue.Full:
            page.post("refused", '{"refused": "too many requests wait; try again"}')

    def wait_for_page(self, seconds: float) -> bool:
        """Waits until a page is open, at most some seconds; returns whether one is."""
        return self._is_watched.wait(seconds)

    def take_requests(self) -> list[tuple[Page, str]]:
        """The requests that wait."""
        taken = []
        while True:
            try:
                taken.append(self.requests.get_nowait())
            except queue.Empty:
                return taken

    def publish(self, kind: str, text: str) -> None:
        """Sends a message to every page."""
        for page in self._pages:
            page.post(kind, text)
