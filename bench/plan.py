"""Do the chances that `stitch plan` states hold? Cells are planned, then simulated and diagnosed.

Usage: python -m bench.plan [--cells N] [--rows FILE] [--write]

A cell with one hidden effect of the size that nature draws, times 0.2 to 2. Before any scan the plan says how likely an
effect of that size and shape is detected, named, misnamed; then every scan is simulated, and the verdict of a diagnosis
taken. The simulator shares no code with the plan. Rows are added to FILE, where one stands already it is not run again;
--write puts the table into docs/plan.md. Some 4 s a cell.
"""

import argparse
import json
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from data_synth.fixtures.blade_cells import captured, measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.simulate import Measured
from stitch.diagnosis.candidates import Candidate, candidates_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import scatter_limit
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.pose_errors import prior_pose_errors
from stitch.observations.surfaces.hand_eye_fit import fit_hand_eye
from stitch.observations.surfaces.surface_model import surface_model
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.plugins.metrology.planning.detection_chances import DRAWS, ExpectedDiagnosis
from stitch.plugins.metrology.planning.expected_model import (
    CellModel,
    FieldOfView,
    expected_hand_eye,
    expected_model,
    expected_scatter,
    simulate_views,
    stated_scatter,
    surface_of_mesh,
    with_scatter,
)
from stitch.session.measurement import measurement_of, with_part_origin
from stitch.system.threads import library_threads_off

Row = dict[str, Any]
LAWS = (
    "joint_compliance",
    "range_scale",
    "gear_harmonic",
    "backlash",
    "part_slip",
    "joint_offset",
    "incidence_bias",
    "link_geometry",
    "mount_drift",
    "gear_eccentricity",
    "lens_distortion",
    "settling",
)
_VIEWS, _PIXELS = 12, 150
_SIZES = (0.2, 2.0)  # of nature's own, log-uniform
_FIRST_SEED, _ENOUGH = 700, 20
_BINS = (0.0, 0.25, 0.75, 1.0)
_PAGE = Path(__file__).resolve().parents[1] / "docs" / "plan.md"
_MARKS = ("<!-- chances: begin -->", "<!-- chances: end -->")


