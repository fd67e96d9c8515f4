"""`stitch run SESSION...`: coarse → correct → register → fuse, one run folder per call."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stitch.cli.options import (
    EffectsFile,
    Force,
    Json,
    Memory,
    Tolerance,
    Trust,
    bytes_of,
    require_tolerance,
    split_names,
)
from stitch.cli.terminal import emit, recorder_for, show_activity
from stitch.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from stitch.measurement.session import Session
    from stitch.model.model_toml import ModelFile
    from stitch.runs.run import Run


# What `stitch run` was asked for, as plain data.


@dataclass(frozen=True)
class ModelOptions:
    """From which model a run starts: that of another run as it is, its arm alone, or effects by name."""

    hand_eye: Path | None = None  # run whose model is used and not corrected
    arm: Path | None = None  # run whose arm is kept
    effects: tuple[str, ...] = ()
    effects_file: Path | None = None
    trust: bool = False


@dataclass(frozen=True)
class RunOptions:
    """The options by their names on the command line."""

    output: Path | None = None
    model: ModelOptions = ModelOptions()
    force: bool = False
    keep: bool = False
    register: str | None = None  # method; None: the usual one
    recording: bool = True
    mesh: bool = False
    tolerance: float | None = None
    memory: float | None = None  # bytes
    as_json: bool = False
    says_next: bool = True  # the last line names the next command; a command that calls this on its way names its own


# What `stitch run` says at its end: stages, hand-eye with U, errors, verdict, files, the next command.

_FILES = ("stitched.ply", "mesh.ply", "recording.rrd", "report.html")


def show_run(runs: list[Run], target: Path, tolerance: float | None = None, says_next: bool = True) -> None:
    """For people, on standard error; the next command only where it is the reader's to give."""
    from stitch.comparison.disagreement_field import model_history
    from stitch.comparison.run_verdict import run_verdict
    from stitch.model.model import hand_eye_lines
    from stitch.system.process import console

    terminal = console()
    for result in runs:
        for note in result.notes[: len(result.left_out)]:
            terminal.print(note, soft_wrap=True, style="bold")
        terminal.print(_stage_table(result))
        for s in result.stages[1:]:
            if s.note:
                terminal.print(f"{s.name}: {s.note}.", soft_wrap=True)
        terminal.print(run_verdict(result, model_history(result)), soft_wrap=True, style="bold")
        show_light(terminal, result, tolerance)
        terminal.print(result.verdict, soft_wrap=True)
        hidden = [f"Not observable from these motions: {direction}." for direction in result.unobservable]
        for line in (*hidden, *result.notes[len(result.left_out) :]):
            terminal.print(line, soft_wrap=True)
        terminal.print(_error_sentence(result), soft_wrap=True)
    # Clouds of one rig have one hand-eye, labelled points of one arm each their own.
    own = len(runs) > 1 and not runs[0].session.has_clouds
    for result in runs if own else runs[:1]:
        if own:
            terminal.print(f"{result.session.name}:", soft_wrap=True)
        for line in hand_eye_lines(result.T_mount, result.mount_covariance, result.session.mount, _run_unit(result)):
            terminal.print(line, soft_wrap=True)
    folders = [target] if len(runs) == 1 else [target / result.session.name for result in runs]
    _print_files(terminal, folders)
    if says_next:
        terminal.print(f"Next: stitch diagnose {shlex.quote(str(folders[0]))}", soft_wrap=True)


def show_light(terminal: Console, run: Run, tolerance: float | None) -> None:
    """Whether the part is within what is allowed, as the page's light says it; nothing where nobody says what is."""
    from stitch.comparison.disagreement_field import model_history
    from stitch.comparison.run_verdict import run_light

    light = None if tolerance is None else run_light(run, model_history(run), tolerance)
    if light is not None:
        terminal.print(light.sentence, soft_wrap=True, style="bold")


def _run_unit(result: Run) -> str:
    return result.session.length_unit


