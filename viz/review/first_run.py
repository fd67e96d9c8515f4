"""From a folder of scans to its first run, on the page: what `stitch init` guesses and asks, then run and diagnosis."""

import asyncio
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from stitch.errors import StitchError
from stitch.plugins.intake.make_session import make_session
from stitch.plugins.intake.refusals import Refusal
from viz.review.jobs import Busy, Jobs
from viz.review.json_answers import error_response, json_object, json_response, refusal_response


class FirstRun:
    """A folder of which there is no run yet, and the run folder that it gets."""

    def __init__(self, folder: Path, run: Path, jobs: Jobs) -> None:
        self.folder, self.run, self.jobs = folder.resolve(), run, jobs
        # What stands there belongs to a person; what this page wrote it may write again with other answers.
        self.is_session = (folder / "session.toml").is_file()
        self.wrote = False

    @property
    def routes(self) -> list[BaseRoute]:
        """Below the token."""
        own = {"/first": self.first, "/measure": self.measure}
        return [Route(path, answer, methods=["POST"]) for path, answer in own.items()]

    async def first(self, request: Request) -> Response:
        """{"options": {"unit": "mm", …}}: the session that these make of the folder, or what leads on."""
        asked = await json_object(request)
        options = None if asked is None else asked.get("options")
        if not isinstance(options, dict) or not all(isinstance(value, str) for value in options.values()):
            return error_response("answers are {options: {name: text}}")
        try:
            return json_response(await asyncio.to_thread(self._session, options))
        except Refusal as refused:
            return json_response(refused.as_dict(self.folder))
        except StitchError as error:
            return refusal_response(error)

    async def measure(self, request: Request) -> Response:
        """Run the session and diagnose the run, one after the other."""
        if self.jobs.busy:
            return error_response("it runs already", 409)
        try:
            self.jobs.submit("run", ["run", str(self.folder), "-o", str(self.run)])
            return json_response(self.jobs.submit("diagnose", ["diagnose", str(self.run)]).told)
        except Busy:
            return error_response("too many commands wait already", 429)

    def _session(self, options: dict[str, str]) -> dict[str, Any]:
        if self.is_session:
            return {"guesses": [], "not_used": []}
        made = make_session(self.folder, self.folder, options, guess=True, force=self.wrote)
        self.wrote = True
        return {"views": made.views} | made.as_dict()
