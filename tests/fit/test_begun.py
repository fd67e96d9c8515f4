"""What goes on beside other work: told in its turn, ended where nobody wants it, its errors raised where it is asked."""

from concurrent.futures import CancelledError
from threading import current_thread

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.api.pipeline import run
from stitch.errors import InputError
from stitch.fit import surface_steps
from stitch.fusion.fuse import RegisteredSession, fuse_every_point
from stitch.recorder import RecorderMemory, SilentRecorder
from stitch.system.threads import begin


class _Told(SilentRecorder):
    def __init__(self) -> None:
        self.told: list[tuple[str, int]] = []

    def iteration(self, stage: str, index: int, *_: object) -> None:
        self.told.append((stage, index))


def test_iterations_are_told_in_their_order_and_not_before():
    memory, recorder = RecorderMemory(), _Told()
    for index in range(3):
        memory.iteration("register", index, np.eye(4)[None], 1.0, 2.0)
    assert recorder.told == []
    memory.replay(recorder)
    assert recorder.told == [("register", 0), ("register", 1), ("register", 2)]


def test_a_stage_that_nobody_wants_ends_with_its_next_iteration():
    memory = RecorderMemory()

    def stage() -> None:
        for index in range(10**9):
            memory.iteration("register", index, np.eye(4)[None], 1.0, 2.0)

    begun = begin(stage)
    memory.stopped = True
    with pytest.raises(CancelledError):
        begun.result(timeout=10)


def test_an_error_is_raised_where_the_result_is_asked():
    with pytest.raises(ZeroDivisionError):
        begin(lambda: 1 / 0).result(timeout=10)


def test_views_are_fused_while_they_are_screened_and_errors_are_told(monkeypatch):
    session, threads = session_of(measured_blade(2, views=3, pixels=40)), []

    def fused(registered):
        threads.append(current_thread().name)
        return fuse_every_point(registered)

    monkeypatch.setattr(surface_steps, "fuse_every_point", fused)
    found = run(session)
    own = RegisteredSession(session, found.measurement, found.model, found.measurement.capture, found.poses)
    assert threads == ["stitch-beside"]
    assert np.array_equal(found.fused.points, fuse_every_point(own)[0].points)

    def without_room(registered):
        raise InputError("no room")

    monkeypatch.setattr(surface_steps, "fuse_every_point", without_room)
    with pytest.raises(InputError, match="no room"):
        run(session)
