"""What the commands do, from Python: run, diagnose, add, drop, compare, explain, plan, export."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.api import pipeline
from stitch.api.run import ReplayRecorder, Run, public_run
from stitch.api.session import Session, public_session
from stitch.diagnosis.diagnose import linear_model_of
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.effects.contract import find_effect
from stitch.errors import InputError
from stitch.fit.correct import gate_of_model
from stitch.fusion.register import DEFAULT
from stitch.model.forward import corrected_capture
from stitch.model.model_toml import ModelFile, keep_arm_effects
from stitch.numerics.frames import Array
from stitch.output import stored_run
from stitch.output.comparison.residual_tables import ResidualTables, compare_surfaces, compare_targets
from stitch.output.diagnosis_document import diagnosis_document
from stitch.output.result_document import model_of, result_document
from stitch.plugins.explain import explain as explanation
from stitch.plugins.explain.explain import EFFECT_NAME, Explanation
from stitch.plugins.export.cloud_formats import CLOUD_FORMATS, coloured
from stitch.plugins.export.hand_eye_formats import HAND_EYE_FORMATS, hand_eye_from
from stitch.plugins.metrology.calibrate.arm_model import ARM_FORMATS, arm_from
from stitch.plugins.metrology.planning import plan as planning
from stitch.plugins.metrology.planning.expected_model import PlannedCell, cell_of_session, cell_of_state
from stitch.plugins.metrology.planning.plan import Plan, PlanRequest
from stitch.recorder import Recorder
from stitch.run_data import RunData
from stitch.session.session import SessionData
from stitch.system.files import whole_file
from stitch.system.threads import library_threads_off


def run(
    session: SessionData,
    model: ModelFile | RunData | None = None,
    recorder: Recorder | None = None,
    effects: Sequence[str] = (),
    keep: bool = False,
    arm: ModelFile | RunData | None = None,
    register: str = DEFAULT,
) -> Run:
    """Stitch one session: correct the hand-eye from the scans, register, fuse.

    Args:
        model: a run, or a model that was read, whose hand-eye and effects are used as they are.
        recorder: is told of every stage.
        effects: names of effects to fit together with the hand-eye.
        keep: fuse also the views that do not belong.
        arm: a run, or a model, of whose joints and links the effects stay as they are, while all else is fitted.
        register: method by which single views are registered, "dpwvm" or "gicp"; labelled points need none.

    Returns:
        The run: hand-eye (4, 4) in the mount frame, poses (V, 4, 4) and cloud (N, 3) in the reference frame; lengths in
        the session's length_unit, angles in rad.

    Raises:
        InputError: the model belongs to another mount, or the session cannot have an effect as the model has it.
        NoResultError: no hand-eye was found, or the views do not overlap.

    Example:
        >>> run = stitch.run(session)
        >>> run.hand_eye.pose.shape
        (4, 4)
    """
    return run_rig([session], model, None if recorder is None else [recorder], effects, keep, arm, register=register)[0]


def run_rig(
    sessions: Sequence[SessionData],
    model: ModelFile | RunData | None = None,
    recorders: Sequence[Recorder] | None = None,
    effects: Sequence[str] = (),
    keep: bool = False,
    arm: ModelFile | RunData | None = None,
    register: str = DEFAULT,
) -> list[Run]:
    """Stitch several sessions of one rig with common effects and, of scans, one hand-eye; one run a session.

    Args:
        sessions: of one scanner on one mount, or labelled points of one arm, in one length_unit.
        model, recorders, effects, keep, arm, register: as `stitch.run` takes them, a recorder a session.

    Returns:
        A run a session, shapes and frames as of `stitch.run`; of scans their hand-eyes (4, 4) are the same.

    Raises:
        InputError: sessions of different rigs, and as `stitch.run`.
        NoResultError: as `stitch.run`.

    Example:
        >>> runs = stitch.run_rig([session, other])
        >>> bool((runs[0].T_mount == runs[1].T_mount).all())
        True
    """
    others: Sequence[Recorder | None] = recorders or [None] * len(sessions)
    replays = [ReplayRecorder(other) for other in others]
    stated = None if arm is None else keep_arm_effects(_model(arm)) if isinstance(arm, RunData) else arm
    fitted = None if model is None else _model(model)
    found = pipeline.run_rig(sessions, fitted, replays, _names(effects), keep, stated, register=register)
    return [public_run(*own) for own in zip(found, map(public_session, sessions), replays, strict=True)]


def load_run(folder: Path | str, effects_file: Path | None = None, trust: bool = False) -> Run:
    """Read a run folder; its session is read again and nothing is fitted.

    Args:
        effects_file: Python file of effects, in place of the one that the model names.
        trust: run the file that the model names.

    Returns:
        The run with the numbers of its files: hand-eye (4, 4), poses (V, 4, 4) and cloud (N, 3) as of `stitch.run`. Its
        residuals are found anew.

    Raises:
        InputError: no run folder, a damaged one, or its session has gone.

    Example:
        >>> saved = run.save(folder / "again", recording=False)
        >>> again = stitch.load_run(saved)
        >>> bool((again.T_mount == run.T_mount).all())
        True
    """
    folder = Path(folder)
    run = stored_run.load_run(folder, effects_file, trust=trust)
    return public_run(replace(run, source=run.fit), None)


def diagnose(run: RunData) -> Diagnosis:
    """Find which effect is missing in the model of a run, as `stitch diagnose` does.

    Args:
        run: a run in memory or of a folder.

    Returns:
        Verdict, sentence and candidates; sizes in rad and in the session's length_unit, of the flange's poses.

    Raises:
        NoResultError: no two views overlap.

    Example:
        >>> found = stitch.diagnose(run)
        >>> found.verdict in ("adequate", "missing_effect", "cannot_tell", "unknown_effect")
        True
    """
    return pipeline.diagnose(_state(run))


def add(run: RunData, *effects: str, recorder: Recorder | None = None) -> Run:
    """Return the run with further effects in its model, hand-eye and all effects fitted anew.

    Args:
        effects: names of the library, such as those that a diagnosis has in `effects`.
        recorder: is told of every stage.

    Returns:
        A new run: hand-eye (4, 4), poses (V, 4, 4) and cloud (N, 3) as of `stitch.run`; its `ledger` has a step more.

    Raises:
        InputError: an effect that is not known, that the session cannot have, or that is in the model already.
        NoResultError: no two views overlap.

    Example:
        >>> better = stitch.add(run, "range_scale")
        >>> better.effects, len(better.ledger)
        (['range_scale'], 2)
    """
    return _changed(run, pipeline.effects_with(run, effects, run.session.name), recorder)


def drop(run: RunData, *effects: str, recorder: Recorder | None = None) -> Run:
    """Return the run without some effects, hand-eye and the rest fitted anew.

    Args:
        effects: names of effects that are in the model.
        recorder: is told of every stage.

    Returns:
        A new run: hand-eye (4, 4), poses (V, 4, 4) and cloud (N, 3) as of `stitch.run`; its `ledger` has a step more.

    Raises:
        InputError: an effect that is not in the model.
        NoResultError: no two views overlap.

    Example:
        >>> stitch.drop(better, *better.effects).effects
        []
    """
    return _changed(run, pipeline.effects_without(run, effects, run.session.name), recorder)


def compare(run: RunData) -> ResidualTables:
    """Compute how the residuals of a run depend on everything that is known of its views, as `stitch compare` does.

    Returns:
        Tables by view, pair, joint, place on the part (reference frame), field, time; lengths in length_unit.

    Raises:
        NoResultError: no two views overlap.

    Example:
        >>> found = stitch.compare(run)
        >>> found.rms > 0, len(found.table("view").label)
        (True, 5)
    """
    state = _state(run)
    return compare_surfaces(state) if state.measurement.capture.scans else compare_targets(state)


def explain(run: RunData) -> Explanation:
    """Find a formula for what the model of a run leaves, as `stitch explain` does.

    Returns:
        `found`, `why` in a sentence, `formula` in rad and length_unit, and `source`, a Python file of effects.

    Raises:
        InputError: a formula of such a search is in the model already.
        NoResultError: no two views overlap.

    Example:
        >>> stitch.explain(run).found
        False
    """
    state = _state(run)
    if EFFECT_NAME in state.model.effects:
        raise InputError(
            f"{state.session.name}: has an effect {EFFECT_NAME!r} in its model; to fix: give it another name in "
            "its file, "
            "and add that"
        )
    return explanation.explain(linear_model_of(state), f"Found by `stitch explain` in {state.session.name}.")


def plan(
    cell: SessionData | RunData,
    *,
    views: int | None = None,
    split: tuple[str, str] | None = None,
    halve: bool = False,
    feature: Any = None,
    part: Path | str | None = None,
    size: float | None = None,
    field: float | None = None,
) -> Plan:
    """Compute what views would show before they are taken, and which further ones help most, as `stitch plan` does.

    Args:
        cell: a run, which knows its cell, or a session whose views are planned.
        views: at most so many further ones.
        split: two effects that they are to tell apart.
        halve: they are to halve the uncertainty of the hand-eye and nothing else.
        feature: (3,) at which the uncertainty counts, reference frame, length_unit; or (6,) with a normal, along it.
        part: mesh, or cloud with normals, of a session's part.
        size: its longest side, mm, where nothing else is known.
        field: full angle of the scanner's field, degrees.

    Returns:
        `now`, `proposed` with joints (n,) in rad and T_base_flange (4, 4) in length_unit, and `after`.

    Raises:
        InputError: an effect that is not known, or a cell of which too little is.

    Example:
        >>> outlook = stitch.plan(run, views=2).now
        >>> outlook.views
        5
    """
    for name in split or ():
        find_effect(name)
    at = None if feature is None else np.asarray(feature, float).reshape(-1)
    split_any = not halve and at is None
    wanted = PlanRequest(halve=halve or split is None, split=split, split_any=split_any, views=views, feature=at)
    if isinstance(cell, RunData):
        return planning.plan_further_views(cell.session, _cell_of(cell), wanted)
    planned = cell_of_session(cell, None if part is None else Path(part), size, field)
    return planning.plan_further_views(cell, planned, wanted)


def export_run(
    run: RunData,
    to: str,
    file: Path | str | None = None,
    *,
    parent: str | None = None,
    child: str = "scanner",
    diagnosis: Diagnosis | None = None,
) -> str | None:
    """Write what a run found for other programs, as `stitch export RUN --to` does.

    It is not called `stitch.export`, which is the package that does it.

    Args:
        to: ros, urdf, opencv, zivid, kuka, fanuc, abb or ur for the hand-eye; arm-dh or arm-urdf; ply, pcd, las, laz,
            e57 or glb for the stitched cloud.
        file: is written, whole or not at all; a cloud needs one.
        parent, child: names of the frames that carry the scanner and are the scanner's own.
        diagnosis: of the run; what is written says what it found.

    Returns:
        The text, of T_parent_child (4, 4) in the unit that it states, U beside it; None of a cloud, which is written in
        the reference frame.

    Raises:
        InputError: a format that is not known, no file for a cloud, or a run that has no such thing.

    Example:
        >>> "T_flange_scanner" in stitch.export_run(run, "ros")
        True
        >>> stitch.export_run(run, "ply", folder / "cloud.ply")
    """
    path = None if file is None else Path(file)
    if to in CLOUD_FORMATS:
        _cloud(run, to, path)
        return None
    if to in ARM_FORMATS:
        session = run.measured if isinstance(run, Run) and run.measured is not None else run.session
        text = ARM_FORMATS[to](arm_from(session, model_of(run)))
    elif to in HAND_EYE_FORMATS:
        document = {} if diagnosis is None else diagnosis_document(diagnosis)
        text = HAND_EYE_FORMATS[to](hand_eye_from(result_document(run), model_of(run), document, parent, child))
    else:
        raise InputError(
            f"{to}: no such format; to fix: one of {', '.join((*HAND_EYE_FORMATS, *ARM_FORMATS, *CLOUD_FORMATS))}"
        )
    if path is not None:
        with whole_file(path) as out:
            out.write_text(text, encoding="utf-8")
    return text


def _cloud(run: RunData, to: str, file: Path | None) -> None:
    """Write the stitched cloud; precision as of stitched.ply, which holds it in a run folder."""
    if file is None or file.suffix.lower() != f".{to}":
        raise InputError(f"{to}: where to? to fix: name the file NAME.{to}")
    if not len(run.fused.points):
        raise InputError(f"{run.session.name}: labelled points alone give no cloud; there is none to export")
    names = ("points", "normals", "residual")
    fused = replace(run.fused, **{name: _single(getattr(run.fused, name)) for name in names})
    with whole_file(file) as out:
        CLOUD_FORMATS[to][0](coloured(fused, run.session.length_unit), out)


def _single(values: Array) -> Array:
    """Numbers with the digits that a file of single precision keeps."""
    return np.asarray(values, np.float32).astype(np.float64)


def _model(model: ModelFile | RunData) -> ModelFile:
    return model_of(model) if isinstance(model, RunData) else model


def _names(effects: Sequence[str]) -> list[str]:
    """Names of effects, each of which is known."""
    return [find_effect(name).name for name in effects]


def _state(run: RunData) -> RunData:
    """Return what a command reads of the run's folder: partners are looked for within the gate of the model alone."""
    with library_threads_off():
        return replace(run, gate=gate_of_model(corrected_capture(run.measurement, run.model), run.T_mount))


def _changed(run: RunData, effects: Sequence[str], recorder: Recorder | None) -> Run:
    replay = ReplayRecorder(recorder)
    whole_session: Session | None = run.measured if isinstance(run, Run) else None
    return public_run(pipeline.change(_state(run), effects, replay), whole_session, replay)


def _cell_of(run: RunData) -> PlannedCell:
    if not run.session.has_clouds:
        raise InputError(f"{run.session.name}: a run of labelled points; plans are made for scans; to fix: diagnose it")
    return cell_of_state(_state(run), _single(run.fused.points), _single(run.fused.normals))
