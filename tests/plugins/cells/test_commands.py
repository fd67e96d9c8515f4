"""What the cells' commands hand out beside their results: sessions that close, pages and recordings that are whole."""

import csv
import hashlib
import json
import re
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from plyfile import PlyData
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import viz.cells.base_to_base
import viz.cells.drilling
import viz.cells.panel
import viz.cells.window_fit
import viz.cells.window_seam
from data_synth.cells.drilling import DrillingCell, Sizes
from data_synth.cells.drilling_job import write_job
from stitch.errors import InputError
from stitch.plugins.cells import job_files
from stitch.session.reading.session_folder import load_session
from tests.command_line import ended
from tests.in_browser import WAYS, require_for_everybody
from viz.cells.page import job_identity
from viz.page_parts import unbroken

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
JOBS = {
    "base": EXAMPLES / "base_to_base.toml",
    "drill": EXAMPLES / "drilling" / "job.toml",
    "panel": EXAMPLES / "panel" / "job.toml",
    "fit": EXAMPLES / "window" / "fit.toml",
    "seam": EXAMPLES / "window" / "seam.toml",
}
VIEWERS = {
    "base": viz.cells.base_to_base,
    "drill": viz.cells.drilling,
    "panel": viz.cells.panel,
    "fit": viz.cells.window_fit,
    "seam": viz.cells.window_seam,
}


@dataclass(frozen=True)
class Offer:
    """An entry point that is there without an installation."""

    writer: object

    def load(self):
        return self.writer


