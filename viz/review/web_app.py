"""The web application of a review: what is shown, what may be asked for, and who hears that the run has changed."""

import asyncio
import hmac
import json
import secrets
import socket
import sys
import time
import webbrowser
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stitch.errors import InputError, StitchError
from stitch.output.stored_run import read_documents
from viz.page_parts import render
from viz.review.chosen_field import Choice
from viz.review.first_run import FirstRun
from viz.review.jobs import Busy, Job, Jobs, News
from viz.review.json_answers import LARGEST_BODY, error_response, fault, json_object, json_response, refusal_response
from viz.review.rerun_viewer import NAMES, RerunViewer
from viz.review.run_review import RunReview

# Who may ask: a browser on this machine that knows the token; and what a page of ours may load.

# A name that resolves to 127.0.0.1 may belong to somebody else (DNS rebinding).
HOSTS = ("127.0.0.1", "localhost")
_PAGE = (
    "default-src 'none'; script-src 'self'; style-src 'nonce-{nonce}'; img-src 'self' data:; connect-src 'self'; "
    "frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# The Rerun viewer is WebAssembly with a script and styles of its own; it reaches this server alone.
_VIEWER = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
# The page of a run in a frame without an origin of its own: it reaches nothing.
_SCREEN = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'self'; sandbox allow-scripts"
)


class Guard:
    """Answers nobody who does not name this machine and the token; passes the rest on below the token."""

    def __init__(self, app: ASGIApp, token: str, nonce: str) -> None:
        self.app, self.prefix, self.nonce = app, f"/{token}", nonce

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, or refuse."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        headers, path = Headers(scope=scope), scope["path"]
        refused = self._refused(headers, path)
        if refused is not None or scope["type"] != "http":
            await PlainTextResponse(*(refused or ("not found", 404)))(scope, receive, send)
            return
        inner = path[len(self.prefix) :] or "/"
        policy = _VIEWER if inner.startswith("/rerun/") else _PAGE.format(nonce=self.nonce)
        policy = _SCREEN if inner == "/screen" else policy
        more = {
            "content-security-policy": policy,
            "referrer-policy": "no-referrer",
            "x-content-type-options": "nosniff",
            "cross-origin-resource-policy": "same-origin",
        }

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *((k.encode(), v.encode()) for k, v in more.items())]
            await send(message)

        await self.app(scope | {"path": inner, "raw_path": inner.encode()}, receive, answer)

    def _refused(self, headers: Headers, path: str) -> tuple[str, int] | None:
        host = headers.get("host", "")
        if host.partition(":")[0] not in HOSTS:
            return "this address is not mine", 421
        origin = headers.get("origin")
        if origin is not None and origin != f"http://{host}":
            return "a page from elsewhere", 403
        known = path[: len(self.prefix)]
        if not hmac.compare_digest(known.encode(), self.prefix.encode()) or path[len(self.prefix) :][:1] not in (
            "",
            "/",
        ):
            return "not found; open the address that stitch review printed", 404
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > LARGEST_BODY:
            return f"more than {LARGEST_BODY} bytes", 413
        return None


# What a page may ask for: commands of stitch, consent to Python that somebody wrote, an end of what runs.

_CHANGES = ("add", "group", "drop", "undo", "redo")
_FULL = "too many commands wait already"


