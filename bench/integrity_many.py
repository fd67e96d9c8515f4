"""Sessions in which a third of the views and more are wrong: what a run says of them."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from integrity_cells import VIEWS, measured
from integrity_faults import displaced, moved_clouds, shown, with_clouds

from data_synth.fixtures.in_memory import session_of
from stitch.api.pipeline import run
from stitch.errors import StitchError
from stitch.session.session import SessionData

WRONG = (5, 6, 7, 8)  # of 14 views


def many(part: str, mount: str, seed: int) -> Iterator[dict[str, Any]]:
    """Four kinds of mistakes in several views that do not stand together, each in 5 to 8 of 14 views."""
    good = session_of(measured(part, mount, seed))
    other = session_of(measured("curved_drill_plate" if part != "curved_drill_plate" else "blade", mount, seed))
    for count in WRONG:
        rng = np.random.default_rng([seed, 9, count])
        wrong = [int(v) for v in rng.permutation(VIEWS)[:count]]
        together = _twist(rng)
        table: dict[str, Callable[[SessionData], SessionData]] = {
            "each somewhere else": displaced({v: _twist(rng) for v in wrong}),
            "all off by the same": displaced(dict.fromkeys(wrong, together)),
            "scans of each other": moved_clouds(dict(zip(wrong, np.roll(wrong, 1).tolist(), strict=True))),
            "of another part": lambda s, wrong=wrong: with_clouds(s, {v: shown(other, v) for v in wrong}),
        }
        for case, fault in table.items():
            yield {"case": f"{count} of {VIEWS} {case}"} | _judged(fault(good), wrong)


def _twist(rng: np.random.Generator) -> np.ndarray:
    """Of the flange: 1° to 3° and 3 to 10 mm."""
    turn, shift = rng.standard_normal((2, 3))
    turn, shift = turn / np.linalg.norm(turn), shift / np.linalg.norm(shift)
    return np.r_[np.radians(rng.uniform(1, 3)) * turn, rng.uniform(3, 10) * shift]


def _judged(session: SessionData, wrong: list[int]) -> dict[str, Any]:
    """Refused, the wrong ones left out, or fused with some of them, which must be said."""
    start, names = time.perf_counter(), {session.views[v].name for v in wrong}
    try:
        found = run(session)
    except StitchError as error:
        return {"ended": "refused", "said": str(error), "silent": False, "seconds": time.perf_counter() - start}
    out = {item.view for item in found.left_out}
    # Of two groups that each fit, one is left out: which is right nobody can say from half of the views.
    rest = set(session.names) - names
    doubted = any(doubt.startswith("No arm scatters") for doubt in found.doubts)
    mixed = [] if rest <= out else sorted(names - out)
    return {
        "ended": "doubted" if doubted else "fused", "said": sorted(out), "mixed": mixed, "lost": len(out - names),
        "silent": bool(mixed) and not doubted, "seconds": time.perf_counter() - start,
    }  # fmt: skip
