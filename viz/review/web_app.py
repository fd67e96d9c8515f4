"""The web application of a review: the page, the run as JSON, events, and the commands that a page may ask for."""

import asyncio
import json
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from stitch.errors import StitchError
from viz.filled_templates import render
from viz.review.chosen_field import Choice
from viz.review.guard import Guard
from viz.review.jobs import Busy, Job, Jobs
from viz.review.news import News
from viz.review.rerun_viewer import NAMES, RerunViewer
from viz.review.run_review import RunReview

_SCRIPTS = Path(__file__).parent / "scripts"
_VIEWER = Path(__file__).parents[1] / "templates" / "part_viewer.js"
# Seconds between two looks at the run folder.
_LOOK = 0.5


def review_app(review: RunReview, token: str, nonce: str) -> ASGIApp:
    """The application, which answers below /TOKEN/ alone."""
    news = News()
    jobs = Jobs(news.tell, lambda: review.model)
    pages = _Pages(review, jobs, news, nonce)

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        tasks = [asyncio.create_task(work) for work in (jobs.work(), _watch(review, news))]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            for task in tasks:
                with suppress(asyncio.CancelledError):
                    await task
            pages.viewer.close()

    routes = [
        Route("/", pages.page),
        Route("/state", pages.state),
        Route("/part", pages.part),
        Route("/chosen", pages.chosen, methods=["POST"]),
        Route("/events", pages.events),
        Route("/jobs", pages.ask, methods=["POST"]),
        Route("/own", pages.own, methods=["POST"]),
        Route("/trust", pages.trust, methods=["POST"]),
        Route("/stop", pages.stop, methods=["POST"]),
        Route("/scripts/part_viewer.js", lambda _: FileResponse(_VIEWER)),
        Route("/rerun/{name}", pages.rerun),
        Mount("/scripts", StaticFiles(directory=_SCRIPTS)),
    ]
    return Guard(Starlette(routes=routes, lifespan=lifespan, exception_handlers={Exception: _fault}), token, nonce)


async def _watch(review: RunReview, news: News) -> None:
    """Tell the pages when the run folder changes, whoever changed it."""
    before = review.version
    while True:
        await asyncio.sleep(_LOOK)
        if (now := review.version) != before:
            before = now
            news.tell({"type": "changed", "version": now})


class _Pages:
    """The answers; those that read files run beside the event loop."""

    def __init__(self, review: RunReview, jobs: Jobs, news: News, nonce: str) -> None:
        self.review, self.jobs, self.news, self.nonce = review, jobs, news, nonce
        self.viewer = RerunViewer()

    def page(self, request: Request) -> Response:
        return HTMLResponse(render("review.html.j2", nonce=self.nonce, run=self.review.run.name))

    def state(self, request: Request) -> Response:
        return JSONResponse(_finite(self.review.state()))

    def part(self, request: Request) -> Response:
        """As report.html holds it: {"model", "part", "predicted"}."""
        try:
            found = self.review.snapshot()
        except StitchError as error:
            return _refused(error)
        held = {"part": found.part or "null", "predicted": found.predicted or "null"}  # JSON already
        text = f'{{"model": {json.dumps(found.model)}, "part": {held["part"]}, "predicted": {held["predicted"]}}}'
        warm = BackgroundTask(self.review.warm)
        return Response(text, media_type="application/json", background=warm)

    async def chosen(self, request: Request) -> Response:
        try:
            asked = await request.json()
            place = asked.get("place")
            choice = Choice(
                views=frozenset(str(v) for v in asked.get("views", [])),
                bins={str(name): (int(first), int(last)) for name, (first, last) in asked.get("bins", {}).items()},
                place=None if place is None else (float(place[0]), float(place[1]), float(place[2])),
                within=float(asked.get("within", 0.0)),
            )
        except (ValueError, TypeError, LookupError, AttributeError):
            return _wrong("a choice is {views, bins, place, within}")
        try:
            return JSONResponse(_finite(await asyncio.to_thread(self.review.chosen, choice)))
        except StitchError as error:
            return _refused(error)

    async def events(self, request: Request) -> Response:
        first: list[dict[str, Any]] = [{"type": "job", "job": job.told} for job in self.jobs.all]
        first.append({"type": "changed", "version": self.review.version})
        return StreamingResponse(self.news.listen(first), media_type="text/event-stream")

    async def ask(self, request: Request) -> Response:
        """{"kind": "add", "model": …, …}: a command for the queue."""
        asked = await _object(request)
        if asked is None:
            return _wrong("a command is {kind, model, …}")
        kind, model = str(asked.get("kind")), asked.get("model")
        changes = kind in ("add", "drop", "undo", "redo")
        if changes and model != self.review.model:
            return _wrong("the run has changed since this page read it; look at it again", 409)
        try:
            arguments = await asyncio.to_thread(self.review.arguments, kind, asked)
            return JSONResponse(self._submitted(kind, arguments, model if changes else None))
        except StitchError as error:
            return _refused(error)
        except Busy:
            return _wrong("too many commands wait already", 429)

    async def own(self, request: Request) -> Response:
        """{"text": …, "trust": true, "diagnose": true}: own effects, checked or tried."""
        asked = await _object(request)
        text = None if asked is None else asked.get("text")
        if asked is None or not isinstance(text, str) or not text.strip():
            return _wrong("own effects are {text, trust}")
        if asked.get("trust") is not True:
            return _wrong("this Python is run with your rights; it needs your consent", 403)
        kind = "diagnose" if asked.get("diagnose") is True else "effects"
        try:
            await asyncio.to_thread(self.review.keep_own_effects, text)
            return JSONResponse(self._submitted(kind, self.review.arguments(kind, {})))
        except (StitchError, OSError) as error:
            return _refused(error)
        except Busy:
            return _wrong("too many commands wait already", 429)

    async def trust(self, request: Request) -> Response:
        """{"trust": true}: the file of effects that the model names may be run."""
        asked = await _object(request)
        self.review.trust = asked is not None and asked.get("trust") is True
        self.news.tell({"type": "changed", "version": self.review.version})
        return JSONResponse({"trust": self.review.trust})

    async def stop(self, request: Request) -> Response:
        self.jobs.stop()
        return JSONResponse({})

    def rerun(self, request: Request) -> Response:
        """The Rerun viewer, and the recording that it shows."""
        name = request.path_params["name"]
        if name == "recording.rrd" and (self.review.run / name).is_file():
            return FileResponse(self.review.run / name)
        if name not in NAMES:
            return _wrong("not found", 404)
        try:
            return FileResponse(self.viewer.file(name))
        except StitchError as error:
            return _refused(error)

    def _submitted(self, kind: str, arguments: list[str], model: str | None = None) -> dict[str, Any]:
        """One that waits or runs already is not asked for twice."""
        same: Job | None = next(
            (j for j in self.jobs.all if j.state in ("waiting", "running") and j.arguments == arguments), None
        )
        return (same or self.jobs.submit(kind, arguments, model)).told


async def _object(request: Request) -> dict[str, Any] | None:
    try:
        found = await request.json()
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def _wrong(text: str, status: int = 400) -> Response:
    return JSONResponse({"problem": text}, status_code=status)


async def _fault(_: Request, error: Exception) -> Response:
    """A fault of the program: one line for the page and the terminal."""
    text = f"unexpected {type(error).__name__}: {error}; a fault of stitch"
    print(f"stitch: {text}", file=sys.stderr, flush=True)
    return _wrong(text, 500)


def _refused(error: Exception) -> Response:
    return _wrong(str(error), 422)


def _finite(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and value - value != 0 else value