class ReviewActions:
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
        asked = await json_object(request)
        if asked is None:
            return error_response("a command is {kind, model, …}")
        kind, model = str(asked.get("kind")), asked.get("model")
        changes = kind in _CHANGES
        if kind == "own":
            return error_response("own effects need consent", 403)
        if changes and model != self.review.model:
            return error_response("the run has changed since this page read it; look at it again", 409)
        try:
            arguments = await asyncio.to_thread(self.review.arguments, kind, asked)
            begun = time.monotonic()
            if changes and not self.jobs.busy and await asyncio.to_thread(self.review.restore, kind, asked):
                job = self.jobs.note_done(kind, arguments, time.monotonic() - begun)
                self.news.tell({"type": "changed", "version": self.review.version})
                return json_response(job.told)
            return json_response(self._submitted(kind, arguments, model if changes else None))
        except StitchError as error:
            return refusal_response(error)
        except Busy:
            return error_response(_FULL, 429)

    async def own(self, request: Request) -> Response:
        """{"text": …, "trust": true, "diagnose": true}: own effects, checked or tried."""
        asked = await json_object(request)
        text = None if asked is None else asked.get("text")
        if asked is None or not isinstance(text, str) or not text.strip():
            return error_response("own effects are {text, trust}")
        if asked.get("trust") is not True:
            return error_response("this Python is run with your rights; it needs your consent", 403)
        try:
            await asyncio.to_thread(self.review.keep_own_effects, text)
            words = self.review.arguments("own", asked)
            return json_response(self._submitted(words[0], words, done=self.review.use_own_effects))
        except (StitchError, OSError) as error:
            return refusal_response(error)
        except Busy:
            return error_response(_FULL, 429)

    async def trust(self, request: Request) -> Response:
        """{"trust": true}: the file of effects that the model names may be run."""
        asked = await json_object(request)
        self.review.trust = asked is not None and asked.get("trust") is True
        self.news.tell({"type": "trusted"})
        return json_response({"trust": self.review.trust})

    async def stop(self, request: Request) -> Response:
        """End the running job and drop the waiting ones."""
        self.jobs.stop()
        return json_response({})

    def _submitted(
        self, kind: str, arguments: list[str], model: str | None = None, done: Callable[[], None] | None = None
    ) -> dict[str, Any]:
        """One that waits or runs already is not asked for twice."""
        same: Job | None = next(
            (j for j in self.jobs.all if j.state in ("waiting", "running") and j.arguments == arguments), None
        )
        return (same or self.jobs.submit(kind, arguments, model, done)).told


# What a page is shown: itself, the run as it stands, the field of a choice, events, the Rerun viewer.

_SCRIPTS = Path(__file__).parent / "scripts"
# Scripts that the page of a run holds too.
_TEMPLATES = Path(__file__).parents[1] / "templates"
_SHARED = ("part_numbers.js", "part_drawing.js", "part_eye.js", "part_viewer.js", "drawn_plots.js", "screen.js")
_RECORDING = "recording.rrd"


class ReviewPages:
    """Answers that change nothing; those that read files run beside the event loop."""

    def __init__(self, review: RunReview, jobs: Jobs, news: News, nonce: str, first: FirstRun | None) -> None:
        self.review, self.jobs, self.news, self.nonce, self.first = review, jobs, news, nonce, first
        self.viewer = RerunViewer()

    @property
    def routes(self) -> list[BaseRoute]:
        """Below the token."""
        return [
            Route("/", self.page),
            Route("/state", self.state),
            Route("/part", self.part),
            Route("/screen", self.screen),
            Route("/chosen", self.chosen, methods=["POST"]),
            Route("/events", self.events),
            Route("/rerun/{name}", self.rerun),
            *(Route(f"/scripts/{name}", partial(_file, _TEMPLATES / name)) for name in _SHARED),
            Mount("/scripts", StaticFiles(directory=_SCRIPTS)),
        ]

    def page(self, request: Request) -> Response:
        """The page, without numbers: its scripts ask for them."""
        if self.first is not None and not (self.review.run / "result.json").is_file():
            return HTMLResponse(render("first_run.html.j2", nonce=self.nonce, folder=self.first.folder.name))
        return HTMLResponse(render("review.html.j2", nonce=self.nonce, run=self.review.run.name))

    def state(self, request: Request) -> Response:
        """The run as it stands, or why it cannot be read."""
        return json_response(self.review.state())

    def screen(self, request: Request) -> Response:
        """The page of the run as it stands."""
        try:
            return HTMLResponse((self.review.run / "report.html").read_text(encoding="utf-8"))
        except OSError:
            return PlainTextResponse("the page is on its way", 404)

    def part(self, request: Request) -> Response:
        """As report.html holds it: {"model", "part", "predicted"}."""
        try:
            found = self.review.snapshot()
        except StitchError as error:
            return refusal_response(error)
        held = {"part": found.part or "null", "predicted": found.predicted or "null"}  # JSON already
        text = f'{{"model": {json.dumps(found.model)}, "part": {held["part"]}, "predicted": {held["predicted"]}}}'
        warm = BackgroundTask(self.review.warm)
        return Response(text, media_type="application/json", background=warm)

    async def chosen(self, request: Request) -> Response:
        """{"views", "targets", "bins", "place", "within"}: field and numbers of a choice."""
        asked = await json_object(request)
        try:
            if asked is None:
                raise ValueError
            choice = _choice(asked)
        except (ValueError, TypeError, LookupError, AttributeError):
            return error_response("a choice is {views, targets, bins, place, within}")
        try:
            return json_response(await asyncio.to_thread(self.review.chosen, choice))
        except StitchError as error:
            return refusal_response(error)

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
            return error_response("not found", 404)
        try:
            return FileResponse(self.viewer.file(name))
        except StitchError as error:
            return refusal_response(error)


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


