"""What the commands do, from Python: run, diagnose, add, drop, compare, next_view, report; plug-ins add theirs.

An entry point of the group `stitch.verbs` makes the function NAME of a plug-in `stitch.NAME`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from stitch.api import pipeline, stepwise
from stitch.api.pipeline import join_scanners
from stitch.api.run import ReplayRecorder, Run, public_run
from stitch.api.session import Session, public_session
from stitch.diagnosis.diagnosis import Diagnosis, Proposal
from stitch.effects.contract import find_effect
from stitch.errors import InputError
from stitch.model.model_toml import ModelFile, keep_arm_effects
from stitch.output import stored_run
from stitch.output.comparison.residual_tables import ResidualTables, compare_surfaces, compare_targets
from stitch.output.comparison.two_runs import compare_runs
from stitch.output.result_document import model_of
from stitch.output.run_folder import call_entry_points
from stitch.recorder import Recorder
from stitch.run_data import FusedCloud, RunData
from stitch.session.scanners import have_own_hand_eyes
from stitch.session.session import SessionData
from stitch.system.files import whole_file

Register = Literal["dpwvm", "gicp", "vmm"]


def run(
    session: SessionData | Sequence[SessionData],
    model: ModelFile | RunData | None = None,
    recorder: Recorder | None = None,
    effects: Sequence[str] = (),
    keep: bool = False,
    arm: ModelFile | RunData | None = None,
    register: Register = "dpwvm",
    progress: Callable[[str], object] | None = None,
) -> Run:
    """Stitch one session: correct the hand-eye from the scans, register, fuse.

    Args:
        session: or a list of sessions of several scanners in one cell, each with a name of its own: one run, with a
            hand-eye a scanner in `scanners`.
        model: a run, or a model that was read, whose hand-eye and effects are used as they are.
        recorder: is told of every stage.
        effects: names of effects to fit together with the hand-eye.
        keep: fuse also the views that do not belong.
        arm: a run, or a model, of whose joints and links the effects stay as they are, while all else is fitted.
        register: method by which single views are registered, "dpwvm", "gicp" or "vmm"; labelled points need none.
        progress: is called with a line a stage, as the logger `stitch` is.

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
    recorders = None if recorder is None else [recorder]
    sessions = [session] if isinstance(session, SessionData | str | Path) else session
    if isinstance(sessions, Sequence) and len(sessions) > 1:
        _require_sessions(sessions)
        if not have_own_hand_eyes(sessions):
            raise InputError(
                "stitch.run: several sessions of one scanner, or of scanners without names; to fix: stitch.run_rig for "
                'one scanner, or [scanner] name = "left" in each session.toml'
            )
        sessions = [join_scanners(sessions, *_models(model, arm))]
    return run_rig(sessions, model, recorders, effects, keep, arm, register, progress)[0]


