"""Every scene of the simulator and every measured object as a stranger meets them: docs/gallery.md and its pictures.

Run: python -m bench.docs.gallery [CASE …] [--keep FOLDER]

Each case is made, run and diagnosed by the command line. With --keep, runs and recordings stay in FOLDER, and cases
that are there already are not made again. Of a case that is not made, the page keeps what it says. Measured objects
need the scans of RegHEC, a folder each, in $STITCH_SHARED_DATA/reghec.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from bench.docs.gallery_page import Case, Made, entries, entry, page, picture_of

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
MEASURED = Path(os.environ.get("STITCH_SHARED_DATA") or ROOT.parent / "shared" / "data") / "reghec"
_VIEWS, _SEED = 12, 3
_CALL = (sys.executable, "-P", "-c", "from stitch.cli.main import main; main()")

CASES = (
    Case("blade", "joint_compliance=2", "A turbine blade on the flange; two joints give way under load."),
    Case("blade-table", "mount_warmup=2", "The blade on a table; the scanner's bracket warms up."),
    Case(
        "car-door",
        "scanner_thermal_scale=2",
        "A car door, by an arm on a rail that states no joints; the scanner warms.",
    ),
    Case("drill-plate", "", "A plate with nine holes that are labelled too; nothing is hidden."),
    Case("line-sweep", "latency=2", "A laser line that sweeps; the scanner's clock is behind the arm's."),
    Case("panel", "third_harmonic=3", "A fuselage panel; a joint errs in a way that no effect of the library knows."),
    Case("spheres", "joint_offset=3", "Five spheres, also as labelled points; a joint counts from a wrong zero."),
    *(
        Case(name, None, told)
        for name, told in (
            ("david", "A bust."),
            ("cone", "A traffic cone: surfaces that slide along themselves."),
            ("sphere", "A sphere: nothing on it says how it is turned."),
            ("rubik", "A cube."),
            ("gripperopen", "A gripper, scanned by a scanner that stands in the cell."),
        )
    ),
)


def make(case: Case, folder: Path) -> Made:
    """Make, run and diagnose one case by the command line; what it said is kept in made.json."""
    session, run = folder / "session", folder / "run"
    folder.mkdir(parents=True, exist_ok=True)
    codes, seconds = {}, {}
    commands: dict[str, list[object]] = {"run": ["run", session, "-o", run], "diagnose": ["diagnose", run]}
    if case.hidden is None:
        commands["run"][1] = MEASURED / case.name
    else:
        options = ["--seed", _SEED, "--views", _VIEWS, "--truth", folder / "truth.json"]
        hide = ["--hide", case.hidden] if case.hidden else []
        commands = {"synth": ["synth", case.name, session, *hide, *options], **commands}
    for name, words in commands.items():
        before = _cpu()
        codes[name] = subprocess.run([*_CALL, *map(str, words)], capture_output=True, check=False).returncode
        seconds[name] = _cpu() - before
        if codes[name]:
            break
    made = _read(run, codes, seconds)
    (folder / "made.json").write_text(json.dumps(asdict(made), indent=1), encoding="utf-8")
    return made


def _read(run: Path, codes: dict[str, int], seconds: dict[str, float]) -> Made:
    """What the files of a run say."""
    result, found = (_json(run / f"{name}.json") for name in ("result", "diagnosis"))
    recording = run / "recording.rrd"
    return Made(
        codes=codes,
        seconds=seconds,
        sentence=result.get("plain") or result.get("verdict", ""),
        verdict=found.get("verdict", ""),
        effects=found.get("effects", []),
        plain=found.get("plain", ""),
        diagnosis=found.get("sentence", ""),
        views=len(result.get("views", [])),
        points=sum(view["points"] for view in result.get("views", [])),
        recording=recording.stat().st_size if recording.is_file() else 0,
    )


def _json(file: Path) -> dict[str, object]:
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", metavar="CASE", help="those that are made; all if none is named")
    parser.add_argument("--keep", type=Path, help="where runs and recordings stay")
    given = parser.parse_args()
    told, gallery = {}, DOCS / "gallery.md"
    with tempfile.TemporaryDirectory() as scratch:
        for case in CASES:
            if (given.cases and case.name not in given.cases) or (case.hidden is None and not MEASURED.is_dir()):
                continue
            folder = (given.keep or Path(scratch)) / case.name
            kept = folder / "made.json"
            made = Made(**json.loads(kept.read_text(encoding="utf-8"))) if kept.is_file() else make(case, folder)
            size = picture_of(folder / "run" / "report.html", DOCS / "pictures" / f"gallery-{case.name}.webp")
            print(f"{case.name}: {made.verdict or made.codes}, picture {size / 1000:.0f} kB", flush=True)
            told[case] = entry(case, made)
            known = entries(gallery.read_text(encoding="utf-8"), CASES) | told
            shown = {case: known[case] for case in CASES if case in known}
            gallery.write_text(page(shown, [case.name for case in CASES if case not in shown]), encoding="utf-8")


if __name__ == "__main__":
    main()
