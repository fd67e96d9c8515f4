"""The pages say what is there: paths, names, the walk of a cloud, diffs that work, output that is printed."""

import math
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import typer

import stitch
from bench.readme_output import commands, printed, shown
from stitch.cli.main import build
from stitch.effects import EFFECTS
from stitch.effects.user_file import load
from stitch.writing.run_folder import write_run

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
FOLDERS = ("stitch", "viz", "data_synth", "bench", "tests", "docs", "examples")
# Files of somebody's own, of sessions and of run folders.
OTHERS = {"mine.py", "session.toml", "model.toml", "robot.toml", "my-cell.toml", "job.toml", "stand.toml"}
# Words that the glossary replaces.
PRIVATE = re.compile(r"\bsuspects?\b|look-?alikes?|\bmend(s|ed)?\b|\bgross errors?\b", re.IGNORECASE)


@pytest.fixture(scope="module")
def paths() -> list[str]:
    """Every file of the project's folders, from its root."""
    files = (file for folder in FOLDERS for file in (ROOT / folder).rglob("*") if "__pycache__" not in file.parts)
    return [str(file.relative_to(ROOT)) for file in files]


@pytest.fixture(scope="module")
def code(paths) -> set[str]:
    """Every word of the code, of the packaging and of the tables in it."""
    files = [ROOT / path for path in paths if path.endswith((".py", ".toml", ".j2", ".csv"))]
    files += [ROOT / "pyproject.toml", ROOT / "Makefile"]
    return {word for file in files for word in re.findall(r"\w+", file.read_text(encoding="utf-8"))}


def quoted(page: Path) -> list[str]:
    """Everything in single backticks, outside blocks of code."""
    return re.findall(r"`([^`\n]+)`", without_blocks(page))


