"""What goes on beside other work: told in its turn, ended where nobody wants it, its errors raised where it is asked."""

from concurrent.futures import CancelledError

import numpy as np
import pytest

from stitch.runs.recorder import IterationMemory, SilentRecorder
from stitch.system.threads import begin


class _Told(SilentRecorder):
    def __init__(self) -> None:
        self.told: list[tuple[str, int]] = []

    def iteration(self, stage: str, index: int, *_: object) -> None:
        self.told.append((stage, index))


def test_iterations_are_told_in_their_order_and_not_before():
    memory, recorder = IterationMemory(), _Told()
    for index in range(3):
        memory.iteration("register", index, np.eye(4)[None], 1.0, 2.0)
    assert recorder.told == []
    memory.tell(recorder)
    assert recorder.told == [("register", 0), ("register", 1), ("register", 2)]


def test_a_stage_that_nobody_wants_ends_with_its_next_iteration():
    memory = IterationMemory()

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
