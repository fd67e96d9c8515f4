"""The files of the Rerun viewer are asked of its program, which is gone afterwards."""

import time
from pathlib import Path

import pytest

from viz.review import rerun_viewer


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="/proc tells which programs run")
def test_no_program_outlives_what_was_asked_of_it(monkeypatch):
    free, ports = rerun_viewer._free_port, []
    monkeypatch.setattr(rerun_viewer, "_free_port", lambda: ports.append(free()) or ports[-1])
    viewer = rerun_viewer.RerunViewer()
    assert b"<html" in viewer.file("index.html").read_bytes().lower()
    viewer.close()
    # The launcher was waited for; what it had started belongs to nobody and may take a moment to die.
    end = time.monotonic() + 30
    while (left := {str(port).encode() for port in ports} & running()) and time.monotonic() < end:
        time.sleep(0.05)
    assert not left


def running():
    """Words of all command lines."""
    words = set()
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words.update(file.read_bytes().split(b"\0"))
        except OSError:
            continue
    return words
