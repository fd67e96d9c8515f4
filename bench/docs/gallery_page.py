"""docs/gallery.md as text, and its pictures out of the pages of runs."""

import re
from dataclasses import dataclass
from pathlib import Path

from bench.docs.report_pictures import shot

_SIZE, _WIDE, _QUALITY = (1400, 1040), 900, 60

_VERDICTS = {
    "adequate": "nothing is missing",
    "missing_effect": "an effect is missing",
    "cannot_tell": "something is missing; these views cannot tell what",
    "unknown_effect": "something unknown is missing",
}


@dataclass(frozen=True)
class Case:
    """A scene with what is hidden in it, or a measured object (None)."""

    name: str
    hidden: str | None
    told: str


@dataclass(frozen=True)
class Made:
    """What its commands gave."""

    codes: dict[str, int]  # of the exits, by command
    seconds: dict[str, float]  # of one core
    sentence: str
    verdict: str
    effects: list[str]
    plain: str  # what is missing, for everybody
    diagnosis: str  # its evidence
    views: int
    points: int
    recording: int  # bytes


def picture_of(report: Path, path: Path) -> int:
    """A picture of a page's screen, small; its bytes, 0 where there is no page."""
    if not report.is_file():
        return 0
    picture = shot(report, *_SIZE)
    picture.thumbnail((_WIDE, _WIDE))
    picture.save(path, quality=_QUALITY, method=6)
    return path.stat().st_size


@dataclass(frozen=True)
class Entry:
    """What the page has of a case: a row of its table, and a section."""

    row: str
    section: str


def entry(case: Case, own: Made) -> Entry:
    """What the page says of a case that was made."""
    return Entry(_row(case, own), _section(case, own))


def entries(text: str, cases: tuple[Case, ...]) -> dict[Case, Entry]:
    """What a page says already, by case: those that are not made again keep it."""
    rows = {row[1]: row[0] for row in re.finditer(r"^\| \[(\S+)\]\(#.*$", text, re.MULTILINE)}
    sections = {part[1]: part[0].rstrip() + "\n" for part in re.finditer(_SECTION, text, re.MULTILINE | re.DOTALL)}
    return {case: Entry(rows[case.name], sections[case.name]) for case in cases if case.name in rows.keys() & sections}


def page(told: dict[Case, Entry], others: list[str]) -> str:
    """The whole page.

    Args:
        others: names of the cases of which nothing is known.
    """
    synthetic = [told[case].section for case in told if case.hidden is not None]
    measured = [told[case].section for case in told if case.hidden is None]
    missing = f"Not on this page: {', '.join(others)}; `python -m bench.docs.gallery` adds them.\n" if others else ""
    table = "\n".join([*_TABLE, *(told[case].row for case in told), ""])
    parts = [_HEAD, missing, table, "## Scenes of the simulator\n", _SCENES, *synthetic]
    if measured:
        parts += ["## Measured objects\n", _OBJECTS, *measured]
    return "\n".join(part for part in parts if part).rstrip() + "\n"


def _row(case: Case, own: Made) -> str:
    hidden = "measured" if case.hidden is None else case.hidden.partition("=")[0] or "nothing"
    named = f": {', '.join(own.effects)}" if own.effects else ""
    follows = own.plain.partition("the remaining error follows ")[2].rstrip(".")
    traced = f"; it follows {follows}" if follows else ""
    told = f"{_VERDICTS.get(own.verdict, 'no result')}{named}{traced}"
    exits = ", ".join(f"{name} {code}" for name, code in own.codes.items())
    spent = sum(seconds for name, seconds in own.seconds.items() if name != "synth")
    return f"| [{case.name}](#{case.name}) | {hidden} | {told} | {exits} | {spent:.0f} |"


def _section(case: Case, own: Made) -> str:
    size = f"{own.recording / 1e6:.1f} MB" if own.recording else "none"
    pictured = f"![{case.name}](pictures/gallery-{case.name}.webp)\n\n" if own.sentence and own.recording else ""
    told = " ".join(text for text in (own.sentence, f"**{own.plain}**" if own.plain else "") if text)
    evidence = f"\n\nEvidence: {own.diagnosis}" if own.diagnosis else ""
    return (
        f"### {case.name}\n\n{case.told} {own.views} views, {own.points:,} points. Recording: "
        f"`{case.name}/run/recording.rrd`, {size}.\n\n{pictured}{told}{evidence}\n"
    )


_TABLE = (
    "| case | hidden | what `stitch diagnose` says | exits | seconds of one core |",
    "|---|---|---|---|---:|",
)
_SECTION = r"^### (\S+)$.*?(?=^##|\Z)"

_HEAD = """# Gallery

Scenes of the simulator and measured objects, run and diagnosed by the command line. Made by
`python -m bench.docs.gallery`; the pictures are the screens of the runs' pages ([how to read them](report.md)).

Recordings are not kept in the project; `python -m bench.docs.gallery --keep FOLDER` makes them, then
`stitch view FOLDER/blade/run` shows one.

## Hidden effects and their laws

One law of nature is hidden in a blade cell; the screen names it, and its plot shows the law: torque, angle,
time, gravity, the order of views. Made by `python -m bench.docs.hidden_effects`.

| hidden | screen |
|---|---|
| joint_compliance: joints give way under load | ![compliance](gallery/joint_compliance.webp) |
| gear_eccentricity: a gear runs out of true | ![eccentricity](gallery/gear_eccentricity.webp) |
| backlash: a joint has play | ![backlash](gallery/backlash.webp) |
| joint_offset: a joint counts its angle from a wrong zero | ![offset](gallery/joint_offset.webp) |
| mount_drift: the scanner's mount creeps | ![drift](gallery/mount_drift.webp) |
| mount_warmup: the mount moves while it warms up | ![warm-up](gallery/mount_warmup.webp) |
| mount_droop: the mount gives way under its weight | ![droop](gallery/mount_droop.webp) |
| part_slip: the part slips between two views | ![slip](gallery/part_slip.webp) |
| fixture_drift: the part's fixture creeps | ![creep](gallery/fixture_drift.webp) |
| fixture_droop: the fixture gives way under the part's weight | ![fixture](gallery/fixture_droop.webp) |
| range_nonlinearity: the scanner errs off its working distance | ![range](gallery/range_nonlinearity.webp) |
| lens_distortion: the scanner's lens distorts | ![lens](gallery/lens_distortion.webp) |
| third_harmonic: a law that the library does not know | ![no name](gallery/third_harmonic.webp) |
"""

_SCENES = """Twelve views each, seed 3. What is hidden is one law of nature ([scenes and laws](synth.md)) beside the
arm's own scatter and quiet laws; the diagnosis knows nothing of it.
"""

_OBJECTS = """Scans of the RegHEC data set (Shiyu Xing, MIT licence), nine views each, no hand-eye given.
"""
