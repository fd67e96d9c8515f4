"""Everything is in the picture, whatever its shape and from where it is looked at."""

import numpy as np
import pytest

from stitch.numerics import frames
from viz.blueprint import eye_for

HALF_FIELD = np.tan(np.radians(55.0) / 2)  # of the viewer's field, upwards


@pytest.mark.parametrize("sides", [(500.0, 300.0, 80.0), (60.0, 60.0, 400.0), (1.0, 0.02, 0.5), (3.0, 3.0, 3.0)])
@pytest.mark.parametrize("aspect", [0.68, 1.5])
def test_all_is_in_the_picture_and_fills_it(sides, aspect):
    generator = np.random.default_rng(int(sum(sides)))
    points = generator.uniform(-0.5, 0.5, (400, 3)) * sides + [700.0, -20.0, 5.0]
    axes = frames.exp(generator.standard_normal(6))[:3, :3]
    eye = eye_for(points, axes, axes[1], aspect)
    position, target = (np.array(at.as_arrow_array().to_pylist()[0]) for at in (eye.position, eye.look_target))
    ahead = (target - position) / np.linalg.norm(target - position)
    np.testing.assert_allclose(ahead, -axes[2], atol=1e-4)
    depth = (points - position) @ ahead
    across = np.abs((points - position) @ axes[0] / depth) / (aspect * HALF_FIELD)
    upwards = np.abs((points - position) @ axes[1] / depth) / HALF_FIELD
    assert max(across.max(), upwards.max()) < 1
    assert max(across.max(), upwards.max()) > 0.8
