"""Open3D's own poses of a simulated blade: near the truth, near the run, the same twice, and what stitch says of them."""

import json
import sys

import numpy as np
import pytest

import stitch
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.cli.main import main
from stitch.numerics import frames
from stitch.output.comparison.open3d_witness import open3d_witness
from tests.needs import needs_open3d


@pytest.fixture(scope="module")
def cell():
    """What six views of a blade measured."""
    needs_open3d()
    return measured_blade(0, views=6, mount="eye_in_hand", pixels=60)


@pytest.fixture(scope="module")
def run(cell):
    return stitch.run(session_of(cell))


@pytest.fixture(scope="module")
def witness(run):
    return open3d_witness(run)


def test_the_witness_lies_near_the_truth_and_near_the_run(cell, run, witness):
    """Against the simulator, between views: no frame that both would have to share."""
    true = frames.inverse(cell.T_reference_scanner[:-1]) @ cell.T_reference_scanner[1:]
    found = frames.inverse(witness.poses[:-1]) @ witness.poses[1:]
    turn = np.linalg.norm(frames.log(frames.inverse(true) @ found)[:, :3], axis=1)
    assert np.median(turn) < 5e-3
    assert witness.views == tuple(run.session.names) and witness.pairs >= len(witness.views) - 1
    spacing = 2.0
    assert np.median(witness.shift) < spacing and np.median(np.abs(witness.to_run)) < spacing / 4


def test_a_view_that_the_run_has_elsewhere_is_the_one_that_differs(run, witness):
    """The run's own pose of one view is turned about the part by hand; Open3D starts where the model puts it."""
    poses = run.poses.copy()
    poses[2, :3, 3] += [3.0, 0.0, 0.0]
    moved = open3d_witness(run.with_fit(poses=poses))
    assert int(np.argmax(moved.shift - witness.shift)) == 2
    assert any(line.startswith(f"{witness.views[2]} differs most") for line in moved.sentences("mm"))


def test_the_side_that_is_nearer_to_the_truth_is_named(cell, run, witness):
    """Against the simulator's poses: whoever has the smaller errors between views has the smaller overlaps too."""

    def off(poses):
        true = frames.inverse(cell.T_reference_scanner[:-1]) @ cell.T_reference_scanner[1:]
        apart = frames.log(frames.inverse(true) @ frames.inverse(poses[:-1]) @ poses[1:])
        return np.median(np.linalg.norm(apart[:, 3:], axis=1))

    assert off(run.poses) < off(witness.poses)
    ours, theirs = np.median(witness.overlaps, axis=0)
    assert ours < theirs
    rng = np.random.default_rng(4)
    spoilt = run.poses @ frames.exp(np.column_stack([np.zeros((6, 3)), rng.normal(0, 0.5, (6, 3))]))
    worse = open3d_witness(run.with_fit(poses=spoilt))
    assert off(spoilt) > off(worse.poses)
    ours, theirs = np.median(worse.overlaps, axis=0)
    assert theirs < ours
    assert any(line.startswith("Open3D is nearer in") for line in worse.sentences("mm"))


def test_compare_with_open3d_writes_the_witness_and_says_what_differs(run, witness, tmp_path, capsys):
    folder = run.save(tmp_path / "run", recording=False)
    with pytest.raises(SystemExit) as ended:
        main(["compare", str(folder), "--with", "open3d"])
    assert not ended.value.code
    told = " ".join(capsys.readouterr().out.split())
    assert "registered the same scans by" in told and "From its cloud to this one: half within" in told
    document = json.loads((folder / "witness.json").read_text())
    assert [row["view"] for row in document["views"]] == list(witness.views)
    # On one thread Open3D repeats to the last bit.
    again = open3d_witness(stitch.load_run(folder))
    assert [row["shift"] for row in document["views"]] == again.shift.tolist()
    assert (folder / "witness.png").stat().st_size > 10_000


def test_where_open3d_is_missing_one_line_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "open3d", None)
    for program, said in (("open3d", "Open3D is not installed"), ("pcl", "--with pcl: to fix: open3d")):
        with pytest.raises(SystemExit) as ended:
            main(["compare", str(tmp_path), "--with", program])
        assert ended.value.code == 2 and said in capsys.readouterr().err
