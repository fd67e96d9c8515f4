"""Drawn folders through `stitch init`: 300 of a seed, formats × layouts × conventions × units × names × mistakes.

Each folder of data_synth/fixtures/drawn_folders.py is asked without guessing; where a question comes back, a person who
knows the cell answers it, one answer a time, by the data that the refusal carries. Right: every view that belongs there
has the pose, the unit and the mount of the campaign, and no other is there; or nothing can be right, and the refusal
names the true cause. A guess is marked if it bears "?"; a session that is wrong in what bears no mark is silently so.
"""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.harness import Row, Table, grouped, markdown, share
from bench.intake import campaigns
from data_synth.fixtures.drawn_folders import MM, Truth, draw_folder
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.plugins.intake.guesses import Guess
from stitch.plugins.intake.make_session import Made, make_session
from stitch.plugins.intake.refusals import Refusal
from stitch.session.reading.session_folder import load_session
from stitch.session.session import SessionData

COUNT, STEPS = 300, 3
# Folders of one seed are written of so many campaigns.
_CAMPAIGNS = 3
_NEAR_MM, _NEAR_RAD, _SIZE = 0.05, 5e-4, 5e-3


def jobs(seeds: range, count: int) -> Iterator[Row]:
    """So many folders of each seed."""
    yield from ({"seed": seed, "number": number} for seed in seeds for number in range(count))


def trial(job: Row) -> Row:
    """What becomes of a folder, asked and answered."""
    drawn = draw_folder(job["seed"], job["number"])
    campaign = campaigns(1000 * job["seed"] + job["number"] % _CAMPAIGNS)["arm"]
    with TemporaryDirectory() as scratch:
        folder, out = Path(scratch) / "scans", Path(scratch) / "session"
        folder.mkdir()
        truth = drawn.write(folder, campaign)
        outcome, asked, told, guesses = answered(folder, out, truth, campaign.clouds)
    usual = [guess.what for guess in guesses if guess.because == "usual"]
    marked = sum(what in ("rotation", "pairing", "columns") for what in usual)
    unmarked = len(guesses) - len(usual)
    drawing = {"format": drawn.format, "mistake": drawn.mistake, "inverse": drawn.inverse}
    drawing |= {"units": f"{drawn.unit}/{drawn.cloud_unit}", "named": drawn.named}
    counts = {"marked": marked, "unmarked": unmarked}
    return drawing | counts | {"outcome": outcome, "asked": asked, "told": told[:300]}


def answered(
    folder: Path, out: Path, truth: Truth, clouds: tuple[np.ndarray, ...]
) -> tuple[str, list[str], str, tuple[Guess, ...]]:
    """Return what becomes of a folder that is answered, what it asked, its last refusal, and the guesses."""
    options: dict[str, str] = {}
    asked: list[str] = []
    told = ""
    for _ in range(STEPS):
        try:
            made = make_session(folder, out, options, guess=bool(asked), force=True)
            return verdict(load_session(out), made, truth, clouds), asked, told, made.guesses
        except InputError as refused:
            told = refused.what.replace(str(folder), "scans")
            answer = answer_of(refused, truth, options)
        if answer is None:
            known = truth.cause and re.search(truth.cause, told)
            return "refused, true cause" if known else "refused", asked, told, ()
        options |= answer
        asked += answer
    return "circle", asked, told, ()


def answer_of(refused: InputError, truth: Truth, given: dict[str, str]) -> dict[str, str] | None:
    """Return one answer of a person who knows the cell, of the options that a refusal carries; None where none is."""
    for fix in refused.fixes if isinstance(refused, Refusal) else ():
        for name, value in fix.options.items():
            known = truth.answers.get(name)
            if known is not None and given.get(name) != known and (value.isupper() or name != "rows"):
                return {name: known}
        if fix.options.keys() == {"poses"} and re.search(truth.answers.get("file", "$^"), fix.options["poses"]):
            return dict(fix.options)
    return None


