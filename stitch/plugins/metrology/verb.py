"""`stitch.measure`, `stitch.verify` and `stitch.calibrate`: what these commands do, of runs and sessions in memory."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from stitch.api.pipeline import run as stitch_session
from stitch.api.run import Run, public_run
from stitch.api.session import load_session
from stitch.api.stepwise import suggest
from stitch.errors import InputError, did_you_mean
from stitch.model.model_toml import ModelFile
from stitch.numerics.frames import Array
from stitch.output.result_document import model_of
from stitch.plugins.metrology.budget import MeasuredFeatures, measure_features, monte_carlo
from stitch.plugins.metrology.calibrate.robot import calibrated_robot_of_run, link_table, robot_document
from stitch.plugins.metrology.calibrate.sphere import calibrate_sphere, sphere_document
from stitch.plugins.metrology.calibrate.tracker import calibrate_tracker, tracker_document
from stitch.plugins.metrology.datum import into_datum
from stitch.plugins.metrology.error_sources import place_errors
from stitch.plugins.metrology.feature_file import FeatureList, feature_list
from stitch.plugins.metrology.features import Feature
from stitch.plugins.metrology.verification import Verification
from stitch.plugins.metrology.verification import verify as judge
from stitch.run_data import RunData
from stitch.session.session import SessionData
from stitch.system.values import Value, same

Artefact = Literal["sphere", "tracker", "robot"]


@dataclass(frozen=True, eq=False)
class Calibration(Value, document="stitch.plugins.metrology.verb:calibration_document"):
    """Calibration by a known object or a tracker: a hand-eye; or of an arm, with its own errors.

    Example:
        >>> found = stitch.calibrate(ball_session, "sphere")
        >>> found.by, found.hand_eye.shape, found.to_dict()["kind"]
        ('sphere', (4, 4), 'sphere')
    """

    by: str  # sphere | tracker | robot
    hand_eye: Array  # (4, 4) T_mount_scanner, length_unit
    covariance: Array  # (6, 6) of hand_eye·exp(ξ), scanner frame, rotation first; rad and length_unit
    document: dict[str, Any]  # all that the command prints with --json
    run: Run | None = None  # of an arm: with the effects that it lacks


def measure(
    run: RunData, features: Sequence[Feature] | FeatureList | Path | str, *, trials: int = 0
) -> MeasuredFeatures:
    """Find features of the part, each number with its U (k = 2), as `stitch measure` does.

    Args:
        features: a list of `stitch.Feature`, lengths in length_unit, reference frame; or the path of FEATURES.toml.
        trials: so many draws of all sources check the propagation (JCGM 101); 0: none.

    Returns:
        `numbers`, each with `value`, `U` and `shares` by source, and their `covariance` (Q, Q); lengths in length_unit.

    Raises:
        InputError: a feature that is not known, or lacks what it needs.
        NoResultError: too few points lie on each of them.

    Example:
        >>> at = run.stitched.points[len(run.stitched) // 2]
        >>> axis = run.stitched.normals[len(run.stitched) // 2]
        >>> measured = stitch.measure(run, [stitch.Feature("middle", "point", at=at, axis=axis, radius=15.0)])
        >>> measured.numbers[0].name, measured.numbers[0].U > 0
        ('middle.deviation', True)
    """
    wanted = feature_list(features, run.session.length_unit, run.measurement.capture.spacing)
    places, T = into_datum(place_errors(run), wanted)
    measured = replace(measure_features(places, wanted), T_datum_reference=T)
    if not trials:
        return measured
    seen = replace(wanted, features=tuple(f for f in wanted.features if f.name not in measured.not_measured))
    return replace(measured, checked=monte_carlo(places, seen, measured.fits, trials))


def verify(
    run: RunData, session: SessionData, features: Sequence[Feature] | FeatureList | Path | str | None = None
) -> Verification:
    """Find whether an artefact that no fit has seen agrees with a run's hand-eye and effects, as `stitch verify` does.

    Args:
        session: scans of the artefact, taken with that cell.
        features: its calibrated features, with `calibrated` and `calibrated_U` in length_unit; None: artefact.toml of
            the session's folder.

    Returns:
        `passed` (None: cannot be decided), `sentences`, and `numbers` with deviation and E_n; lengths in length_unit.

    Raises:
        InputError: scans that the run was fitted on, or no calibrated feature.
        NoResultError: too few points lie on the features.

    Example:
        >>> at = run.stitched.points.mean(axis=0)
        >>> ball = stitch.Feature("ball", "sphere", at=at, size=20.0, calibrated=20.0, calibrated_U=0.001)
        >>> try:
        ...     stitch.verify(run, session, [ball])
        ... except stitch.InputError as error:
        ...     print(error.what)
        s: the run was fitted on its scan of view v000
    """
    fitted = [view.cloud for view in run.session.views if view.cloud is not None]
    for view in session.views:
        if any(same(view.cloud, cloud) for cloud in fitted):
            raise InputError(
                f"{session.name}: the run was fitted on its scan of view {view.name}; to fix: pass a session of an "
                "artefact that no fit has seen"
            )
    listed = session.path / "artefact.toml" if features is None else features
    return judge_artefact(session, model_of(run), listed)[0]


def judge_artefact(
    session: SessionData, model: ModelFile, features: Sequence[Feature] | FeatureList | Path | str
) -> tuple[Verification, RunData]:
    """Return what an artefact says of a model, and its session stitched under the model.

    Raises:
        InputError: no feature is calibrated.
    """
    state = stitch_session(session, model)
    wanted = feature_list(features, state.session.length_unit, state.measurement.capture.spacing)
    if all(feature.calibrated is None for feature in wanted.features):
        where = f"{features}: " if isinstance(features, str | Path) else ""
        raise InputError(
            f"{where}no feature is calibrated",
            fix_cli="write calibrated = … and U = … of some",
            fix_python="state calibrated and calibrated_U of some",
        )
    if wanted.datum:
        raise InputError(f"{session.name}: an artefact is judged as it lies; to fix: leave out its datum")
    measured = measure_features(place_errors(state), wanted)
    assert state.hand_eye_transfer is not None
    return judge(measured, wanted.limits, state.hand_eye_transfer), state


def calibrate(
    session: SessionData | Path | str, by: Artefact, *, radius_free: bool = False, at_most: int = 8
) -> Calibration:
    """Find a hand-eye from a known object or a tracker, or an arm's own errors, as `stitch calibrate` does.

    Args:
        session: one in memory, or its folder: `sphere` and `tracker` read what lies in it.
        by: "sphere" of known radius, "tracker" with frames, or "robot": the arm by labelled points.
        radius_free: fit the sphere's radius too.
        at_most: effects of the arm.

    Returns:
        Hand-eye (4, 4) and covariance (6, 6), lengths in length_unit, angles in rad; of an arm its run too.

    Raises:
        InputError: the session has no such object.
        NoResultError: the views show no hand-eye.

    Example:
        >>> stitch.calibrate(ball_session, "sphere").covariance.shape
        (6, 6)
    """
    ways = ("sphere", "tracker", "robot")
    if by not in ways:
        raise InputError(f"calibrate: by {by!r}{did_you_mean(by, ways)}; to fix: one of {', '.join(ways)}")
    loaded = session if isinstance(session, SessionData) else load_session(session, at_most=None)
    if by == "robot":
        return _calibrated_arm(loaded, at_most)
    if by == "sphere":
        document = sphere_document(calibrate_sphere(loaded, radius_free), loaded)
    else:
        document = tracker_document(calibrate_tracker(loaded), loaded)
    return Calibration(by, np.array(document["hand_eye"]), np.array(document["hand_eye_covariance"]), document)


def calibration_document(calibration: Calibration) -> dict[str, Any]:
    """Return what `stitch calibrate --json` prints."""
    return calibration.document


def _calibrated_arm(session: SessionData, at_most: int) -> Calibration:
    first = stitch_session(session)
    calibrated_robot_of_run(first)
    better, lines, diagnosis = suggest(first, at_most)
    state = better or first
    document = robot_document(state, link_table(session), lines, diagnosis.sentence)
    return Calibration("robot", state.T_mount, state.mount_covariance, document, public_run(state, None))
