"""Five measured objects from arrays and from their folders: the same to the last bit."""

import numpy as np
import pytest

import stitch
from tests.api.same import same_folder, taken

# Minutes of work: `make check` runs it, `make test` does not.
pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", ["david", "cone", "sphere", "rubik", "gripperopen"])
def test_arrays_give_what_the_folder_gives(reghec, tmp_path, stitch_command, name):
    stitch_command("run", reghec(name), "-o", tmp_path / "command", "--no-recording")
    loaded = stitch.load_session(reghec(name))
    run = stitch.run(stitch.Session.from_arrays(**taken(loaded)))
    run.save(tmp_path / "arrays", recording=False)
    assert same_folder(tmp_path / "command", tmp_path / "arrays")
    # And once more as the camera gave them, in metres: those that the poses do not fit are refused.
    metres = {view.name: np.asarray(view.cloud.points / 1e3, np.float32) for view in loaded.views}
    given = taken(loaded) | {"clouds": metres}
    assert stitch.Session.from_arrays(**given, cloud_unit="m").length_unit == "mm"
    with pytest.raises(stitch.InputError, match='set cloud_unit = "m"'):
        stitch.Session.from_arrays(**given)
    with pytest.raises(stitch.InputError, match="the poses contradict what was measured: (inverse|mount)"):
        stitch.Session.from_arrays(**taken(loaded) | {"poses": np.linalg.inv(given["poses"])})
