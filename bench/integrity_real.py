"""Mistakes in the conventions of measured scans: what the deep check says, and how a run ends."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from integrity_cells import judged
from integrity_faults import Fault, faults

from stitch.api.pipeline import run
from stitch.errors import StitchError
from stitch.session.reading.session_folder import load_session

REAL = (
    "two exchanged",
    "shifted by 1",
    "reversed",
    "inverse",
    "mount",
    "euler ZYX as xyz",
    "euler XYZ as ZYX",
    "euler xyz as XYZ",
    "poses in inches",
    "poses in m",
    "clouds scaled 1.0254",
    "clouds mirrored",
)


def real(folder: Path, done: set[tuple[str, str]]) -> Iterator[dict[str, Any]]:
    """Measured scans with mistakes in their conventions: what is said, and whether a run ends as if all were well."""
    for part in sorted(f.name for f in folder.iterdir() if (f / "session.toml").exists()):
        session = load_session(folder / part)
        table = {"nothing": Fault(lambda s: s, ())} | faults(len(session.views), np.random.default_rng(9))
        for case in ("nothing", *REAL):
            if (part, case) in done:
                continue
            wrong = table[case].apply(session)
            try:
                found = run(wrong)
                ended = f"ran, left out {', '.join(item.view for item in found.left_out) or 'none'}"
            except StitchError as error:
                ended = f"refused: {str(error).split(': ', 1)[1]}"
            yield {"part": part, "mount": session.mount, "seed": 0, "case": case, "ended": ended} | judged(
                wrong, table[case]
            )
