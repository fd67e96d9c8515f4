"""What `stitch run` does: sessions of one rig into one run folder."""

from dataclasses import replace
from pathlib import Path

from stitch.cli.run_options import ModelOptions, RunOptions
from stitch.cli.terminal.live_line import doing
from stitch.cli.terminal.recorders import recorder_for
from stitch.cli.terminal.run_summary import show
from stitch.cli.terminal.streams import emit
from stitch.effects.in_session import known
from stitch.effects.user_file import load as load_effects
from stitch.errors import InputError
from stitch.measurement.session import Session
from stitch.model.arm import kept_arm
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


def run_sessions(sessions: list[Path], asked: RunOptions) -> None:
    """Run sessions of one rig into one folder, and say what was found; none: the one that one stands in.

    Raises:
        InputError, NoResultError: as `stitch run` ends.
    """
    if asked.model.effects_file:
        load_effects(asked.model.effects_file)
    for name in asked.model.effects:
        known(name)
    method = method_named(asked.register or DEFAULT).name
    here = not sessions
    sessions = sessions or [_here()]
    memory = None if asked.memory is None else asked.memory / len(sessions)
    loaded = [load_session(path, memory=memory) for path in sessions]
    names = _names(loaded)
    target = asked.output or Path("../runs" if here else "runs") / "+".join(names)
    model, kept, own_effects = _given(asked.model)
    run_folder.load_early("stitch.reports")
    with (
        doing(f"{'+'.join(names)}: reading the scans"),
        run_folder.new_folder(target, sessions, asked.force) as scratch,
    ):
        folders = _folders(scratch, names)
        recorders = [recorder_for(folder, asked.recording) for folder in folders]
        runs = run_rig(loaded, model, recorders, asked.model.effects, asked.keep, kept, method)
        runs = [replace(result, effects_file=own_effects or result.effects_file) for result in runs]
        for result, folder in zip(runs, folders, strict=True):
            run_folder.write_with_page(result, folder, asked.tolerance)
            if asked.mesh:
                write_mesh(result.fused, folder / "mesh.ply")
        if len(runs) > 1:
            write_model(model_of(runs[0]), scratch / "model.toml")
    documents = [result_document(result) for result in runs]
    if asked.as_json:
        emit(to_json(documents[0] if len(documents) == 1 else documents))
    else:
        show(runs, target, asked.tolerance, asked.says_next)


def _given(asked: ModelOptions) -> tuple[ModelFile | None, ModelFile | None, str | None]:
    """The model that is used as it is, the arm that is kept, and the file of the user's own effects, if any."""
    if asked.hand_eye and (asked.effects or asked.arm):
        raise InputError(
            f"{'--arm' if asked.arm else '--effects'} and --hand-eye: a model that is used as it is brings its own "
            "effects; name one of the two"
        )
    own = str(asked.effects_file.resolve()) if asked.effects_file else None
    if asked.hand_eye:
        return trusted_model(asked.hand_eye, asked.effects_file, asked.trust)[0], None, own
    if asked.arm is None:
        return None, None, own
    stated, file = trusted_model(asked.arm, asked.effects_file, asked.trust)
    kept = kept_arm(stated)
    if twice := set(asked.effects) & set(kept.effects):
        raise InputError(f"--effects {twice.pop()}: the arm of {asked.arm} brings it already; to fix: leave it out")
    return None, kept, own or file


def _here() -> Path:
    """The folder one stands in, if it is a session."""
    if not Path("session.toml").is_file():
        raise InputError(
            "run what? this folder has no session.toml; to fix: name a session folder, go into one, or make one with "
            "`stitch init FOLDER`"
        )
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
