"""`stitch serve FOLDER`: sessions that are dropped into an inbox become runs, and cells with a history.

The inbox is the queue: a session waits until its run stands below `runs`, with a mark of the content that was run. So
nothing is lost by whatever ends the program: started again, it finds what waits. A session lies in inbox/CELL/NAME, or
in inbox/NAME without a cell; its run in runs/CELL/NAME, and the history of the cell in cells/CELL.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stitch.cli.terminal import say
from stitch.errors import InputError, StitchError

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from stitch.plugins.watch.batch.run_batch import BatchJob, SessionRow

_HERE = "127.0.0.1"
# What happened, a line a session: only what failed is read again.
_ROWS = "rows.jsonl"
# A session is complete once nothing in it has changed for so long (s); and between two looks at the inbox.
_SETTLED, _LOOK = 2.0, 0.5
_SHOWN = 1000  # runs that /runs lists, the last ones


def serve(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Holds inbox, runs and cells; it is made.")],
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port to listen on.")] = 8735,
    host: Annotated[str, typer.Option("--host", help="Address; another than this machine needs --token.")] = _HERE,
    token: Annotated[
        str, typer.Option("--token", envvar="STITCH_TOKEN", help="What a request has to bring; default a new one.")
    ] = "",
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes on this machine.")] = 1,
    scheduler: Annotated[str, typer.Option("--scheduler", metavar="tcp://…", help="Workers of a Dask scheduler.")] = "",
) -> None:
    """Run the sessions that are dropped into FOLDER/inbox, and answer /cells, /runs and /metrics; ends with Ctrl-C.

    \b
    Examples:
      stitch serve fleet
      stitch serve fleet --scheduler tcp://10.0.0.5:8786
    """
    import uvicorn

    if host not in (_HERE, "localhost") and not token:
        raise InputError(f"--host {host}: everybody there could ask; to fix: state --token, or STITCH_TOKEN")
    known = token or secrets.token_urlsafe(24)
    inbox = Inbox(folder, workers, scheduler)
    threading.Thread(target=inbox.work, name="stitch-serve", daemon=True).start()
    say(f"Sessions: {inbox.folder / 'inbox'}; http://{host}:{port}/runs with the header Authorization: Bearer {known}")
    config = uvicorn.Config(serve_app(inbox, known), host=host, port=port, log_level="critical", access_log=False)
    uvicorn.Server(config).run()


class Inbox:
    """Folder of sessions that wait, of runs, and of cells."""

    def __init__(self, folder: Path, workers: int = 1, scheduler: str = "") -> None:
        self.folder = folder.resolve()
        self.workers, self.scheduler = workers, scheduler
        for name in ("inbox", "runs", "cells"):
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        self.rows = [json.loads(line) for line in self._lines()]
        self._seen: dict[Path, tuple[str, float]] = {}  # by session: its state, and since when it is so
        # Content that was tried, by session: what failed is tried again once it has changed.
        self._tried = {row["name"]: row["content"] for row in self.rows}

    def work(self) -> None:
        """Run what waits, for ever."""
        while True:
            try:
                self.work_once()
            except (StitchError, OSError) as error:  # the scheduler has gone, or the disk is full: it may come back
                say(str(error))
            time.sleep(_LOOK)

    def work_once(self) -> int:
        """Run what waits now, and return how many sessions that were."""
        from stitch.plugins.watch.batch.run_batch import run_jobs

        jobs = {job.name: (job, content) for job, content in self.waiting()}
        with closing(run_jobs([job for job, _ in jobs.values()], self.workers, self.scheduler)) as coming:
            for row in coming if jobs else ():
                self._keep(row, *jobs[row.name])
        return len(jobs)

    def waiting(self) -> Iterator[tuple[BatchJob, str]]:
        """Yield jobs of complete sessions whose content was not run, and that content."""
        from stitch.plugins.watch.batch.run_batch import BatchJob

        for file in sorted((self.folder / "inbox").glob("**/session.toml")):
            session = file.parent
            name = session.relative_to(self.folder / "inbox").as_posix()
            state = _state_of(session)
            known, since = self._seen.get(session, ("", 0.0))
            if state != known:
                self._seen[session] = (state, time.monotonic())
            elif time.monotonic() - since >= _SETTLED and self._tried.get(name) != state:
                yield (
                    BatchJob(session, self.folder / "runs" / name, secrets.token_hex(8), recording=False, place=name),
                    state,
                )

    def cells(self) -> list[dict[str, Any]]:
        """Return what is known of every cell with a history."""
        from stitch.plugins.watch.exported import report_document

        return [report_document(report) for report in self._reports()]

    def metrics(self) -> str:
        """Return the cells and the queue as OpenMetrics."""
        from stitch.plugins.watch.exported import openmetrics

        text = openmetrics(self._reports()).removesuffix("# EOF\n")
        done = sum(row["error"] is None for row in self.rows)
        counts = {"waiting": len(list(self.waiting())), "done": done, "failed": len(self.rows) - done}
        lines = [f'stitch_serve_sessions{{state="{state}"}} {count}' for state, count in counts.items()]
        return "\n".join([f"{text}# TYPE stitch_serve_sessions gauge", *lines, "# EOF", ""])

    def _reports(self) -> list[Any]:
        from stitch.plugins.watch.verb import watch

        return [watch(file.parent) for file in sorted((self.folder / "cells").glob("*/history.sqlite"))]

    def _keep(self, row: SessionRow, job: BatchJob, content: str) -> None:
        """Write what became of a session; its run joins the history of its cell."""
        from dataclasses import asdict

        from stitch.output.json_file import to_json
        from stitch.plugins.watch.verb import watch

        note = None
        cell, _, _ = row.name.partition("/")
        if row.run is not None and cell != row.name:
            try:
                watch(self.folder / "cells" / cell, [row.run])
            except StitchError as error:
                note = str(error)
        kept = json.loads(to_json(asdict(row))) | {"content": content, "time": time.time(), "note": note}
        with (self.folder / _ROWS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(kept) + "\n")
            file.flush()
            os.fsync(file.fileno())
        self._tried[row.name] = content
        self.rows.append(kept)

    def _lines(self) -> list[str]:
        """Return the whole lines of what happened; one that was being written is run again."""
        file = self.folder / _ROWS
        text = file.read_text(encoding="utf-8") if file.is_file() else ""
        whole = text[: text.rfind("\n") + 1]
        if whole != text:
            file.write_text(whole, encoding="utf-8")
        return whole.splitlines()


def serve_app(inbox: Inbox, token: str) -> ASGIApp:
    """Return the application, which answers who brings the token."""
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import JSONResponse, PlainTextResponse, Response
    from starlette.routing import Route

    def known(request: Request) -> bool:
        return hmac.compare_digest(request.headers.get("authorization", "").encode(), f"Bearer {token}".encode())

    def answer(request: Request) -> Response:
        if not known(request):
            return PlainTextResponse("a header Authorization: Bearer TOKEN is missing", 401)
        if request.url.path == "/metrics":
            return PlainTextResponse(inbox.metrics())
        if request.url.path == "/cells":
            return JSONResponse(inbox.cells())
        return JSONResponse(inbox.rows[-_SHOWN:])

    return Starlette(routes=[Route(path, answer) for path in ("/cells", "/runs", "/metrics")])


def _state_of(session: Path) -> str:
    """Return names, sizes and times of the files of a session: what changes while it is being copied."""
    digest = hashlib.sha256()
    with suppress(OSError):  # it is being moved
        for file in sorted(file for file in session.rglob("*") if file.is_file()):
            digest.update(repr((file.name, file.stat().st_size, file.stat().st_mtime_ns)).encode())
    return digest.hexdigest()[:16]
