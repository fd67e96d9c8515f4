"""`stitch run SESSION...`: coarse → correct → register → fuse, one run folder per call."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
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
    complete_effect,
    completes,
    require_tolerance,
    split_names,
)
from stitch.cli.progress import Progress, live_line, show_activity
from stitch.cli.terminal import emit, in_full, say, show_block, show_files, show_next
from stitch.errors import InputError
from stitch.system.process import end_at_once, load_on_use

if TYPE_CHECKING:
    from stitch.api.live import LiveSession
    from stitch.model.model_toml import ModelFile
    from stitch.recorder import Recorder
    from stitch.run_data import RunData
    from stitch.session.capture import Capture
    from stitch.session.session import SessionData

# Seconds between two looks, and how long a file may be half-written before that is said.
_EVERY, _PATIENCE = 0.3, 5.0

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
_Effects = Annotated[
    str, typer.Option("--effects", help="Effects to fit, separated by commas.", autocompletion=complete_effect)
]
_Keep = Annotated[bool, typer.Option("--keep", help="Fuse also the views that do not belong.")]
_Register = Annotated[
    str | None,
    typer.Option(
        "--register",
        metavar="METHOD",
        help="How single views are registered: dpwvm (usual), gicp or vmm.",
        autocompletion=completes("dpwvm", "gicp", "vmm"),
    ),
]
_Recording = Annotated[bool, typer.Option("--recording/--no-recording", help="Write recording.rrd.")]
_Mesh = Annotated[
    str | None,
    typer.Option(
        "--mesh",
        metavar="[watertight|light]",
        help="Also write mesh.ply: open where nobody looked, closed (watertight), or a tenth of it (light).",
        autocompletion=completes("watertight", "light"),
    ),
]
_Follow = Annotated[bool, typer.Option("--follow", help="Judge each view as it arrives in the folder, then run.")]
_Views = Annotated[int | None, typer.Option("--views", min=1, help="With --follow: run after so many views.")]


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
    mesh: _Mesh = None,
    follow: _Follow = False,
    views: _Views = None,
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
      stitch run blade-18 --mesh watertight
      stitch run other-scanner --arm found
      stitch run fuselage --memory 4GB
      stitch run blade-19 --follow
    """
    # A tenth of a second: scipy imports all that numpy has, also what compiles and tests.
    load_on_use("numpy.f2py", "numpy.testing")
    named = [name for name in split_names(effects) if name]
    _require_known(mesh, tolerance, named, effects_file, register)
    paths = sessions or [_current_session()]
    if views is not None and not follow:
        raise InputError("--views: counts views that arrive; to fix: add --follow, or leave it out")
    if follow and len(paths) > 1:
        raise InputError("--follow: several sessions; to fix: name the one that is being measured")
    if follow:
        _follow_session(paths[0], views)
    loaded = _load_sessions(paths, memory)
    from stitch.session.capture import prepare_capture
    from stitch.system.threads import begin

    # A second of libraries is still to be loaded, which takes one core.
    captures: list[Future[Capture]] | None = [begin(partial(prepare_capture, session)) for session in loaded]
    from stitch.api.pipeline import join_scanners, run_rig
    from stitch.fusion.register import DEFAULT
    from stitch.output import json_file, run_folder
    from stitch.output.result_document import result_document
    from stitch.recorder import RecorderGroup, RecorderMemory
    from stitch.session.scanners import have_own_hand_eyes

    name = "+".join(session.name for session in loaded)
    target = output or Path("runs" if sessions else "../runs") / name
    several_scanners = have_own_hand_eyes(loaded)
    inner = [""] if len(loaded) == 1 or several_scanners else [session.name for session in loaded]
    model, kept, own_effects = _given_models(hand_eye, arm, named, effects_file, trust)
    with show_activity(f"{name}: reading the scans"), run_folder.new_folder(target, paths, force) as scratch:
        folders = [scratch / folder for folder in inner]
        for folder in folders:
            folder.mkdir(exist_ok=True)
        memories = [RecorderMemory() for _ in folders]
        recorders = [RecorderGroup([Progress(), memory]) for memory in memories]
        records = [memory.replay if recording else None for memory in memories]
        if several_scanners:
            loaded, captures = [join_scanners(loaded, model, kept, captures)], None
        runs = run_rig(
            loaded,
            model,
            recorders,
            named,
            keep,
            kept,
            register=register or DEFAULT,
            captures=captures,
            effects_file=own_effects,
            on_registered=None if as_json else partial(_show_runs, tolerance=tolerance),
        )
        mesh_fits = _write_runs(runs, folders, records, scratch, mesh, tolerance)
    if as_json:
        documents = [result_document(result) for result in runs]
        emit(json_file.to_json(documents[0] if len(documents) == 1 else documents))
    else:
        _show_written([target / folder for folder in inner], mesh_fits)
    end_at_once()


