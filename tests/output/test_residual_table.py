"""residuals.parquet of clouds, of labelled points and of both."""

import numpy as np
import pytest
from pyarrow.parquet import read_table

from data_synth.fixtures.edits import set_cell
from stitch.cli.main import main
from stitch.numerics import frames
from stitch.session.reading.session_folder import load_session


def sees_points(folder):
    """Six labelled points on the flange, seen with 20 µm of noise."""
    loaded, rng = load_session(folder), np.random.default_rng(0)
    balls, rows = rng.normal(size=(6, 3)) * 50, ["view,target,x,y,z"]
    for view in loaded.views:
        T_scanner_flange = frames.inverse(loaded.scanner.T_mount) @ view.T_base_flange
        seen = frames.transform(T_scanner_flange, balls) + rng.normal(size=(6, 3)) * 0.02
        rows += [f"{view.name},ball{i},{x},{y},{z}" for i, (x, y, z) in enumerate(seen)]
    (folder / "points.csv").write_text("\n".join(rows) + "\n")


@pytest.mark.parametrize("kind", ["clouds", "points", "both"])
def test_residuals_with_gaps_in_the_times_and_covariates_named_like_columns(session, tmp_path, kind):
    if kind != "clouds":
        sees_points(session)
    if kind == "points":
        for row in (1, 2, 3):
            set_cell(session / "views.csv", row, "cloud", "")
    rows = (session / "views.csv").read_text().splitlines()
    more = ("time_s,residual,nx", "0,5,7", ",6,", "9,5,8")
    (session / "views.csv").write_text("\n".join(f"{a},{b}" for a, b in zip(rows, more, strict=True)) + "\n")
    with pytest.raises(SystemExit) as ended:
        main(["run", str(session), "-o", str(tmp_path / "run"), "--no-recording"])
    assert not ended.value.code
    table = read_table(tmp_path / "run" / "residuals.parquet")
    assert sorted(set(table.column_names)) == sorted(table.column_names)
    columns = {name: np.array(values) for name, values in table.to_pydict().items()}
    assert np.abs(columns["residual"]).max() < 4 and np.abs(columns["nx"]).max() <= 1
    assert ("ball0" in columns["partner"], "v001" in columns["partner"]) == (kind != "clouds", kind != "points")
    for view, *known in (("v000", 0, 5, 7), ("v001", np.nan, 6, np.nan)):
        own = columns["view"] == view
        for name, value in zip(("time_s", "covariate_residual", "covariate_nx"), known, strict=True):
            assert np.array_equal(np.unique(columns[name][own]), [value], equal_nan=True)
