"""Commands of stitch, one after another, each a process of its own; everybody who listens hears how they go."""

import asyncio
import json
import os
import shlex
import signal
import sys
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

# Server-sent events: whoever listens hears everything that happens from then on.

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


_START = [sys.executable, "-P", "-c", "from stitch.cli.main import main; main()"]
_LINES, _KEPT, _WAITING = 200, 50, 8
# Seconds that a command has to clear up after it was asked to stop.
_PATIENCE = 5.0


@dataclass
class Job:
    """One command and how it goes; plain data for the browser."""

    number: int
    kind: str  # compare | diagnose | add | drop | note | report | effects
    arguments: list[str]
    model: str | None = None  # of the run it was asked for; None where any will do
    done: Callable[[], None] | None = None  # called where it has ended well
    state: str = "waiting"  # waiting | running | done | failed | stopped
    begun: float = 0.0
    seconds: float = 0.0
    lines: deque[str] = field(default_factory=lambda: deque(maxlen=_LINES))
    progress: list[dict[str, Any]] = field(default_factory=list)

    @property
    def command(self) -> str:
        """As a person types it."""
        return shlex.join(["stitch", *self.arguments])

    @property
    def told(self) -> dict[str, Any]:
        """For the browser."""
        seconds = time.monotonic() - self.begun if self.state == "running" else self.seconds
        own = {key: getattr(self, key) for key in ("number", "kind", "state", "command", "progress")}
        return own | {"seconds": round(seconds, 1), "lines": list(self.lines)}


class Busy(Exception):
    """Too many commands wait already."""


class Jobs:
    """A queue of commands; `tell` hears of every change."""

    def __init__(self, tell: Callable[[dict[str, Any]], None], model: Callable[[], str]) -> None:
        self.tell, self.model = tell, model
        self.all: deque[Job] = deque(maxlen=_KEPT)
        self._process: asyncio.subprocess.Process | None = None
        self._news = asyncio.Event()
        self._number = 0

    def submit(
        self,
        kind: str,
        arguments: Sequence[str],
        model: str | None = None,
        done: Callable[[], None] | None = None,
    ) -> Job:
        """Append a command.

        Args:
            model: version of the model it is meant for: it does not run once the run has another.
            done: called where it ends well.

        Raises:
            Busy: too many wait.
        """
        if sum(job.state == "waiting" for job in self.all) >= _WAITING:
            raise Busy
        self._number += 1
        job = Job(self._number, kind, list(arguments), model, done)
        self.all.append(job)
        self._news.set()
        self._say(job)
        return job

    @property
    def busy(self) -> bool:
        """Whether a command runs or waits."""
        return any(job.state in ("waiting", "running") for job in self.all)

    def note_done(self, kind: str, arguments: Sequence[str], seconds: float) -> Job:
        """Append a command whose work is done already, without a process of its own."""
        self._number += 1
        job = Job(self._number, kind, list(arguments), state="done", seconds=seconds)
        self.all.append(job)
        self._say(job)
        return job

    def stop(self) -> None:
        """Ask the running command to end, and forget those that wait."""
        for job in self.all:
            if job.state in ("waiting", "running"):
                running = job.state == "running"
                job.state = "stopped"
                if not running:
                    self._say(job)
        if self._process is not None:
            _interrupt(self._process)

    async def work(self) -> None:
        """Run commands as they come, until cancelled."""
        try:
            while True:
                job = next((job for job in self.all if job.state == "waiting"), None)
                if job is None:
                    self._news.clear()
                    await self._news.wait()
                elif job.model is not None and job.model != self.model():
                    job.state = "failed"
                    job.lines.append("The run has changed since this was asked for; look at it again.")
                    self._say(job)
                else:
                    try:
                        await self._run(job)
                    except Exception as error:  # the commands behind it still wait
                        job.state = "failed"
                        job.lines.append(f"{type(error).__name__}: {error}".encode(errors="replace").decode())
                        self._say(job)
        finally:
            if (process := self._process) is not None:
                _interrupt(process)
                with suppress(TimeoutError):
                    await asyncio.wait_for(process.wait(), _PATIENCE)
                _kill(process)

    async def _run(self, job: Job) -> None:
        job.state, job.begun = "running", time.monotonic()
        self._say(job)
        self._process = await asyncio.create_subprocess_exec(
            *_START,
            *job.arguments,
            env=os.environ | {"STITCH_PROGRESS": "json", "NO_COLOR": "1", "COLUMNS": "110"},
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            start_new_session=True,
            limit=2**24,
        )
        if job.state == "stopped":  # while it was being started
            _interrupt(self._process)
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            self._heard(job, line.decode(errors="replace").rstrip())
        code = await self._process.wait()
        self._process = None
        job.seconds = time.monotonic() - job.begun
        if code == 0:
            job.state = "done"  # one that was stopped too late has done its work
            if job.done is not None:
                job.done()
        elif job.state == "running":
            job.state = "failed"
        self._say(job)

    def _heard(self, job: Job, line: str) -> None:
        if line.startswith('{"progress"'):
            try:
                job.progress.append(json.loads(line))
            except ValueError:
                job.lines.append(line)
        else:
            job.lines.append(line)
        self._say(job)

    def _say(self, job: Job) -> None:
        self.tell({"type": "job", "job": job.told})


def _interrupt(process: asyncio.subprocess.Process) -> None:
    """Ask a process to end and clear up; it has to within a few seconds."""
    if process.returncode is None:
        process.send_signal(signal.SIGTERM if os.name == "nt" else signal.SIGINT)
        asyncio.get_running_loop().call_later(_PATIENCE, _kill, process)


def _kill(process: asyncio.subprocess.Process) -> None:
    if process.returncode is None:
        process.kill()
