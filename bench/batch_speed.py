"""Sixty-four small sessions: one process on one core, one on all cores, two workers."""

import os
import tempfile
from pathlib import Path

from batch_sessions import measured, small_sessions

SESSIONS = 64


def speed() -> list[str]:
    """A row a way of running them; how busy the machine was with other things stands below."""
    core = {min(os.sched_getaffinity(0))}
    ways = {
        "one worker, one core": (["--workers", "1"], core),
        "one process, all cores": (["--workers", "1"], None),
        "two workers": (["--workers", "2"], None),
    }
    rows, first = [], None
    with tempfile.TemporaryDirectory() as name:
        sessions = small_sessions(Path(name) / "sessions", SESSIONS)
        before = os.getloadavg()[0]
        for i, (way, (options, cores)) in enumerate(ways.items()):
            found = measured(["batch", *sessions, "-o", f"{name}/runs{i}", *options], cores)
            first = first or found
            rows.append(
                f"| {way} | {found.wall:.0f} | {first.wall / found.wall:.2f} | {found.cpu:.0f} "
                f"| {found.cpu / found.wall:.2f} |"
            )
    return [
        f"**{SESSIONS} small sessions** (6 views of some 900 points each, with recording and page), the whole command",
        "",
        "| | s | times one worker | CPU s | cores in use |",
        "|---|---:|---:|---:|---:|",
        *rows,
        "",
        f"{os.cpu_count()} cores; load average of the machine before: {before:.1f}, after: {os.getloadavg()[0]:.1f}.",
    ]