def verdict(session: SessionData, made: Made, truth: Truth, clouds: tuple[np.ndarray, ...]) -> str:
    """Judge a session by the campaign: right, or what is wrong and whether it bears a mark."""
    marks = {guess.what for guess in made.guesses if guess.because == "usual"}
    which = [truth.names.index(Path(view.name).name.split("clouds-")[-1]) for view in session.views]
    T = np.array([view.T_base_flange for view in session.views])
    T[:, :3, 3] *= MM[session.length_unit]
    wrong: dict[str, tuple[str, ...]] = {}
    if sorted(which) != list(truth.views):
        wrong["views"] = ("pairing",)
    if session.mount != "eye_in_hand":
        wrong["mount"] = ("mount",)
    size = [
        np.median(np.linalg.norm(v.cloud.points, axis=1)) * MM[session.length_unit]
        / np.median(np.linalg.norm(clouds[i], axis=1))
        for i, v in zip(which, session.views, strict=True)
    ]  # fmt: skip
    if abs(np.median(size) - 1) > _SIZE:
        wrong["cloud unit"] = ("cloud_unit",)
    elif np.abs(np.array(size) - 1).max() > _SIZE:
        wrong["one scan's unit"] = ()
    p, true = T[:, :3, 3], truth.T[which][:, :3, 3]
    scale = float(np.sum(p * true) / np.sum(true * true)) if "mount" not in wrong else 1.0
    if abs(scale - 1) > _SIZE:
        wrong["unit"] = ("length_unit",)
    turned = frames.angle_between(T, truth.T[which]).max()
    if "mount" not in wrong and (turned > _NEAR_RAD or np.abs(p - scale * true).max() > _NEAR_MM * max(scale, 1)):
        wrong["poses"] = ("rotation", "pairing", "columns")
    if not wrong:
        return "right"
    silent = [what for what, guesses in wrong.items() if not marks & {*guesses}]
    return f"silently wrong: {', '.join(silent)}" if silent else f"wrong as marked: {', '.join(wrong)}"


def summary(rows: list[Row]) -> list[str]:
    """Counts of what became of the folders, of all and by mistake."""
    shown = [
        (
            "right, or refused with the true cause, after one answer at most",
            lambda r: _is_fine(r) and len(r["asked"]) < 2,
        ),
        ("right without a question", lambda r: _is_fine(r) and not r["asked"]),
        ("silently wrong", lambda r: r["outcome"].startswith("silently")),
        ("wrong, and marked as a guess", lambda r: r["outcome"].startswith("wrong as")),
        ("refused for another cause than the true one, or without a way on", lambda r: r["outcome"] == "refused"),
        ("round in a circle", lambda r: r["outcome"] == "circle"),
    ]
    lines = [[words, share(holds(row) for row in rows)] for words, holds in shown]
    silent = sum(row["outcome"].count(",") + 1 for row in rows if row["outcome"].startswith("silently"))
    lines.append(["guesses without a mark that are wrong", f"{silent}/{sum(row['unmarked'] for row in rows)}"])
    right = [row for row in rows if row["outcome"] == "right"]
    lines.append(
        ["right ones whose rotation, pairing and columns bear no mark", share(not row["marked"] for row in right)]
    )
    kinds = [
        [mistake or "none", share(_is_fine(r) and len(r["asked"]) < 2 for r in group), _listed(group)]
        for mistake, group in sorted(grouped(rows, "mistake").items())
    ]
    return [*markdown("of the folders | share", lines), "", *markdown("mistake | right | otherwise", kinds)]


def _is_fine(row: Row) -> bool:
    return row["outcome"] in ("right", "refused, true cause")


def _listed(rows: list[Row]) -> str:
    counts = Counter(row["outcome"] for row in rows if not _is_fine(row))
    return ", ".join(f"{n} {outcome}" for outcome, n in counts.most_common())


DRAWN = Table(jobs, trial, summary, range(1), page="own-data", block="drawn", settings={"count": COUNT})
