"""Folders without scans through `stitch init`: python bench/tracker_folders.py [--seeds 100 110]

Every kind of data_synth/fixtures/tracker_folders.py, a cell of its own for each seed. Right: a session of all views, of
the true hand-eye.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from data_synth.fixtures.tracker_folders import FOLDERS, tracked_arm
from stitch.errors import InputError
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye
from stitch.plugins.intake.first_session import StatedFolder
from stitch.plugins.intake.measured_points import measured_session, write_measured
from stitch.session.capture import prepare_capture
from stitch.session.reading.session_folder import load_session

_NEAR_MM = 2.0
_RAIL = "URDF with a rail"  # whose base lies 100 mm below the arm's


def is_right(kind: str, seed: int, folder: Path) -> bool:
    """One cell through one kind of folder."""
    arm, raw = tracked_arm(seed, int(np.random.default_rng(seed).integers(8, 60))), folder / "raw"
    raw.mkdir()
    FOLDERS[kind](raw, arm)
    made = measured_session(raw, StatedFolder())
    if made is None:
        return False
    write_measured(folder / "made", made)
    session = load_session(folder / "made")
    found = closed_form_hand_eye(prepare_capture(session))
    off = found[:3, 3] - arm.T_base_sensor[:3, 3] - [0.0, 0.0, 100.0 * (kind == _RAIL)]
    return len(session.views) == len(arm.T) and float(np.linalg.norm(off)) < _NEAR_MM


def main() -> None:
    """Print how many cells of each kind are right."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(100, 110))
    seeds = range(*parser.parse_args().seeds)
    for kind in FOLDERS:
        right = 0
        for seed in seeds:
            with TemporaryDirectory() as folder:
                try:
                    right += is_right(kind, seed, Path(folder))
                except InputError as error:
                    print(f"  {kind}, seed {seed}: {error}")
        print(f"{kind}: {right} of {len(seeds)} right", flush=True)


if __name__ == "__main__":
    main()
