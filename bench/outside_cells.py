"""How often a user is told the truth in cells of somebody who had not read the library: bench/outside_world.py.

The cells of bench/outside_world.py go as folders through run, diagnose and add --suggested. Scoring is a function of
the rows alone, by a table of what each effect of the library says of place and cause.
"""

import itertools
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

import stitch
from bench.harness import Row, Table, grouped, markdown, share, with_all
from bench.outside_world import LAWS, NAMES, Array, build, hide, write
from stitch.api.stepwise import suggest

# What the library's effects say: the side of the arm or part of it that errs, and what the error follows.
SAYS = {
    "base_compliance": ("base", "gravity"),
    "latency": ("joint", "velocity"),
    "joint_offset": ("arm", ""),
    "link_geometry": ("arm", ""),
    "joint_compliance": ("joint", "gravity"),
    "gear_eccentricity": ("joint", "own angle"),
    "gear_harmonic": ("joint", "own angle, twice"),
    "backlash": ("joint", "approach"),
    "settling": ("joint", "move, wait_s"),
    "joint_thermal": ("joint", "slow"),
    "joint_step": ("joint", "view"),
    "robot_thermal_growth": ("link", "slow"),
    "link_thermal": ("link", "slow"),
    "mount_drift": ("scanner", "slow"),
    "mount_warmup": ("scanner", "slow"),
    "mount_creep": ("scanner", "slow"),
    "mount_step": ("scanner", "view"),
    "fixture_drift": ("part", "slow"),
    "part_slip": ("part", "view"),
    "mount_droop": ("scanner", "gravity"),
    "mount_bend": ("scanner", "gravity"),
    "fixture_droop": ("part", "gravity"),
    "fixture_bend": ("part", "gravity"),
    "range_scale": ("optics", "distance"),
    "range_nonlinearity": ("optics", "distance"),
    "incidence_bias": ("optics", "incidence"),
    "field_curvature": ("optics", "field"),
    "lens_distortion": ("optics", "field"),
}
SLOW = {"ambient_temperature_c", "robot_temperature_c", "scanner_temperature_c", "time_s"}
# Below this the law is smaller than the little geometry that every arm has: naming that is no mistake.
UNSEEN = 0.005


