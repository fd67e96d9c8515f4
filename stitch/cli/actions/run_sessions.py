"""What `stitch run` does: sessions of one rig into one run folder."""

from dataclasses import replace
from pathlib import Path

from stitch.cli.run_options import ModelOptions, RunOptions
from stitch.cli.terminal.live_line import show_activity
from stitch.cli.terminal.recorders import recorder_for
from stitch.cli.terminal.run_summary import show_run
from stitch.cli.terminal.streams import emit
from stitch.effects.in_session import find_effect
from stitch.effects.user_file import load as load_effects
from stitch.errors import InputError
from stitch.measurement.session import Session
from stitch.model.arm import keep_arm_effects
from stitch.model.model_toml import ModelFile, write_model
from stitch.pipeline import run_rig
from stitch.reading.session_folder import load_session
from stitch.stages.register import DEFAULT, method_named
from stitch.stored.trusted_model import trusted_model
from stitch.writing import run_folder
from stitch.writing.json_file import to_json
from stitch.writing.mesh import write_mesh
from stitch.writing.result_document import model_of, result_document
from stitch.writing.run_contents import FILES


def run_sessions(sessions: list[Path], options: RunOptions) -> None:
    """Run sessions of one rig into one folder, and say what was found; none: the one that one stands in.

    Raises:
        InputError, NoResultError: as `stitch run` ends.
    """
    if options.model.effects_file:
        load_effects(options.model.effects_file)
    for name in options.model.effects:
        find_effect(name)
    method = method_named(options.register or DEFAULT).name
    here = not sessions
    sessions = sessions or [_current_session()]
    memory = None if options.memory is None else options.memory / len(sessions)
    loaded = [load_session(path, memory=memory) for path in sessions]
    names = _session_names(loaded)
    target = options.output or Path("../runs" if here else "runs") / "+".join(names)
    model, kept, own_effects = _given_models(options.model)
    run_folder.preload_entry_points("stitch.reports")
    with (
        show_activity(f"{'+'.join(names)}: reading the scans"),
        run_folder.new_folder(target, sessions, options.force) as scratch,
    ):
        folders = _scratch_folders(scratch, names)
        recorders = [recorder_for(folder, options.recording) for folder in folders]
        runs = run_rig(loaded, model, recorders, options.model.effects, options.keep, kept, method)
        runs = [replace(result, effects_file=own_effects or result.effects_file) for result in runs]
        for result, folder in zip(runs, folders, strict=True):
            run_folder.write_with_page(result, folder, options.tolerance)
            if options.mesh:
                write_mesh(result.fused, folder / "mesh.ply")
        if len(runs) > 1:
            write_model(model_of(runs[0]), scratch / "model.toml")
    documents = [result_document(result) for result in runs]
    if options.as_json:
        emit(to_json(documents[0] if len(documents) == 1 else documents))
    else:
        show_run(runs, target, options.tolerance, options.says_next)


def _given_models(options: ModelOptions) -> tuple[ModelFile | None, ModelFile | None, str | None]:
    """The model that is used as it is, the arm that is kept, and the file of the user's own effects, if any."""
    if options.hand_eye and (options.effects or options.arm):
        raise InputError(
            f"{'--arm' if options.arm else '--effects'} and --hand-eye: a model that is used as it is brings its own "
            "effects; name one of the two"
        )
    own = str(options.effects_file.resolve()) if options.effects_file else None
    if options.hand_eye:
        return trusted_model(options.hand_eye, options.effects_file, options.trust)[0], None, own
    if options.arm is None:
        return None, None, own
    stated, file = trusted_model(options.arm, options.effects_file, options.trust)
    kept = keep_arm_effects(stated)
    if twice := set(options.effects) & set(kept.effects):
        raise InputError(f"--effects {twice.pop()}: the arm of {options.arm} brings it already; to fix: leave it out")
    return None, kept, own or file


def _current_session() -> Path:
    """The folder one stands in, if it is a session."""
    if not Path("session.toml").is_file():
        raise InputError(
            "run what? this folder has no session.toml; to fix: name a session folder, go into one, or make one with "
            "`stitch init FOLDER`"
        )
    return Path.cwd()


def _session_names(sessions: list[Session]) -> list[str]:
    """Names of the sessions: their folders in the folder of a rig."""
    names = [session.name for session in sessions]
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise InputError(f"two sessions are named {twice!r}; give each its own name in session.toml")
    if len(names) > 1 and (taken := FILES & set(names)):
        named = taken.pop()
        raise InputError(f"a session is named {named!r}, as a file of the run is; give it another in session.toml")
    return names


def _scratch_folders(scratch: Path, names: list[str]) -> list[Path]:
    folders = [scratch] if len(names) == 1 else [scratch / name for name in names]
    for folder in folders:
        folder.mkdir(exist_ok=True)
    return folders
