"""How long a command takes until it begins: seconds of the processor and modules, and what `run` loads when."""

import os
import subprocess
import sys

from batch_sessions import ROOT

_TIMES = 5
_MAIN = "from stitch.cli.main import main\ntry:\n    main({})\nexcept SystemExit:\n    pass\n"
_ALL = "import stitch.cli.run, stitch.cli.change, stitch.plugins.watch.watch_command, viz.review.review_command\n"
# What is loaded now, and what would be if it were not put off.
_COMMANDS = {
    "stitch --version": ("--version", ""),
    "stitch --help": ("--help", _ALL),
    "stitch run --help": ("run --help", "import stitch.cli.run\n"),
    "stitch batch --help": ("batch --help", "import stitch.plugins.watch.batch.command\n"),
}
_STEPS = {
    "before the first stage": "import stitch.cli.run\n",
    "and for the recording": "import viz.recording\n",
    "and for the page": "import viz.run_page\n",
}
_TELL = "import sys, time; print('told', time.process_time(), len(sys.modules), file=sys.stderr)\n"


def start() -> list[str]:
    """Two tables."""
    rows = []
    for command, (line, work) in _COMMANDS.items():
        code = _MAIN.format(line.split())
        now, put_off = _told(code), _told(work + code) if work else None
        rows.append(f"| `{command}` | {now} | {put_off or '– | –'} |")
    steps, code = [], ""
    for name, more in _STEPS.items():
        code += more
        steps.append(f"| {name} | {_told(code)} |")
    return [
        f"**Until a command speaks**: the process from its start to its end (the least of {_TIMES})",
        "",
        "| | CPU s | modules | CPU s with what it puts off | modules |",
        "|---|---:|---:|---:|---:|",
        *rows,
        "",
        "**What `stitch run` loads**, all in all",
        "",
        "| | CPU s | modules |",
        "|---|---:|---:|",
        *steps,
    ]


def _told(code: str) -> str:
    """Seconds of the processor and modules of a process that runs some code."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    found = []
    for _ in range(_TIMES):
        out = subprocess.run([sys.executable, "-c", code + _TELL], env=environment, capture_output=True, text=True)
        seconds, modules = out.stderr.rpartition("told ")[2].split()
        found.append((float(seconds), int(modules)))
    seconds, modules = min(found)
    return f"{seconds:.2f} | {modules:,}"
