"""Memory and seconds of a deep check of labelled points from a hundred to ten thousand views, and the cause it names.

    python bench/large_target_sessions.py > table.md

Each cell runs in a process of its own; seconds are of the processor, memory is the largest resident set.
"""

import multiprocessing
import resource
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.numerics import frames
from stitch.screening.deep_check import deep_check
from stitch.session.robot import forward
from stitch.session.session import SessionData

VIEWS = (100, 1_000, 10_000)
KNOCK = frames.exp(np.array([0.02, -0.03, 0.05, 40.0, -25.0, 10.0]))


def wrong_sign(session: SessionData) -> SessionData:
    """Joint 2 negated in the table, the poses from there."""
    assert session.robot is not None and session.joints is not None
    q = session.joints * [1, -1, 1, 1, 1, 1]
    every = zip(session.views, q, forward(session.robot, q), strict=True)
    return replace(session, views=tuple(replace(v, joints=own, T_base_flange=T) for v, own, T in every))


def wrong_unit(session: SessionData) -> SessionData:
    """Positions in inches where millimetres are stated."""
    views = []
    for view in session.views:
        T = view.T_base_flange
        views.append(replace(view, joints=None, T_base_flange=frames.make(T[:3, :3], T[:3, 3] / 25.4)))
    return replace(session, views=tuple(views))


def moved_tracker(session: SessionData) -> SessionData:
    """From three fifths of the views on the tracker stands elsewhere."""
    views = list(session.views)
    for v in range(int(0.6 * len(views)), len(views)):
        shown = views[v].sighting
        assert shown is not None
        views[v] = replace(views[v], sighting=replace(shown, points=frames.transform(KNOCK, shown.points)))
    return replace(session, views=tuple(views))


MISTAKES: dict[str, Callable[[SessionData], SessionData]] = {
    "a joint of the wrong sign": wrong_sign,
    "a wrong unit": wrong_unit,
    "a moved tracker": moved_tracker,
}


def row(case: tuple[str, int]) -> str:
    """Return one row of the table."""
    mistake, views = case
    session = MISTAKES[mistake](labelled_cell(seed=1, views=views)[0])
    began = time.process_time()
    said = "; ".join(problem.fix.split(";")[0] for problem in deep_check(session)) or "nothing"
    seconds, memory = time.process_time() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return f"| {mistake} | {views} | {seconds:.1f} | {memory:.2f} | {said} |"


def main() -> None:
    """Print the table."""
    print("| mistake | views | CPU seconds | memory, GB | what is said |\n|---|---|---|---|---|")
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for line in pool.imap(row, [(mistake, views) for mistake in MISTAKES for views in VIEWS], chunksize=1):
            print(line, flush=True)


if __name__ == "__main__":
    main()