def _require_known(
    mesh: str | None, tolerance: float | None, effects: list[str], effects_file: Path | None, register: str | None
) -> None:
    """Refuse unknown values of options, and a mesh whose package is missing, before any scan is read.

    Effects of the user's file are loaded here, since names of effects are checked against them. A library is imported
    only if its option is used.
    """
    if mesh is not None:
        from stitch.output.mesh import KINDS, OPEN
        from stitch.system.open3d_library import import_open3d

        if mesh not in KINDS:
            raise InputError(f"--mesh {mesh}: to fix: --mesh alone, or one of {', '.join(KINDS)}")
        if mesh != OPEN:
            import_open3d(f"--mesh {mesh}")
    require_tolerance(tolerance)
    if effects_file:
        from stitch.effects.user_file import load as load_effects

        load_effects(effects_file)
    if effects:
        from stitch.effects.contract import find_effect

        for name in effects:
            find_effect(name)
    if register is not None:
        from stitch.fusion.register import method_named

        method_named(register)


def _follow_session(folder: Path, views: int | None) -> None:
    """Print a verdict on each view as it arrives in a session folder, until enough are there or Ctrl-C is pressed.

    The folder is read again every `_EVERY` seconds. What cannot be read may be half-written: it is tried again.

    Args:
        views: number of views to wait for; None: until Ctrl-C.

    Raises:
        InputError: session.toml is missing or wrong, or the poses are of another convention than it states.
    """
    from stitch.api.live import follow
    from stitch.session.reading.session_folder import load_session
    from stitch.session.reading.session_toml import read_session_document

    table = folder / "views.csv"
    read_session_document(folder / "session.toml")
    end = "Ctrl-C ends it and runs the session" if views is None else f"the session is run once {views} views are there"
    line = f"Following {folder}: each view is judged as its scan and its row in views.csv arrive; {end}."
    say(line, stream=sys.stderr)
    live: LiveSession | None = None
    failures = _Failures()
    try:
        while views is None or live is None or len(live.said) < views:
            session = failures.attempt(partial(load_session, folder, scans=False)) if table.is_file() else None
            if session is not None:
                live = live or follow(session)
                for name in [name for name in session.names if name not in live.session.names]:
                    one = failures.attempt(partial(load_session, folder, only=name))
                    if one is None:
                        break
                    say(str(live.take(one.views[0])))
                    failures = _Failures()
            time.sleep(_EVERY)
    except KeyboardInterrupt:
        if live is None:
            raise
    proposed = None if live is None else live.next_pose()
    if proposed is not None and views is None:
        say(str(proposed))


class _Failures:
    """Prints why reading fails, once for each reason, and only after `_PATIENCE` seconds of failures.

    A new object is made after each view that was judged.
    """

    def __init__(self) -> None:
        self._since: float | None = None
        self._said = ""

    def attempt(self, load: Callable[[], SessionData]) -> SessionData | None:
        """Return the session that `load` reads; None where it fails, which is printed once it has failed for long."""
        try:
            return load()
        except InputError as error:
            now = time.monotonic()
            self._since = self._since or now
            if now - self._since > _PATIENCE and error.command_line != self._said:
                self._said = error.command_line
                say(f"waiting: {self._said}", stream=sys.stderr)
            return None


def _current_session() -> Path:
    """Return the present folder; InputError if it is no session folder."""
    if not Path("session.toml").is_file():
        raise InputError(
            "no session named, and this folder has no session.toml; to fix: name a session folder, go into one, or "
            "make one with `stitch init FOLDER`"
        )
    return Path.cwd()


def _load_sessions(paths: list[Path], memory: str | None) -> list[SessionData]:
    """Return the sessions of folders; the runs of several get folders with their names, which must be possible.

    Args:
        memory: size such as 2GB within which they have to stay all together; None: no limit.

    Raises:
        InputError: two of the same name, or the name of a file that a run writes.
    """
    from stitch.output.json_file import FILES
    from stitch.session.reading.session_folder import load_session

    size = bytes_of(memory)
    loaded = [load_session(path, memory=None if size is None else size / len(paths)) for path in paths]
    names = [session.name for session in loaded]
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise InputError(f"two sessions are named {twice!r}; to fix: give each its own name in session.toml")
    if len(names) > 1 and (taken := FILES & set(names)):
        raise InputError(
            f"a session is named {taken.pop()!r}, as a file of the run is; to fix: give it another name in session.toml"
        )
    return loaded


