"""Rows of a recording that belong to scans, by clocks that differ."""

from pathlib import Path

import numpy as np
import pytest

from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.readings import StatedTable
from stitch.plugins.intake.stops import rows_with_scans

BEGIN = 1.7e9


@pytest.mark.parametrize("offset", [0.0, 2.6, -3.1])
def test_one_offset_of_the_clocks_puts_every_scan_into_a_rest_of_the_arm(offset):
    random = np.random.default_rng(3)
    places = random.uniform(300, 900, (9, 3))
    times = BEGIN + np.arange(0, 80, 0.5)
    # Six seconds of rest, four of motion.
    step = np.clip((times - BEGIN) % 10 - 6, 0, None)[:, None] / 4
    stop = ((times - BEGIN) // 10).astype(int)
    positions = places[stop] * (1 - step) + places[stop + 1] * step
    numbers = np.column_stack([times, positions, np.tile([0, 0, 0, 1.0], (len(times), 1))])
    header = ("timestamp", "x", "y", "z", "qx", "qy", "qz", "qw")
    raw = RawPoses("log.csv", header, numbers, ((),) * len(times), "")
    taken = BEGIN + 10 * np.arange(8) + 3 + random.uniform(-2, 2, 8)
    clouds = [Path(f"scan_{time + offset:.3f}.ply") for time in taken]
    rows = rows_with_scans(raw, clouds, None, StatedTable())
    if not offset:
        assert rows is raw
    else:
        assert "clock of the scans" in rows.words
        assert np.allclose(rows.numbers[:, 1:4], places[:8])