def jobs(seeds: range, cells: int = 200) -> Iterator[Row]:
    """Yield cells over laws, sizes and kinds, drawn by each seed."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        kinds = list(itertools.product(LAWS, (1, 3)))
        order = [kinds[index] for _ in range(cells // len(kinds) + 1) for index in rng.permutation(len(kinds))]
        for number, (law, times) in enumerate(order[:cells]):
            kind = "clouds" if rng.random() < 0.35 or LAWS[law].clouds_only else "balls"
            yield {"law": law, "times": times, "kind": kind, "seed": seed, "cell": number}


def trial(job: Row) -> Row:
    """Build the cell and let a user go through it."""
    law, rng = LAWS[job["law"]], np.random.default_rng([job["seed"], job["cell"]])
    cell = build(job["kind"], law.follows == "velocity" or rng.random() < 0.25, rng)
    truth = hide(cell, law, job["times"], rng)
    hand = {"eye_in_hand": cell.eye_in_hand, "views": len(cell.q), "where": truth.where}
    row = hand | {"visible": truth.visible, "scatter": truth.scatter}
    with tempfile.TemporaryDirectory() as folder:
        write(cell, job["kind"], Path(folder) / "cell", rng)
        try:
            run = stitch.run(stitch.load_session(Path(folder) / "cell"))
            diagnosis = stitch.diagnose(run)
            better, lines, last = suggest(run, 5) if diagnosis.together else (None, [], diagnosis)
        except (stitch.InputError, stitch.NoResultError) as error:
            return row | {"refused": str(error)}
    found = diagnosis.to_dict()
    keys = ("verdict", "effects", "plain", "sentence", "laws", "joint_laws", "time_law", "places", "doubts", "together")
    row |= {key: found.get(key) for key in keys} | {"said": lines, "last": last.verdict, "certain": diagnosis.certain}
    row["sizes"] = {c["effect"]: c["parameters"] for c in found["candidates"] if c["effect"] in found["effects"]}
    row["unseen"] = [c["effect"] for c in found["candidates"] if c["effect"] in diagnosis.sentence]
    row["depends"] = [[d["covariate"], d.get("place"), d["p_value"]] for d in found["depends_on"][:3]]
    before, after = run.to_dict(), (better or run).to_dict()
    row |= {"added": sorted(after["effects"]), "rms": [before["residual_rms"], after["residual_rms"]]}
    row["before"] = _in_sigmas(before, truth.poses["plain"])
    return row | {"after": {name: _in_sigmas(after, pose) for name, pose in truth.poses.items()}}


def _in_sigmas(result: Row, truth: Array) -> list[list[float]]:
    """Errors of the hand-eye, alone where the model has effects (rotation vector in rad, mm), and their sigmas."""
    alone = result.get("hand_eye_alone") or {
        "hand_eye": result["hand_eye"],
        "covariance": result["hand_eye_covariance"],
    }
    error = np.linalg.inv(truth) @ alone["hand_eye"]
    turn = (error[:3, :3] - error[:3, :3].T) / 2
    twist = [turn[2, 1], turn[0, 2], turn[1, 0], *error[:3, 3]]
    return [[float(e) for e in twist], np.sqrt(np.diag(alone["covariance"])).tolist()]


def side(row: Row) -> str:
    """Return where the truth errs, in the words of SAYS: what sits on which end of the arm moves alike."""
    law = LAWS[row["law"]]
    if law.follows in ("field", "incidence", "distance"):
        return "optics"
    outer, inner = ("scanner", "part") if row["eye_in_hand"] else ("part", "scanner")
    return {"mount": outer, "base": inner}.get(law.place, law.place)


def grade(row: Row, name: str) -> str:
    """Return what a named effect is worth: right, kin (the place is right and so is what it follows), or wrong."""
    place, follows = SAYS.get(name, (name, ""))
    law = LAWS[row["law"]]
    if place == "arm":
        # A link that had grown before the first view is longer than stated: of that link it is true.
        of_link = law.place == "link" and {p[2:] for p in row["sizes"].get(name, {})} == {str(row["where"])}
        return "kin" if row["visible"] < UNSEEN or (of_link and name == "link_geometry") else "wrong"
    if name in NAMES.get(row["law"], ()):
        return "right" if place == side(row) or place in ("joint", "link", "optics") else "wrong"
    kind = "slow" if law.follows in SLOW else law.follows
    return "kin" if (place, follows) == (side(row), kind) else "wrong"


def law_told(row: Row) -> str:
    """Return what the told laws are worth: right, place (what it follows is not), wrong, or "" where none is told.

    Where no law is told, a place may be, or the joint that errs along a curve without a name.
    """
    told = [(law["place"], law["follows"]) for law in row["laws"]]
    told = told or [(place, "") for place in row.get("places", [])]
    told = told or [(f"joint {curve['joint']}", "") for curve in row["joint_laws"]]
    grades = {_law_grade(row, place, follows) for place, follows in told}
    return next((word for word in ("right", "place", "wrong") if word in grades), "")


def _law_grade(row: Row, place: str, follows: str) -> str:
    law = LAWS[row["law"]]
    joint = row["where"] if law.place == "joint" else 0
    words = {"scanner": ["scanner", "mount", "stand"], "part": ["part"], "optics": ["scanner"], "link": ["link"]}
    wanted = words.get(side(row), [f"joint {joint}"] if joint else ["joint"])
    if law.place == "base" or joint == 1:
        wanted = [*wanted, "base"]
    if joint == 6:
        wanted = [*wanted, "mount"] if row["eye_in_hand"] else [*wanted, "part"]
    if not any(word in place for word in wanted):
        return "wrong"
    covariates = {
        "own angle": [f"j{joint}_deg"],
        "approach": [f"j{joint}_approach", f"j{joint}_move"],
        "move, wait_s": [f"j{joint}_move", "wait_s"],
        "velocity": ["velocity"],
        "gravity": ["gravity", "torque"],
        "view": ["view", "time_s"],
        "time_s": ["time_s", "view"],
    }.get(law.follows, [law.follows])
    return "right" if any(word in follows for word in covariates) else "place"


def outcome(row: Row) -> str:
    """Return one word for what the user was told first."""
    if "refused" in row:
        return "refused"
    if not row["effects"]:
        told = law_told(row)
        return {"right": "law right", "place": "law at the right place", "wrong": "law wrong"}.get(told, row["verdict"])
    grades = [grade(row, name) for name in row["effects"]]
    best = next(word for word in ("right", "kin", "wrong") if word in grades)
    if best == "wrong" and law_told(row) == "right":
        best = "kin"
    return f"{'certain' if row['certain'] else 'perhaps'} {best}"


def summary(rows: list[Row]) -> list[str]:
    """Return what was told, and the hand-eye before and after what was suggested was added."""
    judged = [{**row, "outcome": outcome(row), "size": f"{row['kind']}, {row['times']} ×"} for row in rows]
    hidden = [row for row in judged if row["law"] != "nothing"]
    groups = with_all(grouped(sorted(hidden, key=lambda row: row["size"]), "size"))
    groups["no law"] = [row for row in judged if row["law"] == "nothing"]
    head = (
        "cells | certain, wrong | perhaps, wrong | law wrong | certain, right or kin | the same or one law, right | "
        "right name, kin or law | place"
    )
    told = [(name, *_shares(group)) for name, group in groups.items()]
    silent = (
        "cells | adequate beside twice the scatter | hand-eye worse by 2 σ | within 3 σ before | after | or of the mean"
    )
    fitted = [(name, *_fits(group)) for name, group in groups.items()]
    by_law = [
        (law, f"{LAWS[law].size:g} {LAWS[law].unit}", *_outcomes(group))
        for law, group in grouped(judged, "law").items()
    ]
    return [
        *markdown(head, told),
        "",
        *markdown(silent, fitted),
        "",
        *markdown("law | usual size | what was told", by_law),
    ]


def _shares(rows: list[Row]) -> Iterator[str]:
    right = {"certain right", "perhaps right", "certain kin", "perhaps kin", "law right"}
    certain = {"certain right", "certain kin"}
    wanted = ({"certain wrong"}, {"perhaps wrong"}, {"law wrong"}, certain)
    for words in wanted:
        yield share(row["outcome"] in words for row in rows)
    # A law that is told alone is 20 to 1 over every other.
    yield share(row["outcome"] in certain or (row["outcome"] == "law right" and len(row["laws"]) == 1) for row in rows)
    for words in (right, right | {"law at the right place"}):
        yield share(row["outcome"] in words for row in rows)


def _fits(rows: list[Row]) -> Iterator[str]:
    done = [row for row in rows if "refused" not in row]
    yield share(_silent(row) for row in done)
    yield share(_worse(row) for row in done if row["added"])
    yield share(_largest(row["before"]) < 3 for row in done)
    yield share(_largest(_after(row)) < 3 for row in done)
    yield share(min(_largest(_after(row)), _largest(row["after"]["mean"])) < 3 for row in done)


def _silent(row: Row) -> bool:
    """Return whether a law beyond twice the expected scatter ends in "adequate" and not as one that cannot show."""
    unseen = set(NAMES.get(row["law"], ())) & set(row.get("unseen", ()))
    return bool(row["verdict"] == "adequate" and row["visible"] ** 2 > 3 * row["scatter"] ** 2 and not unseen)


def _after(row: Row) -> list[list[float]]:
    """Errors of the hand-eye with what was added, against what it is in the mean or in the last view."""
    return min((row["after"][name] for name in ("mean", "last")), key=_largest) if row["added"] else row["before"]


def _largest(errors: list[list[float]]) -> float:
    return float((np.abs(errors[0]) / errors[1]).max())


def _worse(row: Row) -> bool:
    (before, _), (after, sigma) = row["before"], _after(row)
    return bool(((np.abs(after) - np.abs(before)) / sigma).max() > 2)


def _outcomes(rows: Iterable[Row]) -> list[str]:
    counts = grouped(sorted(rows, key=lambda row: row["outcome"]), "outcome")
    return [", ".join(f"{len(group)} {name}" for name, group in counts.items())]


TABLE = Table(jobs, trial, summary, range(4444, 4445), "how-often-right", "outside", {"cells": 200})