def trial(index: int) -> Row:
    """One cell: every third has nothing hidden, mounts take turns."""
    rng = np.random.default_rng([_FIRST_SEED, index])
    law = None if index % 3 == 2 else LAWS[(index - index // 3) % len(LAWS)]
    size = float(np.exp(rng.uniform(*np.log(_SIZES))))
    mount = ("eye_to_hand", "eye_in_hand")[index // 3 % 2]
    cell = partial(measured_blade, _FIRST_SEED + index, views=_VIEWS, mount=mount, pixels=_PIXELS)
    measured = cell(hidden={} if law is None else {law: size})
    predicted = planned(measured, law, rng)
    return {"index": index, "law": law, "size": size, "mount": mount, **predicted, **diagnosed(measured, predicted)}


def planned(measured: Measured, law: str | None, rng: np.random.Generator) -> Row:
    """What the plan says before any scan: it knows the part, the poses, the coarse hand-eye and the usual scatter."""
    session, scene = session_of(measured), measured.scene
    half = np.tan(np.radians(scene.scanner.field_of_view / 2)) * np.ones(2)
    reach = scene.scanner.standoff
    field = FieldOfView(half, 0.7 * reach, 1.3 * reach, standoff=reach, axis=np.array([0.0, 0.0, 1.0]))
    part = surface_of_mesh(measured.mesh.copy()).moved(scene.T_reference_part)
    cell = CellModel(Model(measured.T_coarse), part, field, stated_scatter(session))
    found = simulate_views(session, cell)
    linear = expected_model(found, cell)
    told = expected_scatter(linear, cell.scatter.noise)
    out: Row = {"covariance": expected_hand_eye(with_scatter(linear, told.believed), found).covariance.tolist()}
    if law is None:
        return out
    candidates, _ = candidates_of(linear, empirical=False)
    own = next(c for c in candidates if c.name == law)
    shift = np.repeat(_shift(own, measured.hidden[law])[:, None], DRAWS, axis=1)
    chance = ExpectedDiagnosis(with_scatter(linear, told.fitted), candidates).chance(law, shift, rng)
    return out | {"detected": chance.detected, "named": chance.named, "misnamed": chance.misnamed}


def _shift(candidate: Candidate, true: dict[str, float]) -> Array:
    """(n,) what true parameters do to what the views see."""
    values = np.array([true.get(p.name, 0.0) for p in candidate.parameters])
    fitted = np.array([not p.grid for p in candidate.parameters])
    whole = [form for form in candidate.forms if form.keep.sum() == fitted.sum()]
    nearest = min(whole, key=lambda form: np.abs(form.term.values - values)[~fitted].sum())
    return np.asarray(nearest.columns @ values[nearest.keep])


def diagnosed(measured: Measured, predicted: Row) -> Row:
    """The verdict about the simulated scans; of a cell with nothing hidden, the error of the hand-eye too."""
    session, capture = session_of(measured), captured(measured)
    measurement = with_part_origin(measurement_of(session, capture), measured.T_mount)
    freed = unconstrained_poses(capture, capture.poses(measured.T_mount), 4 * capture.spacing)
    model = Model(measured.T_mount)
    linear = surface_model(measurement, model, capture, freed)
    selection = gather_evidence(linear, candidates_of(linear)[0], scatter_limit(session))
    out: Row = {"verdict": selection.verdict, "said": [r.name for r in selection.named]}
    if not measured.hidden:
        errors = prior_pose_errors([measurement], model, [freed.overlaps.gram.centre])
        T_mount = fit_hand_eye([capture], [freed], measured.T_mount, errors=errors).T_mount
        xi = frames.log(frames.inverse(measured.T_mount) @ T_mount)
        out["chi_square"] = float(xi @ np.linalg.solve(np.array(predicted["covariance"]), xi))
    return out


def table(rows: Sequence[Row]) -> str:
    """What was predicted against what came, in bins of the predicted chance."""
    hidden = [row for row in rows if row["law"] is not None]
    named = {id(row): row["verdict"] == "missing_effect" and row["said"] == [row["law"]] for row in hidden}
    came = {
        "detected": lambda row: row["verdict"] != "adequate",
        "named": lambda row: named[id(row)],
        "misnamed": lambda row: row["verdict"] == "missing_effect" and not named[id(row)],
    }
    lines = ["| | chance stated | cells | mean of it | came |", "|---|---|---:|---:|---:|"]
    for what, hit in came.items():
        for low, high in pairwise(_BINS):
            own = [row for row in hidden if low <= row[what] < high or row[what] == high == 1.0]
            if own:
                mean = np.mean([row[what] for row in own])
                came_text = _share(sum(map(hit, own)), len(own))
                lines.append(f"| {what} | {low:.0%} to {high:.0%} | {len(own)} | {mean:.0%} | {came_text} |")
    empty = [row for row in rows if row["law"] is None]
    alarms = sum(row["verdict"] != "adequate" for row in empty)
    squares = [row["chi_square"] for row in empty]
    nothing = f"Nothing hidden: {_share(alarms, len(empty))} of {len(empty)} alarm"
    lines += ["", f"{nothing}; χ²/6 of the hand-eye under the stated covariance {np.mean(squares) / 6:.2f} on average."]
    if len(rows) < _ENOUGH:
        lines += ["", f"Only {len(rows)} cells so far: too few to say that the chances are calibrated."]
    return "\n".join(lines)


def _share(hits: int, of: int) -> str:
    low, high = binomtest(hits, of).proportion_ci(method="wilson")
    return f"{hits} ({low:.0%}–{high:.0%})"


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--cells", type=int, default=30)
    parser.add_argument("--rows", type=Path, default=Path("plan-rows.jsonl"))
    parser.add_argument("--write", action="store_true", help="put the table into docs/plan.md")
    given = parser.parse_args()
    rows = [json.loads(line) for line in given.rows.read_text().splitlines()] if given.rows.exists() else []
    with library_threads_off():
        for index in set(range(given.cells)) - {row["index"] for row in rows}:
            rows.append(trial(index))
            print({k: v for k, v in rows[-1].items() if k != "covariance"}, flush=True)
            with given.rows.open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    printed = table(sorted(rows, key=lambda row: row["index"]))
    print(printed)
    if given.write:
        text = _PAGE.read_text(encoding="utf-8")
        before, rest = text.split(_MARKS[0])
        _PAGE.write_text(f"{before}{_MARKS[0]}\n{printed}\n{_MARKS[1]}{rest.split(_MARKS[1])[1]}", encoding="utf-8")


if __name__ == "__main__":
    main()
