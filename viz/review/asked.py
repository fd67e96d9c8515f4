"""What a page may ask for: commands of stitch, consent to Python that somebody wrote, an end of what runs."""

import asyncio
from collections.abc import Callable
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from stitch.errors import StitchError
from viz.review.jobs import Busy, Job, Jobs
from viz.review.json_answers import asked_object, refused, told, wrong
from viz.review.news import News
from viz.review.run_review import RunReview

_CHANGES = ("add", "drop", "undo", "redo")
_FULL = "too many commands wait already"


class Asked:
    """Requests that start, allow or end something."""

    def __init__(self, review: RunReview, jobs: Jobs, news: News) -> None:
        self.review, self.jobs, self.news = review, jobs, news

    @property
    def routes(self) -> list[BaseRoute]:
        """Below the token."""
        own = {"/jobs": self.command, "/own": self.own, "/trust": self.trust, "/stop": self.stop}
        return [Route(path, answer, methods=["POST"]) for path, answer in own.items()]

    async def command(self, request: Request) -> Response:
        """{"kind": "add", "model": …, …}: a command for the queue; what changes the model names the present one."""
        asked = await asked_object(request)
        if asked is None:
            return wrong("a command is {kind, model, …}")
        kind, model = str(asked.get("kind")), asked.get("model")
        changes = kind in _CHANGES
        if kind == "own":
            return wrong("own effects need consent", 403)
        if changes and model != self.review.model:
            return wrong("the run has changed since this page read it; look at it again", 409)
        try:
            arguments = await asyncio.to_thread(self.review.arguments, kind, asked)
            return told(self._submitted(kind, arguments, model if changes else None))
        except StitchError as error:
            return refused(error)
        except Busy:
            return wrong(_FULL, 429)

    async def own(self, request: Request) -> Response:
        """{"text": …, "trust": true, "diagnose": true}: own effects, checked or tried."""
        asked = await asked_object(request)
        text = None if asked is None else asked.get("text")
        if asked is None or not isinstance(text, str) or not text.strip():
            return wrong("own effects are {text, trust}")
        if asked.get("trust") is not True:
            return wrong("this Python is run with your rights; it needs your consent", 403)
        try:
            await asyncio.to_thread(self.review.keep_own_effects, text)
            words = self.review.arguments("own", asked)
            return told(self._submitted(words[0], words, done=self.review.use_own_effects))
        except (StitchError, OSError) as error:
            return refused(error)
        except Busy:
            return wrong(_FULL, 429)

    async def trust(self, request: Request) -> Response:
        """{"trust": true}: the file of effects that the model names may be run."""
        asked = await asked_object(request)
        self.review.trust = asked is not None and asked.get("trust") is True
        self.news.tell({"type": "trusted"})
        return told({"trust": self.review.trust})

    async def stop(self, request: Request) -> Response:
        """What runs ends, what waits is forgotten."""
        self.jobs.stop()
        return told({})

    def _submitted(
        self, kind: str, arguments: list[str], model: str | None = None, done: Callable[[], None] | None = None
    ) -> dict[str, Any]:
        """One that waits or runs already is not asked for twice."""
        same: Job | None = next(
            (j for j in self.jobs.all if j.state in ("waiting", "running") and j.arguments == arguments), None
        )
        return (same or self.jobs.submit(kind, arguments, model, done)).told