@pytest.fixture(scope="module")
def handed_out(tmp_path_factory):
    """Every command once, with recording, page and session; Rerun strict. The fit: its map and its document too."""
    folder = tmp_path_factory.mktemp("cells")
    further, printed = {"fit": ("-o", folder / "map", "--json")}, {}
    part = {"stitch.cell_recordings": "record", "stitch.cell_reports": "write_page"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(job_files, "entry_points", lambda group, name: [Offer(getattr(VIEWERS[name], part[group]))])
        rr.set_strict_mode(True)
        try:
            for command, job in JOBS.items():
                files = ("--recording", folder / f"{command}.rrd", "--report", folder / f"{command}.html")
                own = further.get(command, ())
                printed[command] = ended(command, job, *files, "--session", folder / command, *own).out
        finally:
            rr.set_strict_mode(False)
    (folder / "fit.json").write_text(printed["fit"])
    return folder


def rows(file):
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def numbers(table, names):
    return np.array([[float(row[name]) for name in names.split()] for row in table])


def placed_points(folder):
    """Targets' names and places (N, 3) in the frame where they stand still, by the session's files alone."""
    mount = tomllib.loads((folder / "session.toml").read_text())
    pose = np.array(mount["scanner"]["pose"])
    table = rows(folder / "points.csv")
    views = {row["view"]: row for row in rows(folder / "views.csv")}
    out = []
    for row, p in zip(table, numbers(table, "x y z"), strict=True):
        view = views[row["view"]]
        R = Rotation.from_quat([float(view[k]) for k in ("qx", "qy", "qz", "qw")])
        t = np.array([float(view[k]) for k in "xyz"])
        seen = pose[:3, :3] @ p + pose[:3, 3]
        out.append(R.apply(seen) + t if mount["mount"] == "eye_in_hand" else R.inv().apply(seen - t))
    return [row["target"] for row in table], np.array(out)


@pytest.mark.parametrize("name", ["base", "drill", "fit", "seam", *(f"panel/{robot}" for robot in "ABCDEF")])
def test_every_session_is_readable(handed_out, name):
    session = load_session(handed_out / name)
    assert session.scanner.T_mount is not None
    assert len(session.views) == len(rows(handed_out / name / "views.csv"))


def test_panel_session_holds_one_rigid_flange(handed_out):
    """Robot A has no leg offset: its reflectors stay where they are on the flange, within the tracker's noise."""
    names, _ = placed_points(handed_out / "panel" / "A")
    for target in ("r1", "r2", "r3"):
        assert sum(n == target for n in names) == 40
    assert chance(handed_out / "panel" / "A") > 1e-4
    # Leg 4 of robot C is 0.5 mm too long for its controller: the session still holds what that does.
    assert chance(handed_out / "panel" / "C") < 1e-12
    assert "leg4_mm" in rows(handed_out / "panel" / "C" / "views.csv")[0]


def chance(folder):
    """Of so large a scatter of the reflectors on the flange, if only the tracker's stated sigma made it."""
    names, places = placed_points(folder)
    sigma = numbers(rows(folder / "points.csv"), "sigma")
    own = [np.array(names) == target for target in dict.fromkeys(names)]
    sums = [(((places[k] - places[k].mean(axis=0)) / sigma[k]) ** 2).sum() for k in own]
    return chi2.sf(sum(sums), places.size - 3 * len(own))


def test_base_session_puts_the_tip_where_the_robot_says(handed_out):
    _, places = placed_points(handed_out / "base")
    # The rod is read to 0.1 mm and 0.1 mrad at 4 m.
    assert np.linalg.norm(places, axis=1).max() < 1e-3


def test_drilling_session_keeps_the_distances_of_the_holes(tmp_path):
    """A cell without errors of its robot and camera: the session's holes are as far apart as the true ones."""
    exact = Sizes(stretch=0.0, wave=0.0, repeat=0.0, pixel=0.0, tool_tilt=0.0)
    cell = DrillingCell(4, exact)
    write_job(tmp_path / "job", cell)
    ended("drill", tmp_path / "job" / "job.toml", "--session", tmp_path / "s")
    names, places = placed_points(tmp_path / "s")
    true = np.array([cell.actual[name][0] for name in names])
    # The height of a hole over the flange is read with 0.03 mm, its place by the camera to about 0.01.
    assert np.abs(pdist(places) - pdist(true)).max() < 0.1


@pytest.mark.parametrize("command", JOBS)
def test_recording_is_whole(handed_out, command):
    program, path = Path(sys.executable).with_name("rerun"), handed_out / f"{command}.rrd"
    assert subprocess.run([program, "rrd", "verify", path], capture_output=True, check=False).returncode == 0
    printed = subprocess.run([program, "rrd", "print", path], capture_output=True, text=True, check=False).stdout
    wanted = {
        "base": "/world/stand/rail",
        "drill": "/world/errors/before/1",
        "panel": "/world/shape/after",
        "fit": "/world/part\\ 1/deviation",
        "seam": "/world/stations/8/gap",
    }
    for entity in ("/words", wanted[command]):
        assert entity in printed


@pytest.mark.parametrize(
    "command, wanted",
    [
        ("base", "R1 to R2 is 0.6073 m by the stand"),
        ("drill", "<td>1001</td>"),
        ("drill", "The plate of holes is 0.296 ± 0.013 mm off its stated height"),
        ("panel", "Leg 4 of robot C"),
        ("fit", "Worst cells"),
        ("fit", "by 0.040 mm (1 σ), and all 688 cells of the map are within 0.5 mm."),
        ("seam", "8 stations: 8 good"),
    ],
)
def test_page_needs_nothing_beside_it(handed_out, command, wanted):
    page = (handed_out / f"{command}.html").read_text()
    assert not re.search(r"""(src|href)=["'](?!data:)""", page)
    assert unbroken(wanted) in page


def test_all_pages_have_the_block_of_a_run(handed_out):
    """Job in place of session; the light is there where the job or the command states what is allowed."""
    for command in JOBS:
        page = (handed_out / f"{command}.html").read_text()
        labels = re.findall(r"<dt>(.*?)</dt>", page)
        assert {"Job", "Measured", "Page written", "Arm", "stitch", "SHA-256 of the job"} <= set(labels)
        assert f"<dd>{JOBS[command].name}</dd>" in page
        assert ('class="light' in page) == (command != "drill")


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("command", JOBS)
def test_everybody_can_read_and_reach_a_page(browser, handed_out, command, way):
    require_for_everybody(browser, handed_out / f"{command}.html", way)


def test_the_hash_of_a_job_is_that_of_all_it_names(tmp_path):
    """A cloud that a table names counts, and so does nothing that lies beside it unnamed."""
    (tmp_path / "job.toml").write_text('[tables]\nscans = "scans.csv"\nname = "other"')
    (tmp_path / "scans.csv").write_text("file,x\na.xyz,1\n")
    (tmp_path / "a.xyz").write_text("0 0 0")
    first = dict(job_identity(tmp_path / "job.toml", [("Measured", "")]))["SHA-256 of the job"]
    (tmp_path / "b.xyz").write_text("0 0 0")
    same = dict(job_identity(tmp_path / "job.toml", [("Measured", "")]))["SHA-256 of the job"]
    (tmp_path / "a.xyz").write_text("0 0 1")
    other = dict(job_identity(tmp_path / "job.toml", [("Measured", "")]))["SHA-256 of the job"]
    by_hand = hashlib.sha256()
    for name in ("job.toml", "scans.csv", "a.xyz"):
        by_hand.update(name.encode() + b"\0" + (tmp_path / name).read_bytes())
    assert first == same != other == by_hand.hexdigest()[:16]


def test_refused_readings_get_a_page_that_shows_the_contradiction(tmp_path, monkeypatch):
    """R2 read 0.2 m short of where its rod puts it."""
    text = JOBS["base"].read_text()
    (tmp_path / "bad.toml").write_text(text.replace("length = 4.4084", "length = 4.2084"))
    assert text != (tmp_path / "bad.toml").read_text()
    monkeypatch.setattr(job_files, "entry_points", lambda group, name: [Offer(viz.cells.base_to_base.write_page)])
    ended("base", tmp_path / "bad.toml", "--report", tmp_path / "page.html", code=1)
    assert "no transform is given" in (tmp_path / "page.html").read_text()


def test_expected_shape_is_what_the_commanded_clamps_do():
    """A clamp that is lifted by what its three points need leaves nothing; one point alone cannot turn it."""
    from stitch.plugins.cells.panel import read_panel_job, solve_panel_job

    job = read_panel_job(JOBS["panel"])
    result = solve_panel_job(job)
    remaining = viz.cells.panel.expected_after(job, result)
    assert np.abs(remaining).max() < 0.05
    assert result.shape_largest.max() > 3.0


def test_a_fit_is_where_the_part_stands_and_serves_the_seam(handed_out, tmp_path):
    part = json.loads((handed_out / "fit.json").read_text())["parts"][0]
    place = [3567.7, -2954.3, 1932.9]  # of the example's pane, mm
    assert np.abs(np.array(part["T_base_part"])[:3, 3] - place).max() < 1.0
    assert part["points_in_forbidden"]["gripper"] > 0
    # Three times the scanner's noise of 0.05 mm.
    assert PlyData.read(handed_out / "map" / "deviation.ply")["vertex"]["deviation"].std() < 0.15
    for file in JOBS["seam"].parent.glob("s*"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "fit.json").write_bytes((handed_out / "map" / "fit.json").read_bytes())
    text = JOBS["seam"].read_text()
    (tmp_path / "seam.toml").write_text(text.split("[part]")[0] + 'fit = "fit.json"\n')
    seams = json.loads(ended("seam", tmp_path / "seam.toml", "--json", "-o", tmp_path / "out.csv").out)
    assert len(seams) == 8
    assert {row["verdict"] for row in seams} == {"good"}


def test_session_never_overwrites(handed_out):
    told = ended("drill", JOBS["drill"], "--session", handed_out / "drill", code=2)
    assert "exists already; name another folder" in told.err


def test_page_into_a_missing_folder_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(job_files, "entry_points", lambda group, name: [Offer(viz.cells.drilling.write_page)])
    with pytest.raises(InputError, match="its folder does not exist"):
        job_files.write_recording_and_page("drill", None, tmp_path / "nowhere" / "page.html")
    monkeypatch.setattr(job_files, "entry_points", lambda group, name: [])
    with pytest.raises(InputError, match="no writer for `stitch drill`"):
        job_files.write_recording_and_page("drill", tmp_path / "x.rrd", None)
    assert not list(tmp_path.iterdir())
