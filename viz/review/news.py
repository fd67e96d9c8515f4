"""Server-sent events: whoever listens hears everything that happens from then on."""

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Any

# Seconds of silence after which a line keeps the connection open.
_QUIET = 15.0
_BEHIND = 500


class News:
    """Events for every open page."""

    def __init__(self) -> None:
        self._listeners: set[asyncio.Queue[dict[str, Any]]] = set()

    def tell(self, event: dict[str, Any]) -> None:
        """To all; a page that does not listen any more loses its place and comes back."""
        for queue in list(self._listeners):
            if queue.qsize() >= _BEHIND:
                self._listeners.discard(queue)
            else:
                queue.put_nowait(event)

    async def listen(self, first: list[dict[str, Any]]) -> AsyncIterator[str]:
        """Events as text, `first` before the others."""
        queue: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._listeners.add(queue)
        try:
            for event in first:
                yield _text(event)
            while queue in self._listeners:
                try:
                    yield _text(await asyncio.wait_for(queue.get(), _QUIET))
                except TimeoutError:
                    yield ": still here\n\n"
        finally:
            self._listeners.discard(queue)


def _text(event: dict[str, Any]) -> str:
    return f"data: {json.dumps(event)}\n\n"
