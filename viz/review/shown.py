"""What a page is shown: itself, the run as it stands, the field of a choice, events, the Rerun viewer."""

import asyncio
import json
from functools import partial
from pathlib import Path
from typing import Any

from starlette.background import BackgroundTask
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles

from stitch.errors import StitchError
from viz.filled_templates import render
from viz.review.chosen_field import Choice
from viz.review.jobs import Jobs
from viz.review.json_answers import asked_object, refused, told, wrong
from viz.review.news import News
from viz.review.rerun_viewer import NAMES, RerunViewer
from viz.review.run_review import RunReview

_SCRIPTS = Path(__file__).parent / "scripts"
# Scripts that the page of a run holds too.
_TEMPLATES = Path(__file__).parents[1] / "templates"
_SHARED = ("part_numbers.js", "part_drawing.js", "part_eye.js", "part_viewer.js")
_RECORDING = "recording.rrd"


class Shown:
    """Answers that change nothing; those that read files run beside the event loop."""

    def __init__(self, review: RunReview, jobs: Jobs, news: News, nonce: str) -> None:
        self.review, self.jobs, self.news, self.nonce = review, jobs, news, nonce
        self.viewer = RerunViewer()

    @property
    def routes(self) -> list[BaseRoute]:
        """Below the token."""
        return [
            Route("/", self.page),
            Route("/state", self.state),
            Route("/part", self.part),
            Route("/chosen", self.chosen, methods=["POST"]),
            Route("/events", self.events),
            Route("/rerun/{name}", self.rerun),
            *(Route(f"/scripts/{name}", partial(_file, _TEMPLATES / name)) for name in _SHARED),
            Mount("/scripts", StaticFiles(directory=_SCRIPTS)),
        ]

    def page(self, request: Request) -> Response:
        """The page, without numbers: its scripts ask for them."""
        return HTMLResponse(render("review.html.j2", nonce=self.nonce, run=self.review.run.name))

    def state(self, request: Request) -> Response:
        """The run as it stands, or why it cannot be read."""
        return told(self.review.state())

    def part(self, request: Request) -> Response:
        """As report.html holds it: {"model", "part", "predicted"}."""
        try:
            found = self.review.snapshot()
        except StitchError as error:
            return refused(error)
        held = {"part": found.part or "null", "predicted": found.predicted or "null"}  # JSON already
        text = f'{{"model": {json.dumps(found.model)}, "part": {held["part"]}, "predicted": {held["predicted"]}}}'
        warm = BackgroundTask(self.review.warm)
        return Response(text, media_type="application/json", background=warm)

    async def chosen(self, request: Request) -> Response:
        """{"views", "targets", "bins", "place", "within"}: field and numbers of a choice."""
        asked = await asked_object(request)
        try:
            choice = _choice(asked or {})
        except (ValueError, TypeError, LookupError, AttributeError):
            return wrong("a choice is {views, targets, bins, place, within}")
        try:
            return told(await asyncio.to_thread(self.review.chosen, choice))
        except StitchError as error:
            return refused(error)

    async def events(self, request: Request) -> Response:
        """Everything that happens from now on, after the commands so far."""
        first: list[dict[str, Any]] = [{"type": "job", "job": job.told} for job in self.jobs.all]
        first.append({"type": "changed", "version": self.review.version})
        return StreamingResponse(self.news.listen(first), media_type="text/event-stream")

    def rerun(self, request: Request) -> Response:
        """The Rerun viewer, and the recording that it shows."""
        name = request.path_params["name"]
        if name == _RECORDING and (self.review.run / name).is_file():
            return FileResponse(self.review.run / name)
        if name not in NAMES:
            return wrong("not found", 404)
        try:
            return FileResponse(self.viewer.file(name))
        except StitchError as error:
            return refused(error)


def _file(path: Path, request: Request) -> Response:
    return FileResponse(path)


def _choice(asked: dict[str, Any]) -> Choice:
    place = asked.get("place")
    return Choice(
        views=frozenset(str(v) for v in asked.get("views", [])),
        targets=frozenset(str(t) for t in asked.get("targets", [])),
        bins={str(name): (int(first), int(last)) for name, (first, last) in asked.get("bins", {}).items()},
        place=None if place is None else (float(place[0]), float(place[1]), float(place[2])),
        within=float(asked.get("within", 0.0)),
    )