def _stage_table(result: Run) -> Table:
    from rich.table import Table

    from stitch.units import length_text

    table = Table(title=result.session.name, title_justify="left")
    for heading in ("stage", "rms", "correspondences", "iterations", "seconds"):
        table.add_column(heading, justify="left" if heading == "stage" else "right")
    for s in result.stages:
        rms = length_text(s.rms, _run_unit(result), 4, zeros=True)
        table.add_row(s.name, rms, f"{s.correspondences:,}", str(s.iterations), f"{s.seconds:.2f}")
    return table


def _error_sentence(result: Run) -> str:
    from stitch.units import length_text

    held, own, floor = (
        length_text(x, _run_unit(result)) for x in (result.heldout_rms, result.residual_rms, result.noise_floor)
    )
    return f"Held-out error {held} (in the fit {own}, noise floor {floor})."


def _print_files(terminal: Console, folders: list[Path]) -> None:
    for folder in folders:
        for name in _FILES:
            if (folder / name).exists():
                terminal.print(f"  {folder / name}", soft_wrap=True)


# What `stitch run` does: sessions of one rig into one run folder.


def run_sessions(sessions: list[Path], options: RunOptions) -> None:
    """Run sessions of one rig into one folder, and say what was found; none: the one that one stands in.

    Raises:
        InputError, NoResultError: as `stitch run` ends.
    """
    from stitch.effects.contract import find_effect
    from stitch.effects.user_file import load as load_effects
    from stitch.model.model_toml import write_model
    from stitch.pipeline import run_rig
    from stitch.reading.session_folder import load_session
    from stitch.stages.register import DEFAULT, method_named
    from stitch.writing import run_folder
    from stitch.writing.json_file import to_json
    from stitch.writing.mesh import write_mesh
    from stitch.writing.result_document import model_of, result_document

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
    from stitch.model.model_toml import keep_arm_effects
    from stitch.stored.stored_run import trusted_model

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
    from stitch.writing.json_file import FILES

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


_Sessions = Annotated[
    list[Path] | None,
    typer.Argument(metavar="[SESSION]...", help="Session folders of one rig; default: the one you stand in."),
]
_Output = Annotated[Path | None, typer.Option("-o", "--output", metavar="RUN", help="Run folder; default runs/NAME.")]
_HandEye = Annotated[
    Path | None, typer.Option("--hand-eye", metavar="RUN2", help="Use the model of another run, do not correct.")
]
_Arm = Annotated[
    Path | None,
    typer.Option("--arm", metavar="RUN2", help="Keep the arm of another run (joints, links), fit all else."),
]
_Effects = Annotated[str, typer.Option("--effects", help="Effects to fit, separated by commas.")]
_Keep = Annotated[bool, typer.Option("--keep", help="Fuse also the views that do not belong.")]
_Register = Annotated[
    str | None,
    typer.Option("--register", metavar="METHOD", help="How single views are registered: dpwvm (usual) or gicp."),
]
_Recording = Annotated[bool, typer.Option("--recording/--no-recording", help="Write recording.rrd.")]
_Mesh = Annotated[bool, typer.Option("--mesh", help="Also write mesh.ply.")]


def run(
    sessions: _Sessions = None,
    output: _Output = None,
    hand_eye: _HandEye = None,
    arm: _Arm = None,
    effects: _Effects = "",
    effects_file: EffectsFile = None,
    trust: Trust = False,
    force: Force = False,
    keep: _Keep = False,
    register: _Register = None,
    recording: _Recording = True,
    mesh: _Mesh = False,
    tolerance: Tolerance = None,
    memory: Memory = None,
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
      stitch run fuselage --memory 4GB
    """
    require_tolerance(tolerance)

    named = tuple(name for name in split_names(effects) if name)
    options = RunOptions(
        output=output,
        model=ModelOptions(hand_eye, arm, named, effects_file=effects_file, trust=trust),
        force=force,
        keep=keep,
        register=register,
        recording=recording,
        mesh=mesh,
        tolerance=tolerance,
        memory=bytes_of(memory),
        as_json=as_json,
    )
    run_sessions(sessions or [], options)
