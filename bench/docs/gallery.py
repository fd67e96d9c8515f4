"""Scenes, measured objects and hidden effects as a stranger meets them: python -m bench.docs.gallery [NAME …].

Each case is made, run and diagnosed by the command line, and its row, its section and its picture on docs/gallery.md
are written anew; the page keeps what it says of the others. An effect that is hidden in a blade is a picture alone.
With `--keep FOLDER` runs and recordings stay there, and cases that are there already are not made again. Measured
objects need the scans of RegHEC, a folder each, in the shared data. Needs a Chromium on the path.
"""

import argparse
import json
import re
import resource
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.docs.pictures import shot
from bench.harness import DOCS, PICTURES, SHARED_DATA, STITCH

PAGE = DOCS / "gallery.md"


@dataclass(frozen=True)
class Case:
    """A scene with what is hidden in it, or a measured object (None)."""

    name: str
    hidden: str | None
    told: str


@dataclass(frozen=True)
class Hidden:
    """One law of nature that is put into a cell."""

    effect: str
    size: float
    scene: str = "blade"


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
HIDDEN = (
    Hidden("joint_compliance", 3),
    Hidden("gear_eccentricity", 4),
    Hidden("backlash", 2),
    Hidden("joint_offset", 4, "blade-table"),
    Hidden("third_harmonic", 4),
    Hidden("mount_drift", 2),
    Hidden("mount_warmup", 2, "blade-table"),
    Hidden("mount_droop", 2, "blade-table"),
    Hidden("part_slip", 2),
    Hidden("fixture_drift", 2),
    Hidden("fixture_droop", 2),
    Hidden("range_nonlinearity", 3),
    Hidden("lens_distortion", 3),
)
_VERDICTS = {
    "adequate": "no missing effect was found",
    "missing_effect": "an effect is missing",
    "cannot_tell": "something is missing; these views cannot tell what",
    "unknown_effect": "something unknown is missing",
}


def main() -> None:
    """Make the cases that are named, all if none is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--keep", type=Path, help="where runs and recordings stay")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.keep or Path(scratch)
        for case in CASES:
            if case.name in (given.names or [case.name]):
                _write(case, folder / case.name)
        for law in HIDDEN:
            if law.effect in (given.names or [law.effect]):
                hide, size = f"{law.effect}={law.size:g}", ["--views", 16, "--seed", 3]
                synth = ["synth", law.scene, "SESSION", "--hide", hide, *size]
                made = _make(folder / law.effect, synth, ["--no-recording", "--tolerance", 0.05])
                _picture(made["run"], DOCS / "gallery" / f"{law.effect}.webp", (1400, 1100), 1100)


def _write(case: Case, folder: Path) -> None:
    """Make a case and write what the page says of it."""
    if case.hidden is None:
        made = _make(folder, None, [], SHARED_DATA / "reghec" / case.name)
    else:
        hide = ["--hide", case.hidden] if case.hidden else []
        options = ["--seed", 3, "--views", 12, "--truth", folder / "truth.json"]
        made = _make(folder, ["synth", case.name, "SESSION", *hide, *options], [])
    pictured = _picture(made["run"], PICTURES / f"gallery-{case.name}.webp", (1400, 1040), 900)
    text = PAGE.read_text(encoding="utf-8")
    for pattern, new in (
        (rf"(?m)^\| \[{case.name}\]\(#.*$", _row(case, made)),
        (rf"(?ms)^### {case.name}$.*?(?=^##|\Z)", _section(case, made, pictured)),
    ):
        if not re.search(pattern, text):
            raise SystemExit(f"{PAGE}: nothing stands there of {case.name}; put a row and a section where they belong")
        text = re.sub(pattern, lambda _, new=new: new, text)
    PAGE.write_text(text, encoding="utf-8")


def _make(
    folder: Path, synth: list[object] | None, options: list[object], session: Path | None = None
) -> dict[str, Any]:
    """Make, run and diagnose one case by the command line; its exits, seconds of one core, and place."""
    kept, run, session = folder / "made.json", folder / "run", session or folder / "session"
    if not kept.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        commands = {} if synth is None else {"synth": [session if word == "SESSION" else word for word in synth]}
        commands |= {"run": ["run", session, "-o", run, *options], "diagnose": ["diagnose", run]}
        codes, seconds = {}, {}
        for name, words in commands.items():
            before = _cpu()
            codes[name] = subprocess.run([*STITCH, *map(str, words)], capture_output=True, check=False).returncode
            seconds[name] = _cpu() - before
            if codes[name]:
                break
        kept.write_text(json.dumps({"codes": codes, "seconds": seconds}), encoding="utf-8")
    files = {name: run / f"{name}.json" for name in ("result", "diagnosis")}
    documents = {name: json.loads(file.read_text("utf-8")) if file.is_file() else {} for name, file in files.items()}
    return {"run": run, **documents, **json.loads(kept.read_text(encoding="utf-8"))}


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _picture(run: Path, path: Path, size: tuple[int, int], wide: int) -> bool:
    """A picture of a page's screen, small; whether there is a page."""
    report = run / "report.html"
    if report.is_file():
        picture = shot(report, *size)
        picture.thumbnail((wide, wide))
        picture.save(path, quality=60, method=6)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB", flush=True)
    return report.is_file()


def _row(case: Case, made: dict[str, Any]) -> str:
    diagnosis = made["diagnosis"]
    hidden = "measured" if case.hidden is None else case.hidden.partition("=")[0] or "nothing"
    named = f": {', '.join(diagnosis['effects'])}" if diagnosis.get("effects") else ""
    follows = diagnosis.get("plain", "").partition("the remaining error follows ")[2].rstrip(".")
    told = (
        _VERDICTS.get(diagnosis.get("verdict", ""), "no result")
        + named
        + (f"; it follows {follows}" if follows else "")
    )
    exits = ", ".join(f"{name} {code}" for name, code in made["codes"].items())
    spent = sum(seconds for name, seconds in made["seconds"].items() if name != "synth")
    return f"| [{case.name}](#{case.name}) | {hidden} | {told} | {exits} | {spent:.0f} |"


def _section(case: Case, made: dict[str, Any], pictured: bool) -> str:
    result, diagnosis, recording = made["result"], made["diagnosis"], made["run"] / "recording.rrd"
    views = result.get("views", [])
    points = sum(view["points"] for view in views)
    size = f"{recording.stat().st_size / 1e6:.1f} MB" if recording.is_file() else "none"
    picture = f"![{case.name}](pictures/gallery-{case.name}.webp)\n\n" if pictured and recording.is_file() else ""
    plain = f" **{diagnosis['plain']}**" if diagnosis.get("plain") else ""
    evidence = f"\n\nEvidence: {diagnosis['sentence']}" if diagnosis.get("sentence") else ""
    return (
        f"### {case.name}\n\n{case.told} {len(views)} views, {points:,} points. Recording: "
        f"`{case.name}/run/recording.rrd`, {size}.\n\n"
        f"{picture}{result.get('plain') or result.get('verdict', '')}{plain}{evidence}\n\n"
    )


if __name__ == "__main__":
    main()