def without_blocks(page: Path) -> str:
    """A page without its blocks of code and output."""
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_path_and_link_of_a_page_exists(page, paths):
    named = {path for text in quoted(page) for path in re.findall(r"[\w/-]+\.(?:py|toml)\b", text)}
    gone = [p for p in named if p not in OTHERS and not any(f == p or f.endswith(f"/{p}") for f in paths)]
    assert not gone
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    assert not [link for link in links if not (page.parent / link).exists()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_name_of_a_page_is_in_the_code(page, code):
    names = [text for text in quoted(page) if re.fullmatch(r"[A-Za-z_][\w.]*(\(\))?", text)]
    assert not [name for name in names if name.rstrip("()").split(".")[-1] not in code]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_use_the_field_s_words(page):
    text = without_blocks(page).split("## How things are said")[0]
    assert not [found.group() for found in PRIVATE.finditer(text)]


@pytest.fixture(scope="module")
def options() -> dict[str, set[str]]:
    """Every command of `stitch`, those of `calibrate` by both words, with its options."""
    group = typer.main.get_command(build())
    found = dict(group.commands)
    found |= {f"calibrate {name}": command for name, command in found.pop("calibrate").commands.items()}
    return {name: {o for p in command.params for o in (*p.opts, *p.secondary_opts)} for name, command in found.items()}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_of_a_page_has_the_options_that_it_shows(page, options):
    text = page.read_text(encoding="utf-8")
    lines = [*re.findall(r"^(?:\$ |    )?(?:\.venv/bin/)?stitch (.+)$", text, re.MULTILINE)]
    lines += [text.removeprefix("stitch ") for text in quoted(page) if text.startswith("stitch ")]
    known = {"--help", "--tables", "--seeds", "--scheduler"}.union(*options.values())
    assert not [o for text in quoted(page) for o in re.findall(r"^--[a-z][\w-]*", text) if o not in known]
    for line in lines:
        command = next((c for c in sorted(options, key=len, reverse=True) if re.match(rf"{c}\b", line)), None)
        assert command or re.match(r"(calibrate$|[A-Z])", line), line
        asked = re.findall(r"(?<![\w-])--?[a-z][\w-]*", line.split("#")[0])
        assert command is None or not {o for o in asked if o not in options[command] and o != "--help"}, line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_of_a_page_names_what_there_is(page):
    for block in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        compile(block, page.name, "exec")
        imports = [line for line in block.splitlines() if re.match(r"(from|import) ", line)]
        exec("\n".join(imports), {})
        assert not [name for name in re.findall(r"\bstitch\.(\w+)\(", block) if name not in stitch.__all__]


def test_the_effect_of_the_page_is_a_file_that_loads(tmp_path):
    before, file = dict(EFFECTS), tmp_path / "mine.py"
    page = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
    file.write_text(re.search(r"```python\n(.*?)```", page, re.DOTALL)[1], encoding="utf-8")
    try:
        assert load(file) == ["humidity_bias"]
        assert EFFECTS["humidity_bias"].parameters(6, (), "mm")[0].unit == "mm"
    finally:
        EFFECTS.clear()
        EFFECTS.update(before)


def test_every_function_and_form_of_the_walks_is_in_the_file_that_it_links_to():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    for name, file in re.findall(r"\[`(\w+)`\]\(\.\./([\w/]+\.py)\)", text):
        assert re.search(rf"^(def|class) {name}\b", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), name
    forms = text.split("## The walk of one parameter")[1].split("\n\nThe way back")[0]
    assert len(re.findall(r"^\| ", forms, re.MULTILINE)) - 1 <= 8


def test_rooms_of_the_pages_are_those_of_the_tree():
    rooms = {
        path.name for path in (ROOT / "stitch").iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    architecture = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    readme = (ROOT / "README.md").read_text(encoding="utf-8").split("## How it works")[1]
    for room in rooms - {"__init__.py"}:
        assert f"(../stitch/{room})" in architecture and re.search(rf"\b{re.escape(room)}(?![\w.])", readme), room


def test_a_cloud_walks_as_the_page_says(session, tmp_path):
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    walk = re.findall(r"^\d+\. \[`(\w+)`\]\(\.\./(\S+)\)", page.split("<!-- walk: end -->")[0], re.MULTILINE)
    assert len(walk) <= 12
    places, seen = {(name, str(ROOT / file)) for name, file in walk}, []

    def watch(frame, event, _):
        if event == "call" and (place := (frame.f_code.co_name, frame.f_code.co_filename)) in places:
            seen.append(place)

    threading.setprofile(watch)
    sys.setprofile(watch)
    try:
        write_run(stitch.run(stitch.load_session(session)), tmp_path)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    calls = iter(seen)
    for name, file in walk:
        assert (name, str(ROOT / file)) in calls, f"{name} was not called after the ones before it"


def applied(page: Path, root: Path) -> None:
    """Apply every diff of a page to a copy of the tree: each hunk's lines stand in the file exactly once."""
    for diff in re.findall(r"```diff\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        target = root / re.search(r"^\+\+\+ b/(\S+)", diff, re.MULTILINE)[1]
        for hunk in diff.split("\n@@\n")[1:]:
            lines = hunk.splitlines()
            old = "".join(f"{line[1:]}\n" for line in lines if line[:1] != "+")
            new = "".join(f"{line[1:]}\n" for line in lines if line[:1] != "-")
            text = target.read_text(encoding="utf-8") if target.exists() else ""
            assert text.count(old) == 1 if old else not text, f"{target}: {old}"
            target.write_text(text.replace(old, new) if old else new, encoding="utf-8")


EXTENDED = """
import numpy as np
from dataclasses import replace
from data_synth.fixtures.labelled_arm import labelled_cell
import stitch
from stitch import frames
from stitch.diagnosis import candidates
from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.selection.ranking import ranked_all
from stitch.effects import EFFECTS
from stitch.measurement.capture import capture
from stitch.measurement.measurement import measurement_of
from stitch.model.model import Model
from stitch.observations.plate import plate_model

assert EFFECTS["mount_thermal_drift"].formula == "M·exp(ξ (T−T₀)), T = scanner_temperature_c"
for name in set(EFFECTS) - {"mount_thermal_drift", "joint_offset", "gear_eccentricity"}:
    del EFFECTS[name]
candidates.empirical_effects = lambda views: []

# The effect: what is put into a cell is found.
true = np.array([1e-4, -2e-4, 1.5e-4, 0.03, -0.02, 0.04])
cell, _, _ = labelled_cell(3, views=25, noise=0.005)
warm = 3 * np.sin(np.arange(25) / 4)
def seen(view, degrees):
    moved = frames.transform(frames.inverse(frames.exp(true * degrees)), view.sighting.points)
    return replace(
        view, covariates={"scanner_temperature_c": 20 + degrees}, sighting=replace(view.sighting, points=moved))
drifting = replace(cell, views=tuple(seen(v, d) for v, d in zip(cell.views, warm)))
term = stitch.run(drifting, effects=["mount_thermal_drift"]).terms[0]
off = (term.values - true) / term.sigmas
assert np.isfinite(off).all() and np.abs(off).max() < 4, off

# The observation: an offset of joint 3 that flat points alone show.
plate = np.array([[60., 10, 30], [-40, 55, 30], [-20, -60, 30], [10, 5, 30], [-70, -10, 30], [50, -50, 30]])
cell, T_mount, _ = labelled_cell(1, views=30, offset=np.array([0, 0, 1.5e-3, 0, 0, 0]), targets=plate)
linear = plate_model(measurement_of(cell, capture(cell)), Model(T_mount))
best = ranked_all(linear, candidates_of(linear)[0])[0][0]
found = {p.name: (v, s) for p, v, s in zip(best.score.form.free, best.score.values, best.score.sigmas)}
assert best.name == "joint_offset" and list(found) == ["d3"], found
assert abs(found["d3"][0] - 1.5e-3) < 3 * found["d3"][1] < 3e-4, found

# The statistic: silent where the scatter is normal, heard where it has long tails.
rng = np.random.default_rng(0)
def notes(drawn):
    cell, _, _ = labelled_cell(5, views=25, noise=1e-3, scatter=(1e-6, 1e-3))
    noisy = [replace(v.sighting, points=v.sighting.points + 0.02 * drawn((4, 3)), sigma=np.full(4, 0.02))
             for v in cell.views]
    views = tuple(replace(v, sighting=s) for v, s in zip(cell.views, noisy))
    return stitch.diagnose(stitch.run(replace(cell, views=views))).notes
tails = (rng.standard_normal, lambda shape: rng.standard_t(2, shape))
heard = [any("not normal" in note for note in notes(drawn)) for drawn in tails]
assert heard == [False, True], heard
"""


def test_the_diffs_of_the_page_that_extends_work(tmp_path):
    shutil.copytree(ROOT / "stitch", tmp_path / "stitch", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "data_synth", tmp_path / "data_synth", ignore=shutil.ignore_patterns("__pycache__"))
    applied(ROOT / "docs" / "extend.md", tmp_path)
    command = [sys.executable, "-c", EXTENDED]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def test_the_example_of_the_readme_prints_what_it_shows(tmp_path):
    page = shown()
    anew = printed(commands(page), tmp_path)
    number = re.compile(r"(?<![\w.])-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?")
    assert number.sub("#", re.sub(" +", " ", anew)) == number.sub("#", re.sub(" +", " ", page)), (
        "to fix: python bench/readme_output.py"
    )
    for a, b in zip(number.findall(anew), number.findall(page), strict=True):
        # Another processor may round otherwise: one in the last digit that is shown.
        assert math.isclose(value(a), value(b), rel_tol=0, abs_tol=1.01 * max(last_digit(a), last_digit(b))), (a, b)


def value(number: str) -> float:
    return float(number.replace(",", ""))


def last_digit(number: str) -> float:
    """What one more in the last digit that is shown is worth."""
    mantissa, _, power = number.partition("e")
    return 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
