"""Broken tables of labelled points."""

import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.errors import InputError
from stitch.session.reading.session_folder import load_session

BROKEN = [
    ("view,target,x,y\nv0,a,1,2\n", "no column 'z'"),
    ("view,target,x,y,z\nv0,a,1,2,3\nv0,a,1,2,3\n", "line 3"),
    ("view,target,x,y,z\nnobody,a,1,2,3\n", "line 2"),
    ("view,target,x,y,z\nv0,a,1,two,3\n", "y is 'two'"),
    ("view,target,x,y,z,sigma\nv0,a,1,2,3,-1\n", "sigma is -1"),
    ("view,target,x,y,z\nv0,,1,2,3\n", "target is empty"),
    ("view,target,x,y,z\n", "no rows"),
]


@pytest.mark.parametrize(("text", "told"), BROKEN)
def test_broken_points_are_refused_in_one_line(text, told, tmp_path):
    session, *_ = labelled_cell(0, views=3)
    folder = write_labelled(tmp_path / "s", session)
    (folder / "points.csv").write_text(text)
    with pytest.raises(InputError, match=told) as error:
        load_session(folder)
    assert "\n" not in str(error.value)
