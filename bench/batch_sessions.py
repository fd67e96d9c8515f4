"""Sessions for the measurements of a batch, and commands measured as a whole."""

import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.scene import load_scene
from data_synth.simulate import simulate
from data_synth.write import write_session

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Cost:
    """Of a command with all its processes."""

    wall: float  # s
    cpu: float  # s, user and system


def small_sessions(folder: Path, count: int) -> list[Path]:
    """One blade in 6 views of some 900 points, so many times, each with a name of its own."""
    first = folder / "s000"
    write_session(first, measured_blade(0, views=6, pixels=60), first.name)
    return [first, *(_copy(first, folder / f"s{i:03d}") for i in range(1, count))]


def usual_session(folder: Path) -> Path:
    """The blade scene as `stitch synth` writes it: 18 views of some 20,000 points."""
    write_session(folder, simulate(load_scene("blade"), {}, 0), folder.name)
    return folder


def _copy(session: Path, place: Path) -> Path:
    shutil.copytree(session, place)
    file = place / "session.toml"
    file.write_text(re.sub(r"(?m)^name = .*$", f'name = "{place.name}"', file.read_text()))
    return place


def measured(arguments: list[object], cores: set[int] | None = None) -> Cost:
    """Run a command of stitch as a process of its own, on some of the cores."""
    code = "from stitch.cli.main import main; main()"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    begun, before = time.perf_counter(), os.times()
    kept = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores or kept)
    try:
        subprocess.run(command, env=environment, check=True, stderr=subprocess.DEVNULL)
    finally:
        os.sched_setaffinity(0, kept)
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return Cost(time.perf_counter() - begun, cpu)
