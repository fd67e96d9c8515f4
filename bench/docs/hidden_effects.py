"""The screen for hidden effects of the robot, the mount, the part and the scanner: docs/gallery.

Run: python -m bench.docs.hidden_effects [EFFECT …] [--keep FOLDER]

Each blade is made, run and diagnosed by the command line, about half a minute of one core; --keep keeps the runs, and
one that is there is not made again. Needs a Chromium on the path.
"""

import argparse
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from bench.docs.report_pictures import shot

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "gallery"
_CALL = (sys.executable, "-P", "-c", "from stitch.cli.main import main; main()")
_SIZE, _WIDE, _QUALITY = (1400, 1100), 1100, 60


@dataclass(frozen=True)
class Hidden:
    """One law of nature that is put into a cell."""

    effect: str
    size: float
    kind: str
    scene: str = "blade"
    views: int = 16


CASES = (
    Hidden("joint_compliance", 3, "robot"),
    Hidden("gear_eccentricity", 4, "robot"),
    Hidden("backlash", 2, "robot"),
    Hidden("joint_offset", 4, "robot", "blade-table"),
    Hidden("third_harmonic", 4, "robot, a law of no library"),
    Hidden("mount_drift", 2, "mount"),
    Hidden("mount_warmup", 2, "mount", "blade-table"),
    Hidden("mount_droop", 2, "mount", "blade-table"),
    Hidden("part_slip", 2, "part"),
    Hidden("fixture_drift", 2, "part"),
    Hidden("fixture_droop", 2, "part"),
    Hidden("range_nonlinearity", 3, "scanner"),
    Hidden("lens_distortion", 3, "scanner"),
)


def made(case: Hidden, folder: Path) -> Path:
    """Make, run and diagnose one cell; returns its page."""
    run = folder / case.effect / "run"
    if not (run / "diagnosis.json").is_file():
        hide, session = f"{case.effect}={case.size:g}", run.with_name(case.scene)
        for words in (
            ["synth", case.scene, session, "--hide", hide, "--views", case.views, "--seed", 3],
            ["run", session, "-o", run, "--no-recording", "--tolerance", 0.05],
            ["diagnose", run],
        ):
            subprocess.run([*_CALL, *map(str, words)], check=True, capture_output=True)
    return run / "report.html"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("effects", nargs="*", metavar="EFFECT", help="those that are made; all if none is named")
    parser.add_argument("--keep", type=Path, help="where the runs stay")
    given = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for case in (case for case in CASES if not given.effects or case.effect in given.effects):
            picture = shot(made(case, given.keep or Path(scratch)), *_SIZE)
            picture.thumbnail((_WIDE, _WIDE))
            path = FOLDER / f"{case.effect}.webp"
            picture.save(path, quality=_QUALITY, method=6)
            print(f"{path}: {case.kind}, {path.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
