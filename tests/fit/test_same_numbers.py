"""A hand-eye from nothing is the same number in every run, on one thread count bit for bit."""

import os
import subprocess
import sys
import textwrap
from functools import cache

import numpy as np
import pytest

SEARCH = """
    import numpy as np
    from data_synth.fixtures.blade_cells import captured_blade
    from stitch.fit.coarse import feature_motions, find_coarse_hand_eye, sequence_motions
    _, capture = captured_blade(2, views=3, pixels=40)
    found = find_coarse_hand_eye([capture])
    T = np.stack([found.T_mount, *feature_motions(capture)[1], *sequence_motions(capture)[1]])
    print(found.source, " ".join(x.hex() for x in T.ravel().tolist()), sep="|")
"""


@cache
def searched(threads: int, cores: int, run: int) -> tuple[str, np.ndarray]:
    """What a process of its own finds: source, and hand-eye with all scan motions."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = os.environ | {name: str(threads) for name in names}
    limit = f"import os; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:{cores}])\n"
    done = subprocess.run(
        [sys.executable, "-c", limit + textwrap.dedent(SEARCH)],
        capture_output=True,
        text=True,
        env=environment,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    source, numbers = done.stdout.strip().split("|")
    return source, np.array([float.fromhex(x) for x in numbers.split()])


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be set aside here")
def test_again_and_on_other_threads():
    once, again, other = searched(2, 8, 0), searched(2, 8, 1), searched(1, 1, 0)
    assert again[0] == once[0] and np.array_equal(again[1], once[1])
    # Positions are hundreds of mm: 1e-9 of them and of rotations.
    assert other[0] == once[0]
    np.testing.assert_allclose(other[1], once[1], rtol=1e-9, atol=1e-9)