def run_rig(
    sessions: Sequence[SessionData],
    model: ModelFile | RunData | None = None,
    recorders: Sequence[Recorder] | None = None,
    effects: Sequence[str] = (),
    keep: bool = False,
    arm: ModelFile | RunData | None = None,
    register: Register = "dpwvm",
    progress: Callable[[str], object] | None = None,
) -> list[Run]:
    """Stitch several sessions of one rig with common effects and, of scans, one hand-eye; one run a session.

    Args:
        sessions: of one scanner on one mount, or labelled points of one arm, in one length_unit.
        model, recorders, effects, keep, arm, register, progress: as `stitch.run` takes them, a recorder a session.

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
    _require_sessions(sessions)
    replays = [ReplayRecorder(recorder, progress) for recorder in recorders or (None,) * len(sessions)]
    known_model, kept_arm = _models(model, arm)
    known_effects = [find_effect(name).name for name in _names(effects)]
    runs = pipeline.run_rig(sessions, known_model, replays, known_effects, keep, kept_arm, register=register)
    return [
        public_run(run, public_session(session), replay)
        for run, session, replay in zip(runs, sessions, replays, strict=True)
    ]


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
    return replace(public_run(replace(run, source=run.fit), None), folder=folder)


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
    return pipeline.diagnose(run)


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
    return _changed(run, stepwise.effects_with(run, effects, run.session.name), recorder)


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
    return _changed(run, stepwise.effects_without(run, effects, run.session.name), recorder)


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
    return compare_surfaces(run) if run.measurement.capture.scans else compare_targets(run)


def next_view(run: RunData | Diagnosis) -> tuple[Proposal, ...]:
    """Return what to measure next, as `stitch next` does: poses or artefacts that separate what cannot be told apart.

    Args:
        run: a run, which is diagnosed, or its diagnosis.

    Returns:
        Proposals, the most telling first: `do` in words, `separates` effects, and of a pose `joints_deg` (in radians:
        np.radians).

    Raises:
        NoResultError: no two views overlap.

    Example:
        >>> all(proposal.do for proposal in stitch.next_view(run))
        True
    """
    return (run if isinstance(run, Diagnosis) else diagnose(run)).next


def report(
    run: RunData,
    file: Path | str,
    *,
    other: RunData | None = None,
    diagnosis: Diagnosis | None = None,
    tolerance: float | None = None,
) -> Path:
    """Write the page of a run, as `stitch report` does, and return its path.

    Args:
        file: of the page, NAME.html; it is written whole or not at all.
        other: another run: the page says what changed from `run` to it.
        diagnosis: of the run, which the page then shows.
        tolerance: within which the views have to agree on the part, length_unit.

    Raises:
        InputError: no place for a page, two runs that cannot be compared, or nothing that draws is installed.

    Example:
        >>> stitch.report(run, folder / "page.html").name
        'page.html'
    """
    page = Path(file)
    if page.suffix != ".html" or not page.parent.is_dir():
        raise InputError(
            f"{page}: no place for a page; to fix: name a file that ends in .html, in a folder that exists"
        )
    with TemporaryDirectory() as scratch:
        written = Path(scratch) / "report.html"
        if other is not None:
            both = compare_runs([run, other], [run.session.name, other.session.name])
            call_entry_points("stitch.two_run_reports", both, written, tolerance, required=True)
        else:
            call_entry_points("stitch.reports", run, written, tolerance, required=True)
        if not written.is_file():
            raise InputError("report: nothing that draws is installed; to fix: install stitch with its package viz")
        if diagnosis is not None:
            call_entry_points("stitch.diagnosis_reports", diagnosis, run, written.parent)
        with whole_file(page) as out:
            out.write_bytes(written.read_bytes())
    return page


def stored_cloud(run: RunData) -> FusedCloud:
    """Return the stitched cloud rounded as stitched.ply keeps it, to single precision; arrays of float64 again."""
    names = ("points", "normals", "residual")
    return replace(run.fused, **{name: getattr(run.fused, name).astype(np.float32).astype(float) for name in names})


def _require_sessions(sessions: Sequence[Any]) -> None:
    """Refuse a list with anything that is no session.

    Raises:
        InputError: says what the first such thing is, and how to make a session of it.
    """
    odd = next((session for session in sessions if not isinstance(session, SessionData)), None)
    if isinstance(odd, str | Path):
        raise InputError(f"stitch.run: {odd} is a path; to fix: pass stitch.load_session({str(odd)!r})")
    if odd is not None:
        raise InputError(
            f"stitch.run: got a {type(odd).__name__}, no session; to fix: pass "
            "stitch.Session.from_arrays(clouds, poses, mount=…)"
        )


def _names(effects: Sequence[str]) -> Sequence[str]:
    """Return names of effects as they are; a string in place of a list is refused.

    Each of its letters would be taken for a name.

    Raises:
        InputError: `effects` is a string.
    """
    if isinstance(effects, str):
        raise InputError(f"effects: {effects!r} is a text, and a list is asked for; to fix: pass [{effects!r}]")
    return effects


def _models(
    model: ModelFile | RunData | None, arm: ModelFile | RunData | None
) -> tuple[ModelFile | None, ModelFile | None]:
    """Return `model` and `arm` of `run` as files of models state them; of an arm only effects of joints and links."""
    kept = keep_arm_effects(model_of(arm)) if isinstance(arm, RunData) else arm
    return model_of(model) if isinstance(model, RunData) else model, kept


def _changed(run: RunData, effects: Sequence[str], recorder: Recorder | None) -> Run:
    """Return the run fitted again with exactly these effects; `recorder` is told of every stage."""
    replay = ReplayRecorder(recorder)
    whole_session: Session | None = run.measured if isinstance(run, Run) else None
    return public_run(pipeline.change(run, effects, replay), whole_session, replay)
