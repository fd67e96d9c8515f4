"""What a session costs: seconds of the processor, memory, bytes by file; what a day of a plant makes of it."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from batch_sessions import ROOT, small_sessions, usual_session

A_DAY = 100_000
_SECONDS_A_DAY = 86_400
# Runs its sessions one after the other; prints what the second half of them took each, and the largest memory.
_CODE = """
import os, resource, sys
from pathlib import Path
from stitch.plugins.watch.batch.run_batch import BatchJob, run_session
from stitch.system.threads import share_cores

def spent():
    now = os.times()
    return now.user + now.system

recording, places = sys.argv[1] == "True", [Path(place) for place in sys.argv[2:]]
cpu = []
for i, place in enumerate(places * 3):
    begun = spent()
    run = place.parent / f"run-{place.name}"
    row = run_session(BatchJob(place, run, str(i), True, recording, at_once=os.cpu_count()))
    assert row.error is None, row.error
    cpu.append(spent() - begun)
print(min(cpu[1:]), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
"""


def cost() -> list[str]:
    """A row a kind of session, with and without recording."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        kinds = {
            "small: 6 views of some 900 points": small_sessions(Path(name), 1)[0],
            "usual: 18 views of some 20,000 points": usual_session(Path(name) / "usual"),
        }
        for kind, session in kinds.items():
            for recording in (True, False):
                rows.append(_row(f"{kind}{'' if recording else ', no recording'}", session, recording))
    return [
        "**What a session costs** on one core, in a worker that has run one before; a day of 100,000 of them",
        "",
        "| session | CPU s | memory, MB | its files, MB | run, MB | recording | residuals | page | cloud "
        "| cores for a day's | written a day |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
        *rows,
    ]


def _row(kind: str, session: Path, recording: bool) -> str:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-c", _CODE, str(recording), str(session)]
    told = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.split()
    cpu, memory = float(told[-2]), float(told[-1])
    run = session.parent / f"run-{session.name}"
    sizes = {path.name: path.stat().st_size / 1e6 for path in run.iterdir()}
    whole = sum(sizes.values())
    own = sum(path.stat().st_size for path in session.rglob("*") if path.is_file()) / 1e6
    names = ("recording.rrd", "residuals.parquet", "report.html", "stitched.ply")
    files = " | ".join(f"{sizes[name]:.2f}" if name in sizes else "–" for name in names)
    cores = A_DAY * cpu / _SECONDS_A_DAY
    return (
        f"| {kind} | {cpu:.1f} | {memory:.0f} | {own:.1f} | {whole:.1f} | {files} | {cores:.0f} "
        f"| {A_DAY * whole / 1e3:,.0f} GB |"
    )
