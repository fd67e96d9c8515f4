"""`stitch review` as a process of its own, and what it needs: seconds until it listens, memory, time of a choice."""

import json
import os
import subprocess
import sys
import time
import urllib.request
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def served(run: Path):
    """`stitch review RUN`; its address and process, with the seconds until it answers."""
    words = [sys.executable, "-c", "from stitch.cli.main import main; main()", "review", str(run), "--no-browser"]
    begun = time.monotonic()
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    try:
        address = process.stderr.readline().strip()
        print(f"listens after {time.monotonic() - begun:.1f} s, {processor_seconds(process):.1f} s of one core")
        yield address, process
    finally:
        process.terminate()
        process.wait()


def processor_seconds(process: subprocess.Popen[str]) -> float:
    """What a process has used so far, where /proc tells: a busy machine does not count."""
    try:
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory(process: subprocess.Popen[str]) -> str:
    """Present and largest resident memory of the server, where /proc tells."""
    try:
        status = Path(f"/proc/{process.pid}/status").read_text()
    except OSError:
        return "memory unknown"
    sizes = {line.split(":")[0]: int(line.split()[1]) / 1e3 for line in status.splitlines() if line.startswith("Vm")}
    return f"{sizes['VmRSS']:.0f} MB, {sizes['VmHWM']:.0f} MB at most"


def choices(run: Path, address: str, process: subprocess.Popen[str]) -> None:
    """What the fields of everything, of a view and of a place cost the server."""
    view = json.loads((run / "result.json").read_text(encoding="utf-8"))["views"][0]["view"]
    for choice in ({}, {"views": [view]}, {"place": [0.0, 0.0, 0.0], "within": 50.0}):
        before = processor_seconds(process)
        asked = urllib.request.Request(f"{address}chosen", json.dumps(choice).encode(), method="POST")
        told = json.load(urllib.request.urlopen(asked))["chosen"]
        cost = processor_seconds(process) - before
        print(f"choice {choice}: rms {told['rms'] or 0:.1f} µm, {cost:.2f} s of one core; {memory(process)}")
