"""`stitch synth` writes a session with a hidden effect; `stitch reveal` judges who was asked to find it."""

import json
from pathlib import Path
from typing import Annotated

import typer

from stitch.errors import InputError

# Of what a judge says, for people; names of effects and of their parameters stay as they are.
_LABELS = {
    "in_the_model": "in the model",
    "hand_eye_error_coarse_mm": "hand-eye error, coarse (mm)",
    "hand_eye_error_mm": "hand-eye error (mm)",
    "hand_eye_error_by_step_mm": "hand-eye error by step (mm)",
}


def synth(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="A scene's or a cell's name, or a TOML file.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to write.")],
    hide: Annotated[
        list[str] | None, typer.Option("--hide", metavar="EFFECT[=AMPLITUDE]", help="May be given again.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same files.")] = 0,
    views: Annotated[int | None, typer.Option(help="Number of views; default is the scene's.")] = None,
    truth: Annotated[Path | None, typer.Option(metavar="PATH", help="Where the truth goes.")] = None,
) -> None:
    """Write a session made by a cell that behaves like a real one, and its truth beside it.

    A scene is a session of scans. A cell is a folder for `base`, `drill`, `panel`, `calibrate`, `fit` or `seam`, or of
    two sessions.

    \b
    Examples:
      stitch synth blade cells/blade --hide backlash=2 --views 8 --seed 3
      stitch synth drilling cells/drilling
    """
    if out.exists():
        raise InputError(f"{out}: exists already; to fix: name another folder")
    if views is not None and views < 2:
        raise InputError(f"--views {views}: stitching needs at least 2; to fix: ask for more")
    if seed < 0:
        raise InputError(f"--seed {seed}: is below 0; to fix: use 0 or more")
    if truth is not None and truth.suffix != ".json":
        # The part's mesh lies beside it under the same name.
        raise InputError(f"--truth {truth}: is no JSON file; to fix: name one that ends in .json")
    # Imported here so that --help stays fast.
    from data_synth.made_cell import CELLS, make_cell
    from data_synth.made_session import made_session

    if scene in CELLS:
        if hide or views is not None:
            raise InputError(f"{scene}: a cell has its own views and errors; to fix: leave out --hide and --views")
        make_cell(scene, out, seed, truth)
        return
    made_session(scene, out, hide or [], seed, views, truth)


def reveal(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, after diagnose or add.")],
    truth: Annotated[Path, typer.Argument(metavar="PATH", help="truth.json of its session.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the judgement as JSON.")] = False,
) -> None:
    """Compare a run and its diagnosis with the truth.

    \b
    Examples:
      stitch reveal runs/blade cells/blade.truth.json
    """
    from data_synth.judgement import judge
    from stitch.cli.terminal import show_block

    judged = judge(run, truth)
    if as_json:
        print(json.dumps(judged, indent=1))
        return
    if judged["in_the_model"] and not judged["named"]:
        del judged["named"]
    # Values of what is in the model follow, each beside what was found.
    judged["hidden"] = {name: {} if name in judged["in_the_model"] else own for name, own in judged["hidden"].items()}
    judged["verdict"] = judged["verdict"].replace("_", " ")
    if "hand_eye_error_by_step_mm" in judged:
        del judged["hand_eye_error_mm"]
    rows: dict[str, str] = {}
    for key, value in judged.items():
        # Parameters of one effect stand in one row.
        name, _, parameter = key.partition(".")
        before = f"{rows[name]}; " if name in rows else ""
        rows[name] = f"{before}{parameter} {_told(value)}" if parameter else _told(value)
    show_block([(_LABELS.get(name, name), text) for name, text in rows.items()])


def _told(value: object) -> str:
    """Plain data for people."""
    if isinstance(value, dict):
        return "; ".join(f"{name} {_told(own)}" if own != {} else name for name, own in value.items()) or "nothing"
    if isinstance(value, list):
        return ", ".join(_told(own) for own in value) or "nothing"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