# Seconds between two looks at the run folder.
_LOOK = 0.5


def review_app(review: RunReview, token: str, nonce: str, scans: Path | None = None) -> ASGIApp:
    """The application, which answers below /TOKEN/ alone.

    Args:
        scans: folder of which there is no run yet; the review begins once there is.
    """
    news = News()
    jobs = Jobs(news.tell, lambda: review.model)
    first = None if scans is None else FirstRun(scans, review.run, jobs)
    pages = ReviewPages(review, jobs, news, nonce, first)
    routes = [*pages.routes, *ReviewActions(review, jobs, news).routes, *(first.routes if first else ())]

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

    return Guard(Starlette(routes=routes, lifespan=lifespan, exception_handlers={Exception: fault}), token, nonce)


async def _watch(review: RunReview, news: News) -> None:
    """Tell the pages when the run folder changes, whoever changed it."""
    before = review.version
    while True:
        await asyncio.sleep(_LOOK)
        if (now := review.version) != before:
            before = now
            news.tell({"type": "changed", "version": now})


_HERE = "127.0.0.1"
# Seconds that open pages have to go when the program ends.
_GRACE = 1


def serve_review(
    folder: Path, output: Path | None, port: int, *, browser: bool, effects_file: Path | None, trust: bool
) -> None:
    """Serve until Ctrl-C.

    Args:
        folder: of a run, or of scans or a session that are run first.
        output: run folder of scans; None: `runs/NAME`.

    Raises:
        InputError: no such folder or file of effects, a run of these scans that is there already, or a port that is
            taken.
    """
    scans = folder if folder.is_dir() and not (folder / "result.json").exists() else None
    run = folder if scans is None else output or Path("runs") / folder.resolve().name
    if scans is None:
        read_documents(run)
    elif (run / "result.json").exists():
        raise InputError(f"{run}: a run is there; to fix: `stitch review {run}`, or name another with -o")
    elif not any(scans.iterdir()):
        raise InputError(f"{scans}: an empty folder; to fix: name a run, a session, or scans with their poses")
    if effects_file is not None and not effects_file.is_file():
        raise InputError(f"{effects_file}: no such file; --effects-file names a Python file with @effect functions")
    token, nonce = secrets.token_urlsafe(24), secrets.token_urlsafe(16)
    listening = _socket(port)
    address = f"http://{_HERE}:{listening.getsockname()[1]}/{token}/"
    found = RunReview(run.resolve(), None if effects_file is None else effects_file.resolve(), trust)
    config = uvicorn.Config(
        review_app(found, token, nonce, scans),
        log_level="critical",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=_GRACE,
    )
    print(f"  {address}", file=sys.stderr, flush=True)
    opened = browser and webbrowser.open(address)
    how = "Ctrl-C ends it." if opened else "Open this address in a browser on this machine; Ctrl-C ends it."
    print(how, file=sys.stderr, flush=True)
    uvicorn.Server(config).run(sockets=[listening])


def _socket(port: int) -> socket.socket:
    """A socket of this machine alone.

    Raises:
        InputError: the port is taken, or not ours.
    """
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((_HERE, port))
        listening.listen()  # a browser that comes before the server has begun waits
    except OSError as error:
        listening.close()
        raise InputError(f"--port {port}: {error.strerror}; to fix: name another, or leave it out") from None
    return listening
