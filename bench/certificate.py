"""Does a certificate pass what is right, and fail what is wrong?

Sphere plates in cells of known truth, the hand-eye from one day and the artefact on another, at other poses: clean
cells, and arms that are a little wrong in every joint and link; all scanners have smooth errors that are new in each
scan. The hand-eye of the model is right, or off by so many of its U in a direction drawn at random; or one number is
off by 3 U, or two by 1 mm. The simulator shares no code with the model. Used up: 60000 to 60039, 61000 to 61039,
62000 to 62003.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import trimesh

from bench.harness import Row, Table, markdown, share
from bench.metrology import ARM_AND_NEW, NEW_IN_EACH, PLATE, cell, features_of
from data_synth.fixtures.in_memory import session_of
from data_synth.shapes.spheres import build_plate
from stitch.api.pipeline import run
from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.output.result_document import model_of
from stitch.plugins.metrology.budget import MeasuredFeatures, measure_features
from stitch.plugins.metrology.error_sources import place_errors
from stitch.plugins.metrology.feature_file import FeatureList
from stitch.plugins.metrology.verification import Verification, verify
from stitch.run_data import HandEyeTransfer, RunData

KINDS = (NEW_IN_EACH, ARM_AND_NEW)
U_CALIBRATED = 0.002  # mm, of a laboratory
OFF_BY = (0.0, 3.0, 5.0, 13.0)


def jobs(seeds: range) -> Iterator[Row]:
    """The kinds in turn."""
    yield from ({"seed": seed, "kind": KINDS[seed % len(KINDS)]} for seed in seeds)


def trial(job: Row) -> Row:
    """Return the verdict for every wrong hand-eye, and for wrong numbers under the right one."""
    rng = np.random.default_rng([job["seed"], 5])
    with patch("data_synth.simulate.part_mesh", lambda scene: _plate()):
        part, artefact = (cell(job["kind"], job["seed"], day) for day in range(2))
    model = model_of(run(session_of(part)))
    features, truth = features_of(artefact)
    wanted = _calibrated(features, truth, rng)
    direction = rng.standard_normal(3)
    direction *= 2 * np.sqrt(np.diag(model.covariance))[3:] / np.linalg.norm(direction)
    verdicts = {}
    for by in OFF_BY:
        shift = frames.make(np.eye(3), by * direction)
        try:
            state = run(session_of(artefact), replace(model, T_mount=model.T_mount @ shift))
        except NoResultError:  # millimetres off: no certificate, and the run says that the hand-eye is another's
            verdicts[f"{by:g} U"] = [False]
            continue
        measured, hand_eye = _measured(state, wanted)
        result = verify(measured, None, hand_eye)
        verdicts[f"{by:g} U"] = [result.passed, hand_eye.holds, result.agreeing / len(result.numbers)]
        if not by:
            verdicts["one number by 3 U"] = [_with_wrong_numbers(measured, hand_eye, {0: 3.0}).passed]
            verdicts["two numbers by 1 mm"] = [_with_wrong_numbers(measured, hand_eye, {1: None, 6: None}).passed]
    return {"verdicts": verdicts}


@cache
def _plate() -> trimesh.Trimesh:
    return build_plate(PLATE)


def _calibrated(features: FeatureList, truth: np.ndarray, rng: np.random.Generator) -> FeatureList:
    """Features with the first of their true numbers, off as the laboratory's U allows."""
    first = np.cumsum([0, *(4 if f.kind == "sphere" else 3 if f.kind == "plane" else 1 for f in features.features)])
    known = [
        replace(f, calibrated=float(truth[k] + U_CALIBRATED / 2 * rng.standard_normal()), calibrated_U=U_CALIBRATED)
        for f, k in zip(features.features, first, strict=False)
    ]
    return replace(features, features=tuple(known))


def _measured(state: RunData, wanted: FeatureList) -> tuple[MeasuredFeatures, HandEyeTransfer]:
    assert state.hand_eye_transfer is not None
    return measure_features(place_errors(state), wanted), state.hand_eye_transfer


def _with_wrong_numbers(
    measured: MeasuredFeatures, hand_eye: HandEyeTransfer, wrong: dict[int, float | None]
) -> Verification:
    """The verdict where some features' first numbers are off by so many U, or by 1 mm."""
    numbers = list(measured.numbers)
    first: dict[str, int] = {}
    for k, number in enumerate(numbers):
        first.setdefault(number.feature.name, k)
    places = list(first.values())
    for which, by in wrong.items():
        number = numbers[places[which]]
        numbers[places[which]] = replace(number, value=number.value + (1.0 if by is None else by * number.U))
    return verify(replace(measured, numbers=tuple(numbers)), None, hand_eye)


def summary(rows: list[Row]) -> list[str]:
    """A line for each kind of cell and each thing that is wrong."""
    lines = []
    for kind in (*KINDS, "all"):
        chosen = [row["verdicts"] for row in rows if kind in (row["kind"], "all")]
        for case in chosen[0] if chosen else ():
            passed = [verdicts[case][0] for verdicts in chosen]
            agreeing = [verdicts[case][2] for verdicts in chosen if len(verdicts[case]) > 1]
            within = f"{100 * np.mean(agreeing):.1f} %" if agreeing else "–"
            counts = [share(verdict is expected for verdict in passed) for expected in (True, False, None)]
            lines.append((kind, case, *counts, within))
    return markdown("cell | off | passed | failed | undecided | numbers within U", lines)


TABLE = Table(jobs, trial, summary, range(61017, 61040), page="measure", block="certificate")
