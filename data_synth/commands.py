"""`stitch synth` writes a session with a hidden effect; `stitch reveal` judges who was asked to find it."""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from data_synth.judgement import judge
from data_synth.nature import LAWS
from data_synth.scene import load_scene
from data_synth.simulate import Measured, simulate
from data_synth.write import write_session, write_truth
from stitch.errors import InputError
from stitch.system.console import console


def synth(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="A scene's name, or a TOML file.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Session folder to write.")],
    hide: Annotated[
        list[str] | None, typer.Option("--hide", metavar="EFFECT[=AMPLITUDE]", help="May be given again.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same files.")] = 0,
    views: Annotated[int | None, typer.Option(help="Number of views; default is the scene's.")] = None,
    truth: Annotated[Path | None, typer.Option(metavar="PATH", help="Where the truth goes.")] = None,
) -> None:
    """Write a session made by a cell that behaves like a real one, and its truth beside it.

    \b
    Examples:
      stitch synth blade cells/blade --hide backlash=2 --views 8 --seed 3
    """
    if out.exists():
        raise InputError(f"{out}: exists already; name another folder")
    if views is not None and views < 2:
        raise InputError(f"--views {views}: stitching needs at least 2")
    if seed < 0:
        raise InputError(f"--seed {seed}: use 0 or more")
    target = truth or truth_path(out)
    if target.suffix != ".json":
        # The part's mesh lies beside it under the same name.
        raise InputError(f"--truth {target}: name a file that ends in .json")
    measured = make(scene, hidden_of(hide or []), seed, views)
    write_session(out, measured, out.name)
    write_truth(target, measured, seed)
    points = sum(len(cloud.points) for cloud in measured.clouds)
    summary = f"{len(measured.clouds)} views, {points:,} points → {out}\ntruth → {target}"
    console().print(summary, soft_wrap=True)


def make(scene: str | Path, hidden: dict[str, float], seed: int, views: int | None = None) -> Measured:
    """Simulate a scene by its name.

    Raises:
        InputError: no such scene or law, a wrong value in it; NoResultError: views that the arm cannot reach.
    """
    try:
        return simulate(load_scene(scene), hidden, seed, views)
    except ValueError as error:
        raise InputError(f"scene {scene}: {error}") from None


def hidden_of(options: list[str]) -> dict[str, float]:
    """EFFECT or EFFECT=AMPLITUDE → amplitudes; 1 is a size that a real cell could have."""
    hidden = {}
    for option in options:
        name, _, size = option.partition("=")
        if name not in LAWS:
            raise InputError(f"--hide {option}: nature knows {', '.join(LAWS)}")
        try:
            hidden[name] = float(size) if size else 1.0
        except ValueError:
            hidden[name] = np.nan
        if not np.isfinite(hidden[name]):
            raise InputError(f"--hide {option}: {size!r} is not a number")
    return hidden


def truth_path(session: Path) -> Path:
    """Where the truth of a session lies unless told otherwise."""
    return session.with_name(session.name + ".truth.json")


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
    judged = judge(run, truth)
    if as_json:
        print(json.dumps(judged, indent=1))
        return
    table = Table("", "", show_header=False, box=None)
    for key, value in judged.items():
        table.add_row(key.replace("_", " "), value if isinstance(value, str) else json.dumps(value))
    console().print(table)
