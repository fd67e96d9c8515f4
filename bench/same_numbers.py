"""Do two states of the code say the same? python bench/same_numbers.py make OUT, then … compare BEFORE AFTER.

`make` gives every command and every plug-in one small case, on one thread, and keeps what it prints and writes;
PYTHONPATH says which state of the code runs: nothing of it is imported here. `compare` prints a row for every document
and ends with exit code 1 where one is missing, or differs by more than --tolerance.
"""

import argparse
import csv
import hashlib
import json
import os
import re
import resource
import shlex
import shutil
import sqlite3
import subprocess
import sys
from base64 import b64decode
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

SHARED = Path(os.environ.get("STITCH_SHARED_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
# Sessions and cells; then what `write_inputs` makes of them is there too.
_SYNTH = """
synth blade blade --views 12 --seed 3 --hide backlash=4
synth blade-table table --views 6 --seed 3
synth spheres spheres --views 10 --seed 5 --hide joint_offset=1
synth drill-plate plate --views 10 --seed 6 --hide joint_compliance=2
synth line-sweep sweep --views 6 --seed 3 --hide latency=3
synth moving-scan moving --views 12 --seed 3
synth calibration-sphere ball --views 8 --seed 3
synth car-door door --views 4 --seed 3
synth body-side side --views 4 --seed 3
synth panel skin --views 4 --seed 3
synth two-sessions days --seed 3
synth two-bases bases
synth drilling drilling
synth panel-robots robots
synth sphere-lines lines
synth window-line window
synth window-sweeps sweeps
"""
# {a|b}: one command with each. A number before it is the exit code that is right there, where it is not 0.
_COMMANDS = """
effects {|joint_compliance|--json}
check blade table spheres plate sweep moving side skin
check --deep table --json
run blade -o runs/blade --tolerance 0.1
compare runs/blade {|--with open3d}
diagnose runs/blade
explain runs/blade -o mine.py
effects --effects-file mine.py
run blade -o runs/mine --effects explained --effects-file mine.py --no-recording
next runs/blade
plan runs/blade --halve --views 2 -o plans/halve
add runs/blade --suggested
note runs/blade "new gripper" --step 0 --by nobody
reveal runs/blade blade.truth.json
export runs/blade --to ros
export runs/blade --to ros -o exports/eye.launch
export runs/blade --to urdf --parent base_link
export runs/blade --to {opencv|zivid|kuka|fanuc|abb|ur|arm-dh|arm-urdf}
export runs/blade --to {ply -o exports/blade.ply|pcd -o exports/blade.pcd|las -o exports/blade.las}
export runs/blade --to {laz -o exports/blade.laz|e57 -o exports/blade.e57|glb -o exports/blade.glb}
export runs/blade --program programs/{work.src -o exports/work.src|work.ls -o exports/work.ls --j3 own}
export runs/blade --program programs/{work.mod -o exports/work.mod --json|work.script -o exports/work.script}
report runs/blade --tolerance 0.1
run blade -o runs/plain --no-recording --register gicp
report runs/plain runs/blade -o two.html
run table -o runs/table --mesh --no-recording --json
run table -o runs/used --hand-eye runs/table --mesh watertight --no-recording
run table -o runs/light --effects range_scale,joint_offset --mesh light --no-recording --keep --memory 4GB
drop runs/light range_scale --no-recording
run table -o runs/followed --follow --views 6 --no-recording
run blade -o runs/arm --arm runs/blade --no-recording
measure runs/table
plan table --split joint_compliance gear_eccentricity --views 2 --size 250 -o plans/split
plan runs/table --for 0,0,0 --views 2
init raw --yes
run raw -o runs/raw --no-recording
detect spheres --ball any -o spheres.csv
detect board --board checkerboard:9x6:12 -o board/points.csv
run board -o runs/board --no-recording
import programs/work.{src|ls|mod|script --unit m}
import raw/poses.csv --rotation quaternion-xyzw --file-unit mm --columns x,y,z,qx,qy,qz,qw
import programs/probe.csv -o frames.csv
run spheres -o runs/spheres --no-recording
{compare|diagnose} runs/spheres
add runs/spheres joint_offset --no-recording
run plate -o runs/plate --no-recording
{compare|diagnose} runs/plate
add runs/plate --group --no-recording
run sweep -o runs/sweep --no-recording
diagnose runs/sweep
run moving -o runs/moving --no-recording
diagnose runs/moving
run day1 day3 -o runs/rig --no-recording
1 batch door side skin ball -o batch --no-recording
batch skin day1 day2 day3 day4 day5 day6 -o batch --no-recording
3 watch cell --add batch/day1 batch/day2 batch/day3 batch/day4 batch/day5 batch/day6
3 watch cell --json --no-page
watch other --add runs/blade --at 2026-01-05T08:00
3 watch cell other
watch cell --in-use batch/day6 --tolerance 0.1 --dfq cell.dfq
calibrate sphere ball --radius-free
calibrate sphere lines/sphere -o lines.json
base bases/stand.toml --report cells/base.html --recording cells/base.rrd --session cells/base
base bases/stand.toml --json
drill drilling/job.toml -o drives.csv --report cells/drill.html --recording cells/drill.rrd --session cells/drill
drill drilling/job.toml --json
panel robots/job.toml -o moves --report cells/panel.html --recording cells/panel.rrd --session cells/panel
panel robots/job.toml --json
panel robots/job.toml -o moves --drive DRIVE
calibrate sphere window/sphere -o window/hand-eye.json
fit window/window.toml -o window/found-window --report cells/fit.html --recording cells/fit.rrd --session cells/fit
fit window/body.toml -o window/found-body
fit window/window.toml --allowance free --json
seam window/seam.toml -o seam.csv --report cells/seam.html --recording cells/seam.rrd --session cells/seam
export window/found-body --program window/place.src -o exports/place.src --frame 0,0,0,0,0,0
calibrate sphere sweeps/sphere -o sweeps/hand-eye.json
fit sweeps/window.toml -o sweeps/found-window
demo demo
demo verified --verify
measure verified/run verified/part.toml --monte-carlo 200 --dfq part.dfq
verify verified/run verified/artefact -o certificate --cell cell --json
calibrate tracker data/ur10-tmac
calibrate robot data/irb120-tracker -o runs/arm-of-irb120 --at-most 2
run data/irb120-tracker -o runs/irb120 --no-recording
{compare|diagnose} runs/irb120
add runs/irb120 joint_offset joint_compliance settling link_geometry --no-recording
run data/reghec/david -o runs/david --no-recording
{compare|diagnose} runs/david
"""
# The same from Python, of clouds and poses in memory.
_PYTHON = """
import csv, numpy, plyfile, stitch
from scipy.spatial.transform import Rotation
rows = list(csv.DictReader(open("table/views.csv")))
read = lambda file: plyfile.PlyData.read(file)["vertex"]
clouds = [numpy.column_stack([read(f"table/{row['cloud']}")[axis] for axis in "xyz"]) for row in rows]
poses = [numpy.eye(4) for row in rows]
for T, row in zip(poses, rows):
    T[:3, :3] = Rotation.from_quat([float(row[key]) for key in ("qx", "qy", "qz", "qw")]).as_matrix()
    T[:3, 3] = [float(row[key]) for key in "xyz"]
session = stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", unit="mm", name="arrays")
run = stitch.run(session)
print(run, run.hand_eye, run.hand_eye.U, run.stitched, run.views[0], stitch.diagnose(run).sentence, sep="\\n")
run.save("runs/arrays")
run.plot().savefig("arrays.png")
open("arrays.html", "w").write(run._repr_html_())
print(stitch.export_run(run, "kuka"), stitch.add(run, "range_scale"), sep="\\n")
live = stitch.live(mount="eye_in_hand", unit="mm", recording="live.rrd")
for cloud, pose in zip(clouds, poses):
    print(live.add_view(cloud, pose), live.next_pose(), sep="\\n")
print(live.finish())
"""
_BOARD_SESSION = """
format = "stitch-session/1"
name = "board"
length_unit = "mm"
mount = "eye_in_hand"
[scanner]
pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""
# What needs a package that stitch can do without.
_PACKAGES = {"--to las": "laspy", "--to laz": "lazrs", "--to e57": "pye57", "detect board": "cv2"}

# Keys of JSON that are left out.
_SKIPPED = {
    "seconds": "how long a stage took",
    "versions": "of libraries, not of what they computed",
    "batch": "a name drawn for each batch",
    "content": "hash of what a session holds and where it lies",
    "of": "hashes of a run that says where it lies and how long it took",
}
# What is replaced in texts before they are compared.
_MASKS = (
    (r"([Pp]age written(?:</dt><dd>| ))\d{4}-\d\d-\d\d", r"\1DATE", "pages state their day"),
    (r"20\d\d-\d\d-\d\dT[\d:]+\+00:00(?=\W+(nobody|by))", "TIME", "when a note was written"),
    (r"(<tr><td>(?:coarse|correct|register|fuse)</td>(?:<td>[^<]*</td>){3}<td>)[\d.,]+", r"\1TIME", "of a stage"),
    (r'("seconds": )[\d.]+', r'\1"TIME"', "JSON on standard output"),
    (r"(Distance between the views \(rms\)\n)(?:  .*\n)+", r"\1TABLE\n", "has seconds; batch.json has the rest"),
    (r"\.[\w.-]+\.stitch-\w{8}\b", "TEMPORARY", "a page names the folder in which it was written"),
    (r"\b[0-9a-f]{40,64}\b", "HASH", "of documents that say where they lie and how long it took"),
    (r"\b(?:[pm]|image|C[0-9a-f]+_[0-9a-f]+_)[0-9a-f]{10}\b", "ID", "matplotlib draws names in SVGs"),
    (r"<dc:date>[^<]*", "<dc:date>DATE", "SVGs state when they were drawn"),
    (r"stitch \d+\.\d+\.\d+", "stitch VERSION", "the version is not what it computed"),
)
# Of recordings alone: names that Rerun draws anew, and when a recording began.
_DRAWN = (
    (r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}|\b(?<=view/|iner/)[0-9a-f-]*…|\[\[(\d+, ){15}\d+\]\]", "UUID"),
    (r"\b1\d{18}\b", "TIME"),
)
# What is not compared at all.
_OMITTED = (
    (r"(^|/)\.", "caches of fits, which hang on the folder's name"),
    (r"\.(sqlite-wal|sqlite-shm|pyc)$", "no results"),
)
# What is packed, a word; else a number.
_TEXT = re.compile(r"([A-Za-z0-9+/]{64,}={0,2})|([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)")
# Of the same number written otherwise: counts as different where nothing is tolerated.
_WRITTEN = 1e-300


class Entry(NamedTuple):
    """What stands at one place of a document."""

    written: str | bytes
    words: str
    numbers: NDArray[np.float64]
    each: bool = True  # differences count relative to each number, else to the largest of them


def stitch(folder: Path, number: int, line: str, right: int, drive: str) -> bool:
    """Run one command in a folder, keep what it says, and return whether its exit code is right."""
    environment = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    # No lines of progress: they say how long things take.
    environment |= {"STITCH_PROGRESS": "off", "COLUMNS": "160", "TZ": "UTC", "RERUN_ANALYTICS": "off"}
    code = "from stitch.cli.main import main; main()" if line else _PYTHON
    arguments = [drive if word == "DRIVE" else word for word in shlex.split(line)]
    began = _processor_seconds()
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=folder, env=environment, capture_output=True, text=True
    )
    name = re.sub(r"[^A-Za-z0-9.]+", "-", line or "from Python")[:80].strip("-")
    told = f"exit code {done.returncode}\n{done.stdout}\nstandard error:\n{done.stderr}"
    (folder / "said" / f"{number:03} {name}.txt").write_text(told, encoding="utf-8")
    is_right = done.returncode == right
    mark = "" if is_right else f"   exit code {done.returncode}, not {right}"
    print(f"{_processor_seconds() - began:6.1f} s  {line or 'from Python'}{mark}", file=sys.stderr, flush=True)
    return is_right


def _processor_seconds() -> float:
    """Seconds that all commands so far have had of a processor."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def make(out: Path) -> int:
    """Run all cases but those that lack something here; return how many ended as they should not."""
    for name in ("said", "exports", "plans", "cells", "programs", "raw", "board"):
        (out / name).mkdir(parents=True)
    where = "import stitch; print('runs', stitch.__file__, flush=True)"
    subprocess.run([sys.executable, "-c", where], cwd=out, check=True)
    if SHARED.is_dir():
        (out / "data").symlink_to(SHARED)
    wrong = 0
    number = 0
    drive = ""
    for line in [*_commands(_SYNTH), "", *_commands(_COMMANDS)]:
        if not line:
            write_inputs(out)
            # The program that stands for the machines is told by who made the cell.
            told = next((out / "said").glob("*panel-robots*")).read_text(encoding="utf-8")
            found = re.search(r'--drive "python (.+?)"', told)
            drive = f"{sys.executable} {found[1]}" if found else "nothing"
        number += 1
        right, command = line[:1], line[2:]
        if not right.isdigit():
            right, command = "0", line
        lacking = _lacking(command)
        if lacking:
            print(f"{lacking} is not here, left out: {command}", file=sys.stderr)
            continue
        wrong += not stitch(out, number, command, int(right), drive)
    return wrong


def _commands(table: str) -> Iterator[str]:
    """The commands of a table, one by one."""
    for line in table.strip().splitlines():
        before, _, rest = line.partition("{")
        choices, _, after = rest.partition("}")
        for choice in choices.split("|"):
            yield f"{before}{choice}{after}".strip()


def _lacking(command: str) -> str:
    """What a command needs and is not here, else nothing."""
    if re.search(r"\bdata/|runs/(irb120|david)\b", command) and not SHARED.is_dir():
        return str(SHARED)
    needed = [package for told, package in _PACKAGES.items() if f"{told} " in command]
    return next((package for package in needed if find_spec(package) is None), "")


def write_inputs(out: Path) -> None:
    """Write what no simulated session holds: six days, programs of four robots, a raw folder, a tracker, a board."""
    # Each day has half of the views of a session; before the fifth the hand-eye is another.
    for day in range(6):
        source, target = out / ("days/first", "days/second", "blade")[day // 2], out / f"day{day + 1}"
        target.mkdir()
        stated = (source / "session.toml").read_text(encoding="utf-8")
        stated = stated.replace(f'name = "{source.name}"', f'name = "{target.name}"', 1)
        (target / "session.toml").write_text(stated, encoding="utf-8")
        shutil.copytree(source / "clouds", target / "clouds")
        with (source / "views.csv").open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))[day % 2 :: 2]
        with (target / "views.csv").open("w", encoding="utf-8") as file:
            table = csv.DictWriter(file, rows[0])
            table.writeheader()
            table.writerows(row | {"time_s": 1.7676e9 + 86400 * day + float(row["time_s"])} for row in rows)
    with (out / "blade" / "views.csv").open(encoding="utf-8") as file:
        degrees = [[float(row[f"j{i}_deg"]) for i in range(1, 7)] for row in csv.DictReader(file)][:4]
    joints = [[f"{x:.4f}" for x in q] for q in degrees]
    kuka = [f"PTP {{{','.join(f'A{i + 1} {x}' for i, x in enumerate(q))},E1 0.0}} C_PTP" for q in joints]
    abb = [f"  CONST jointtarget j{i}:=[[{','.join(q)}],[{','.join(['9E9'] * 6)}]];" for i, q in enumerate(joints)]
    ur = [f"  movej([{', '.join(f'{x:.6f}' for x in np.radians(q))}], a=1.4, v=1.05)" for q in degrees]
    fanuc = [",\t".join(f"J{i + 1}= {x} deg" for i, x in enumerate(q)) for q in joints]
    fanuc = [f"P[{i + 1}]{{\n   GP1:\n\tUF : 1, UT : 1,\n\t{q}\n}};" for i, q in enumerate(fanuc)]
    texts = {
        "programs/work.src": ["DEF WORK ( )", *kuka, "END"],
        "programs/work.mod": ["MODULE Work", *abb, "ENDMODULE"],
        "programs/work.script": ["def work():", *ur, "end"],
        "programs/work.ls": ["/PROG  WORK", "/ATTR", "/MN", "   1:J P[1] 100% FINE    ;", "/POS", *fanuc, "/END"],
        "programs/probe.csv": ["Name;X [m];Y [m];Z [m];Q0;Q1;Q2;Q3", "m1;1,5;-2,25;0,125;0,8;0;0,6;0"],
    }
    with (out / "table" / "views.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    columns = ("x", "y", "z", "qx", "qy", "qz", "qw")
    texts["raw/poses.csv"] = [",".join(columns), *(",".join(row[key] for key in columns) for row in rows)]
    for row in rows:
        shutil.copy(out / "table" / row["cloud"], out / "raw")
    texts["board/session.toml"] = [_BOARD_SESSION]
    texts["board/views.csv"] = [",".join(("view", "cloud", *columns))]
    for i, turn in enumerate(Rotation.random(5, random_state=1).as_rotvec() / 6):
        R, t = Rotation.from_rotvec(turn).as_matrix(), np.array([0.0, 0.0, 200.0 + 5 * i])
        write_board_scan(out / "board" / f"{i}.pcd", R, t)
        pose = [*(-R.T @ t), *Rotation.from_matrix(R.T).as_quat()]
        texts["board/views.csv"].append(",".join((f"v{i}", f"{i}.pcd", *(f"{x:.12g}" for x in pose))))
    for name, lines in texts.items():
        (out / name).write_text("\n".join([*lines, ""]), encoding="utf-8")


def write_board_scan(file: Path, R: NDArray[np.float64], t: NDArray[np.float64]) -> None:
    """Write what a camera sees of a checkerboard of 9 by 6 squares of 12 mm; R, t put its middle before the camera."""
    side, fine, size = 12.0, 4, (240, 320)
    v, u = (np.indices((size[0] * fine, size[1] * fine)) + 0.5) / fine
    rays = np.stack([(u - size[1] / 2) / 400, (v - size[0] / 2) / 400, np.ones_like(u)], axis=2)
    points = rays * (R[:, 2] @ t / (rays @ R[:, 2]))[..., None]
    x, y = np.moveaxis((points - t) @ R, 2, 0)[:2] / side + np.array([4.5, 3.0])[:, None, None]
    is_square = (x > 0) & (x < 9) & (y > 0) & (y < 6)
    shade = np.where(is_square & ((np.floor(x) + np.floor(y)) % 2 == 0), 20.0, 230.0)
    grey = shade.reshape(size[0], fine, size[1], fine).mean(axis=(1, 3)).astype(np.uint32)
    middle = points[fine // 2 :: fine, fine // 2 :: fine]
    is_board = ((x > -1) & (x < 10) & (y > -1) & (y < 7))[fine // 2 :: fine, fine // 2 :: fine]
    noise = np.random.default_rng(0).normal(1, 2e-4, size)[..., None]
    seen = np.where(is_board[..., None], middle * noise, np.nan).astype("<f4")
    head = (
        "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {size[1]}\nHEIGHT {size[0]}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {grey.size}\nDATA binary\n"
    )
    file.write_bytes(head.encode() + np.dstack([seen, (grey * 0x010101).view("<f4")]).tobytes())


def content(file: Path, root: Path) -> dict[str, Entry]:
    """What a document says, by place; its bytes where nothing reads it."""
    try:
        return _content(file, root)
    except Exception:  # Whatever its reader raises: a broken document differs from a whole one.
        data = file.read_bytes()
        return {"bytes": Entry(data, hashlib.sha256(data).hexdigest(), np.zeros(0))}


def _content(file: Path, root: Path) -> dict[str, Entry]:
    """Numbers of clouds and tables by their names, leaves of JSON by their paths, lines of text by their numbers."""
    columns = _columns(file)
    if columns:
        return {name: _column(values) for name, values in columns.items()}
    text = _text(file)
    for pattern, put in ((re.escape(str(root)), "OUT"), *((mask[0], mask[1]) for mask in _MASKS)):
        text = re.sub(pattern, put, text)
    if file.suffix == ".json":
        return dict(_leaves(json.loads(text), ""))
    return {f"line {i + 1}": _line(line) for i, line in enumerate(text.splitlines())}


def _columns(file: Path) -> dict[str, Any]:
    """The numbers of a binary table or cloud by their names; empty for all other files."""
    if file.suffix == ".ply":
        from plyfile import PlyData

        elements = PlyData.read(file).elements
        return {f"{e.name}.{p.name}": e[p.name] for e in elements for p in e.properties}
    if file.suffix == ".parquet":
        from pyarrow.parquet import read_table

        table = read_table(file)
        return {name: table[name].to_numpy() for name in table.column_names}
    if file.suffix in (".las", ".laz") and find_spec("laspy"):
        # Its bytes hold the day on which it was written.
        from laspy import read

        points = read(file).points.array
        return {name: points[name] for name in points.dtype.names}
    if file.suffix == ".e57" and find_spec("pye57"):
        # Its bytes hold a name and a time of their own.
        from pye57 import E57

        return dict(E57(str(file)).read_scan_raw(0))
    return {}


def _column(values: Any) -> Entry:
    """A column of numbers, of lists of numbers, or of words."""
    array = np.asarray(values)
    if array.dtype == object and len(array) and not isinstance(array[0], str):
        array = np.concatenate([np.asarray(row, dtype=float).ravel() for row in array])
    if array.dtype.kind in "biuf":
        return Entry(array.tobytes(), str(array.dtype), array.astype(float).ravel(), each=False)
    return Entry(str(array.tolist()), str(array.tolist()), np.zeros(0))


def _text(file: Path) -> str:
    """A document as text; of a recording what it shows where, of a history its tables."""
    if file.suffix == ".sqlite":
        with sqlite3.connect(f"file:{file}?mode=ro", uri=True) as history:
            return "\n".join(history.iterdump())
    if file.suffix != ".rrd":
        # Pictures in pages are packed, but are text too.
        packed = r"data:image/svg\+xml;base64,([A-Za-z0-9+/=]+)"
        return re.sub(packed, lambda found: b64decode(found[1]).decode("utf-8"), file.read_text(encoding="utf-8"))
    # Rows by their entity: names of chunks, rows and views are drawn anew, and which rows share a chunk is chance.
    rerun = Path(sys.executable).parent / "rerun"
    told = subprocess.run([rerun, "rrd", "print", "-vvv", file], capture_output=True, text=True, check=True).stdout
    for pattern, put in _DRAWN:
        told = re.sub(pattern, put, told)
    entity = ""
    rows = []
    for line in told.splitlines():
        if line.startswith("Chunk("):
            entity = line.split(" - ")[1]
        elif line.startswith("│ │ row_"):
            cells = [cell.strip("│ ") for cell in line.split("┆")[1:]]
            cells = [cell for cell in cells if cell != "null" and not re.match(r"\d{4}-\d\d-\d\dT", cell)]
            rows.append(" ┆ ".join([entity, *cells]))
    return "\n".join(sorted(rows))


def _leaves(document: Any, path: str) -> Iterator[tuple[str, Entry]]:
    """The leaves of a JSON document by their paths; a list of numbers is one of them."""
    if isinstance(document, dict):
        for key, value in document.items():
            if key not in _SKIPPED:
                yield from _leaves(value, f"{path}.{key}")
    elif isinstance(document, list) and document and all(isinstance(x, (int, float)) for x in document):
        yield path, Entry(repr(document), "numbers", np.array(document, dtype=float), each=False)
    elif isinstance(document, list):
        yield path, _line(f"{len(document)} rows")
        for i, value in enumerate(document):
            yield from _leaves(value, f"{path}[{i}]")
    else:
        yield path, _line(document if isinstance(document, str) else repr(document))


def _line(text: str) -> Entry:
    """The words and the numbers of a text; what is packed counts as a word."""
    numbers = []

    def take(found: re.Match[str]) -> str:
        if found[1]:
            return found[1]
        numbers.append(float(found[2]))
        return "#"

    words = _TEXT.sub(take, text)
    return Entry(text, words, np.array(numbers, dtype=float))


def difference(a: Entry, b: Entry) -> tuple[float, str]:
    """The largest relative difference of two entries, infinite for other words, and what stands there."""
    if a.written == b.written:
        return 0.0, ""
    if a.words != b.words or a.numbers.shape != b.numbers.shape:
        return np.inf, _excerpt(a.words, b.words)
    size = np.abs(a.numbers) if a.each else np.abs(a.numbers).max(initial=0.0)
    with np.errstate(invalid="ignore"):
        off = np.abs(a.numbers - b.numbers) / np.maximum(size, 1e-12)
    is_same = (a.numbers == b.numbers) | (np.isnan(a.numbers) & np.isnan(b.numbers))
    off = np.where(is_same, _WRITTEN, np.nan_to_num(off, nan=np.inf))
    worst = int(off.argmax())
    return float(off[worst]), f"{a.numbers[worst]:.17g} and {b.numbers[worst]:.17g}"


def _excerpt(a: str, b: str) -> str:
    """Where two texts begin to differ."""
    same = next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
    start = max(same - 20, 0)
    return f"{a[start : start + 60]!r} and {b[start : start + 60]!r}"


def documents(root: Path) -> dict[str, Path]:
    """All files of a set of cases by their names, without those that are omitted."""
    files = {file.relative_to(root).as_posix(): file for file in root.rglob("*") if file.is_file()}
    return {name: file for name, file in files.items() if not any(re.search(mask[0], name) for mask in _OMITTED)}


def compare(before: Path, after: Path, tolerance: float) -> bool:
    """Print a row for every document; return whether all are there and the same within the tolerance."""
    print("| document | values | largest relative difference | where |\n|---|---:|---:|---|")
    first, second = documents(before), documents(after)
    failed = 0
    for name in sorted(first.keys() | second.keys()):
        if name not in first or name not in second:
            print(f"| {name} | – | only in {before if name in first else after} | |")
            failed += 1
            continue
        a, b = content(first[name], before), content(second[name], after)
        worst, where = _worst(a, b)
        count = sum(max(entry.numbers.size, 1) for entry in a.values())
        print(f"| {name} | {count} | {worst:.1e} | {where} |")
        failed += worst > tolerance
    total = len(first.keys() | second.keys())
    print(f"\n{total} documents, {failed} missing or different by more than {tolerance:g}.")
    return not failed and total > 0


def _worst(a: dict[str, Entry], b: dict[str, Entry]) -> tuple[float, str]:
    """The largest difference of two documents, and where."""
    worst, where = 0.0, ""
    for place in [*a, *(place for place in b if place not in a)]:
        if place not in a or place not in b:
            return np.inf, f"{place} is only in one"
        off, told = difference(a[place], b[place])
        if off > worst:
            worst, where = off, f"{place}: {told}"
    return worst, where


def main() -> None:
    """Make the cases, or compare two sets of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="what", required=True)
    commands.add_parser("make").add_argument("out", type=Path)
    comparing = commands.add_parser("compare")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    comparing.add_argument("--tolerance", type=float, default=0.0, help="Relative, of numbers; 0: written the same.")
    given = parser.parse_args()
    if given.what == "make":
        wrong = make(given.out.resolve())
        if wrong:
            sys.exit(f"{wrong} commands ended otherwise than they should")
    elif not compare(given.before.resolve(), given.after.resolve(), given.tolerance):
        sys.exit(1)


if __name__ == "__main__":
    main()
