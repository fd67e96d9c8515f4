"""A scene of one sphere, small enough to simulate in a moment."""

from pathlib import Path

import pytest

SMALL_SCENE = """
mount = "eye_to_hand"
[robot]
arm = "KUKA KR30-3"
payload = { mass = 12.0, com = [0.0, 0.0, 90.0] }
[scanner]
xyz = [1450.0, 650.0, 900.0]
looks = [-0.25, -1.0, 0.1]
x_axis = [-1.0, 0.25, 0.0]
columns = 24
rows = 24
mixed_pixels = 0.3
field_error = 0.004
dropout = 0.2
quantisation = 0.001
[part]
shape = "sphere"
parameters = { tolerance = 0.05 }
labelled = true
[plan]
views = 3
"""


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """The scene's file."""
    path = tmp_path / "small.toml"
    path.write_text(SMALL_SCENE)
    return path
