"""A day of a plant through one scheduler: 10⁵ tasks of the size of ours that do nothing."""

import logging
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
from distributed import Client
from distributed.utils import open_port

from stitch.plugins.watch.batch.run_batch import BatchJob, SessionRow, rows_from

SIZES = (1_000, 10_000, 100_000)
_SENTENCE = (
    "One hand-eye leaves 41.9 µm rms where the sensor's own noise would leave 29.2 µm: the robot's poses scatter by "
    "12.2 µm and 0.1 mrad; moving each view by its own correction leaves 40 µm."
)


def nothing(job: BatchJob) -> SessionRow:
    """A row as large as that of a session, at once."""
    return SessionRow(
        str(job.session),
        job.run.name,
        str(job.run),
        False,
        None,
        False,
        _SENTENCE,
        18,
        0,
        *[41.9] * 4,
        "v007",
        42.2,
        7.1,
    )


def scheduler() -> list[str]:
    """A row a size: tasks a second, what the scheduler's process and this one hold at most, seconds of processor."""
    lines = [_row(count) for count in SIZES]
    return [
        "**Tasks that do nothing**, with arguments and results as of sessions, through a scheduler and two workers in "
        "processes of their own",
        "",
        "| sessions | s | a second | scheduler: CPU ms each | MB more (kB each) | command: MB more (kB each) |",
        "|---:|---:|---:|---:|---:|---:|",
        *lines,
    ]


def _row(count: int) -> str:
    port = open_port()
    root = Path(__file__).resolve().parent
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(root), str(root.parent), os.environ.get("PYTHONPATH", "")])
    }
    dask = [sys.executable, "-m", "dask"]
    quiet = {"env": environment, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    address = f"tcp://127.0.0.1:{port}"
    with tempfile.TemporaryDirectory() as scratch:
        served = subprocess.Popen(
            [*dask, "scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"], **quiet
        )
        options = ["--nworkers", "2", "--nthreads", "1", "--no-dashboard", "--local-directory", scratch]
        working = subprocess.Popen([*dask, "worker", address, *options], **quiet)
        try:
            return _through(count, address, psutil.Process(served.pid))
        finally:
            working.terminate()
            working.wait()
            served.terminate()
            served.wait()


def _through(count: int, address: str, served: psutil.Process) -> str:
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    own = psutil.Process()
    with Client(address, timeout=60) as client:
        client.wait_for_workers(2, timeout=60)
        jobs = [BatchJob(Path(f"/plant/cell-{i % 1000}/{i}"), Path(f"/plant/runs/{i}"), "f" * 32) for i in range(count)]
        before, held = served.memory_info().rss, own.memory_info().rss
        spent, begun = sum(served.cpu_times()[:2]), time.perf_counter()
        most = most_own = 0
        for done, _ in enumerate(rows_from(client, jobs, nothing)):
            if done % 500 == 0:
                most = max(most, served.memory_info().rss)
                most_own = max(most_own, own.memory_info().rss)
        wall = time.perf_counter() - begun
        cpu = sum(served.cpu_times()[:2]) - spent
    return (
        f"| {count:,} | {wall:.1f} | {count / wall:,.0f} | {1e3 * cpu / count:.2f} "
        f"| {_more(most - before, count)} | {_more(most_own - held, count)} |"
    )


def _more(size: float, count: int) -> str:
    return f"{size / 1e6:.0f} ({size / 1e3 / count:.1f})"