def _given_models(
    hand_eye: Path | None, arm: Path | None, effects: list[str], effects_file: Path | None, trust: bool
) -> tuple[ModelFile | None, ModelFile | None, str | None]:
    """Return the model to use as it is, the arm to keep, and the path of the user's Python file of effects.

    Each is None where none is given; at most one of model and arm is.

    Args:
        hand_eye: run whose model is used as it is.
        arm: run whose effects of joints and links are kept.
        effects: names of effects that are to be fitted.

    Raises:
        InputError: options that exclude each other, or an effect that the arm has already.
    """
    if hand_eye and (effects or arm):
        raise InputError(
            f"{'--arm' if arm else '--effects'} and --hand-eye: a model that is used as it is brings its own effects; "
            "to fix: name one of the two"
        )
    stated_file = str(effects_file.resolve()) if effects_file else None
    if hand_eye is None and arm is None:
        return None, None, stated_file
    from stitch.model.model_toml import keep_arm_effects
    from stitch.output.stored_run import trusted_model

    if hand_eye:
        return trusted_model(hand_eye, effects_file, trust)[0], None, stated_file
    assert arm is not None
    stated, file = trusted_model(arm, effects_file, trust)
    kept = keep_arm_effects(stated)
    if twice := set(effects) & set(kept.effects):
        raise InputError(f"--effects {twice.pop()}: the arm of {arm} brings it already; to fix: leave it out")
    return None, kept, stated_file or file


def _write_runs(
    runs: list[RunData],
    folders: list[Path],
    records: Sequence[Callable[[Recorder], None] | None],
    scratch: Path,
    mesh: str | None,
    tolerance: float | None,
) -> list[str]:
    """Write the run folders, with meshes if asked for, and return a sentence on how well each mesh fits its cloud.

    Args:
        folders: one a run, inside the scratch folder; of several runs `scratch` gets the common model.toml.
        records: one a run, tells a recorder all of it; None: no recording is written.
        mesh: "open", "watertight" or "light"; None: none is made.
        tolerance: within which the views have to agree on the part, length_unit; None: not stated.
    """
    from stitch.output.run_folder import write_model_with_effects, write_with_page

    fits = []
    for result, folder, record in zip(runs, folders, records, strict=True):
        write_with_page(result, folder, tolerance, record)
        if mesh:
            from stitch.output.mesh import write_mesh
            from stitch.output.open3d_mesh import make_mesh

            surface, fit = make_mesh(result.fused, mesh)
            write_mesh(surface, folder / "mesh.ply")
            fits.append(fit.sentence(result.session.length_unit))
    if len(runs) > 1:
        write_model_with_effects(runs[0], scratch)
    return fits


def _show_runs(runs: list[RunData], tolerance: float | None) -> None:
    """Print a report for each run; the hand-eye that clouds of several sessions share is printed once, at the end."""
    live_line().stop()
    each = not runs[0].session.has_clouds
    for result in runs:
        show_report(result, tolerance, with_hand_eye=each or result is runs[-1])


def _show_written(folders: list[Path], mesh_fits: list[str]) -> None:
    """Print the sentences on meshes, the files of the run folders, and the next command."""
    for sentence in mesh_fits:
        say(sentence)
    for folder in folders if in_full() else ():
        show_files(folder, ("stitched.ply", "mesh.ply", "recording.rrd", "report.html"))
    show_next(f"Next: stitch diagnose {shlex.quote(str(folders[0]))}")


def show_report(result: RunData, tolerance: float | None = None, with_hand_eye: bool = True) -> None:
    """Print the report of a run: headline, remedies, numbers in a block, hand-eye, notes; or only the main numbers.

    Args:
        tolerance: within which the views have to agree on the part, length_unit; None: not stated.
        with_hand_eye: False where another report prints it.
    """
    from stitch.output.comparison.model_history import model_history
    from stitch.output.comparison.run_verdict import run_headline
    from stitch.output.fit_report import axis_lines, report_rows, run_hand_eye_lines
    from stitch.run_data import doubt_remedy

    say(f"{result.session.name}: {run_headline(result, model_history(result))}", bold=True)
    for remedy in filter(None, map(doubt_remedy, result.doubts)) if in_full() else ():
        say(remedy)
    # The first notes say of each view that was left out why.
    excluded = len(result.left_out)
    for note in result.notes[:excluded]:
        say(note, bold=True)
    show_light(result, tolerance)
    for line in axis_lines(result):
        say(line, hang=2)
    rows = report_rows(result)
    if not in_full():
        show_block([rows[0], rows[2]])  # error on views left out, sensor's noise
        return
    show_block(rows)
    for line in run_hand_eye_lines(result) if with_hand_eye else ():
        say(line, hang=2)
    for stage in result.stages[1:]:
        if stage.note:
            say(f"{stage.name}: {stage.note}.")
    for direction in result.unobservable:
        say(f"Not observable from these motions: {direction}.")
    for note in result.notes[excluded:]:
        say(note)


def show_light(result: RunData, tolerance: float | None) -> None:
    """Print whether the views agree on the part within a tolerance (length_unit), as the page's traffic light shows.

    Nothing is printed where no tolerance is stated, or where the run cannot tell.
    """
    from stitch.output.comparison.model_history import model_history
    from stitch.output.comparison.run_verdict import run_light

    light = None if tolerance is None else run_light(result, model_history(result), tolerance)
    if light is not None:
        say(light.sentence, bold=True)
