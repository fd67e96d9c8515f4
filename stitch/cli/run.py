"""`stitch run SESSION...`: coarse → correct → register → fuse, one run folder per call."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import EffectsFile, Force, Json, Tolerance, Trust, require_tolerance
from stitch.cli.progress import Progress
from stitch.cli.progress_lines import ProgressLines, wanted
from stitch.cli.run_summary import show
from stitch.cli.streams import emit
from stitch.effects.in_session import known
from stitch.effects.user_file import load as load_effects
from stitch.errors import InputError
from stitch.measurement.session import Session
from stitch.model.arm import kept_arm
from stitch.model.model_toml import ModelFile, write_model
from stitch.pipeline import run_rig
from stitch.reading.session_folder import load_session
from stitch.runs.recorder import Recorder
from stitch.runs.tee import Tee
from stitch.stored.trusted_model import trusted_model
from stitch.writing import run_folder
from stitch.writing.json_file import to_json
from stitch.writing.mesh import write_mesh
from stitch.writing.recordings import recordings
from stitch.writing.result_document import model_of, result_document
from stitch.writing.run_contents import FILES


def run(
    sessions: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[SESSION]...", help="Session folders of one rig; default: the one you stand in."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="RUN", help="Run folder; default runs/NAME.")
    ] = None,
    hand_eye: Annotated[
        Path | None, typer.Option("--hand-eye", metavar="RUN2", help="Use the model of another run, do not correct.")
    ] = None,
    arm: Annotated[
        Path | None,
        typer.Option("--arm", metavar="RUN2", help="Keep the arm of another run (joints, links), fit all else."),
    ] = None,
    effects: Annotated[str, typer.Option("--effects", help="Effects to fit, separated by commas.")] = "",
    effects_file: EffectsFile = None,
    trust: Trust = False,
    force: Force = False,
    keep: Annotated[bool, typer.Option("--keep", help="Fuse also the views that do not belong.")] = False,
    recording: Annotated[bool, typer.Option("--recording/--no-recording", help="Write recording.rrd.")] = True,
    mesh: Annotated[bool, typer.Option("--mesh", help="Also write mesh.ply.")] = False,
    tolerance: Tolerance = None,
    as_json: Json = False,
) -> None:
    """Find and correct the hand-eye, register the views, fuse them.

    \b
    Examples:
      stitch run blade-17
      stitch run
      stitch run blade-17 -o found --effects joint_offset,backlash
      stitch run monday tuesday -o both
      stitch run blade-18 --hand-eye found --mesh
      stitch run other-scanner --arm found
    """
    require_tolerance(tolerance)
    names_of_effects = [name.strip() for name in effects.split(",") if name.strip()]
    if effects_file:
        load_effects(effects_file)
    for name in names_of_effects:
        known(name)
    here = not sessions
    sessions = sessions or [_here()]
    loaded = [load_session(path) for path in sessions]
    names = _names(loaded)
    target = output or Path("../runs" if here else "runs") / "+".join(names)
    model, kept, own_effects = _given(hand_eye, arm, names_of_effects, effects_file, trust)
    with run_folder.new_folder(target, sessions, force) as scratch:
        folders = _folders(scratch, names)
        recorders = [recorder_for(folder, recording) for folder in folders]
        runs = run_rig(loaded, model, recorders, names_of_effects, keep, kept)
        runs = [replace(result, effects_file=own_effects or result.effects_file) for result in runs]
        for result, folder in zip(runs, folders, strict=True):
            run_folder.write_with_page(result, folder, tolerance)
            if mesh:
                write_mesh(result.fused, folder / "mesh.ply")
        if len(runs) > 1:
            write_model(model_of(runs[0]), scratch / "model.toml")
    documents = [result_document(result) for result in runs]
    if as_json:
        emit(to_json(documents[0] if len(documents) == 1 else documents))
    else:
        show(runs, target)


def _given(
    hand_eye: Path | None, arm: Path | None, effects: Sequence[str], effects_file: Path | None, trust: bool
) -> tuple[ModelFile | None, ModelFile | None, str | None]:
    """The model that is used as it is, the arm that is kept, and the file of the user's own effects, if any."""
    if hand_eye and (effects or arm):
        raise InputError(
            f"{'--arm' if arm else '--effects'} and --hand-eye: a model that is used as it is brings its own effects; "
            "name one of the two"
        )
    own = str(effects_file.resolve()) if effects_file else None
    if hand_eye:
        return trusted_model(hand_eye, effects_file, trust)[0], None, own
    if arm is None:
        return None, None, own
    stated, file = trusted_model(arm, effects_file, trust)
    kept = kept_arm(stated)
    if twice := set(effects) & set(kept.effects):
        raise InputError(f"--effects {twice.pop()}: the arm of {arm} brings it already; to fix: leave it out")
    return None, kept, own or file


def _here() -> Path:
    """The folder one stands in, if it is a session."""
    if not Path("session.toml").is_file():
        raise InputError("run what? this folder has no session.toml; to fix: name a session folder, or go into one")
    return Path.cwd()


def _names(sessions: list[Session]) -> list[str]:
    """Names of the sessions: their folders in the folder of a rig."""
    names = [session.name for session in sessions]
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise InputError(f"two sessions are named {twice!r}; give each its own name in session.toml")
    if len(names) > 1 and (taken := FILES & set(names)):
        named = taken.pop()
        raise InputError(f"a session is named {named!r}, as a file of the run is; give it another in session.toml")
    return names


def _folders(scratch: Path, names: list[str]) -> list[Path]:
    folders = [scratch] if len(names) == 1 else [scratch / name for name in names]
    for folder in folders:
        folder.mkdir(exist_ok=True)
    return folders


def recorder_for(folder: Path, recording: bool) -> Recorder:
    """Progress on a terminal or as lines, and the recording."""
    lines: list[Recorder] = [ProgressLines()] if wanted() else []
    return Tee([Progress(), *lines, *(recordings(folder) if recording else [])])
