"""`stitch next RUN`: the view that decides, with its odds, and on request a robot program that drives there."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stitch.cli.diagnose import diagnose_folder
from stitch.cli.options import EffectsFile, Json, RunFolder, Trust, require_new
from stitch.cli.terminal import emit, say, show_columns
from stitch.errors import InputError
from stitch.system.process import end_at_once

if TYPE_CHECKING:
    from stitch.diagnosis.diagnosis import Diagnosis, Proposal

_J3_CONVENTIONS = ("own", "j2+j3")
_Output = Annotated[
    Path | None,
    typer.Option("-o", "--output", metavar="FILE", help="Robot program to write: .src, .mod, .ls, .script or .jbi."),
]
_J3 = Annotated[
    str | None, typer.Option("--j3", help="Of a FANUC program: own, or j2+j3 where the session's joint 3 is that.")
]


def next_measurement(
    run: RunFolder,
    output: _Output = None,
    j3: _J3 = None,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Say which view decides what cannot be told apart, with its odds; -o writes the robot program that drives there.

    \b
    Examples:
      stitch next runs/blade-17
      stitch next runs/blade-17 -o next.src
    """
    from stitch.output.json_file import to_json

    require_new(output)
    if j3 not in (None, *_J3_CONVENTIONS):
        raise InputError(f"--j3 {j3}: to fix: own, or j2+j3")
    diagnosis, document = diagnose_folder(run, effects_file, trust)
    if output is not None:
        write_program(diagnosis, output, j3)
    if as_json:
        emit(to_json({key: document[key] for key in ("verdict", "effects", "next")} | next_view_row(document)))
    else:
        show_next_views(diagnosis, document)
        if output is not None:
            say(f"  {output}")
            say("Drive there at reduced speed, scan, add the scan and its row to the session, and run it again.")
    end_at_once()


def next_view_row(document: dict[str, Any]) -> dict[str, Any]:
    """Return entries of `next --json`: the proposed poses, the effects they separate, and how probably they decide.

    Args:
        document: diagnosis.json. Its proposals are poses (`joints_deg` is not null) or reference objects to measure.
    """
    poses = [row for row in document["next"] if row["joints_deg"] is not None]
    deciding = (document.get("screen") or {}).get("deciding_view") or {}
    keys = ("joints_deg", "T_base_flange", "wait_s", "probability")
    first = next(iter(poses or document["next"]), None)
    return {
        "poses": [{key: row[key] for key in keys} for row in poses],
        "splits": [] if first is None else list(first["separates"]),
        "expected": deciding.get("expected", []),
        "probability_to_decide": poses[-1]["probability"] if poses else None,
    }


def write_program(diagnosis: Diagnosis, output: Path, j3: str | None) -> None:
    """Write a robot program that drives to the proposed views, by an installed package.

    Args:
        output: file of the program, whose ending says for which controller.
        j3: of FANUC: "own", or "j2+j3" where joint 3 of the session is the sum; None: not stated.

    Raises:
        InputError: no pose is proposed, or no program of this kind can be written.
    """
    from importlib.metadata import entry_points

    import numpy as np

    from stitch.diagnosis.next_view import deciding_words
    from stitch.numerics.units import MILLIMETRES
    from stitch.system.files import whole_file

    poses = proposed_poses(diagnosis)
    if not poses:
        raise InputError(f"{output}: no pose is proposed, so that there is nowhere to drive; to fix: leave out -o")
    writer = next(iter(entry_points(group="stitch.next_programs")), None)
    if writer is None:
        raise InputError(f"{output}: programs are written by stitch's export plug-in; to fix: install stitch anew")
    # Programs are in mm.
    T_base_flange = np.array([proposal.T_base_flange for proposal in poses])
    T_base_flange[:, :3, 3] *= MILLIMETRES[diagnosis.linear.measurement.length_unit]
    about = (
        f"Drives to the view that decides {deciding_words(diagnosis)}." if poses[0].separates else "Drives to a view."
    )
    waits = [f"{proposal.wait_s / 60:.0f} min" for proposal in poses if proposal.wait_s]
    about += f" Scan no sooner after the last view than: {', '.join(waits)}." if waits else ""
    text = writer.load()(output, [proposal.joints_deg for proposal in poses], T_base_flange, about, j3)
    with whole_file(output) as file:
        file.write_bytes(text.encode("utf-8"))


def proposed_poses(diagnosis: Diagnosis) -> list[Proposal]:
    """Return the views that are proposed, in the order in which they are taken."""
    return [proposal for proposal in diagnosis.next if proposal.joints_deg is not None]


def show_next_views(diagnosis: Diagnosis, document: dict[str, Any]) -> None:
    """Print the proposals of a diagnosis: views that decide, with their probability, and reference objects to measure.

    Without any proposal, the reason is printed.

    Args:
        document: diagnosis.json.
    """
    poses = proposed_poses(diagnosis)
    if poses and poses[0].separates:
        _show_deciding(diagnosis, poses, document)
    for proposal in diagnosis.next:
        if proposal not in poses or not proposal.separates:
            what = f"To separate {' from '.join(proposal.separates)}" if proposal.separates[1:] else "To see more of it"
            say(f"{what}: {proposal.do}.")
    if not diagnosis.next:
        say(_why_nothing_proposed(diagnosis))


def _show_deciding(diagnosis: Diagnosis, poses: list[Proposal], document: dict[str, Any]) -> None:
    """Print the views that decide between effects, with the probability that they do, and what each effect predicts.

    Args:
        poses: the proposed views; `probability` is that of deciding with this view and those before it.
        document: diagnosis.json, which holds what each effect predicts for the first view.
    """
    from stitch.diagnosis.next_view import NOT_IN_ODDS, deciding_words
    from stitch.numerics.units import angle_text, length_text

    number = "One further view decides" if len(poses) == 1 else f"{len(poses)} further views decide"
    say(f"{number} {deciding_words(diagnosis)} with a probability of {poses[-1].probability:.0%}.", bold=True)
    say(NOT_IN_ODDS)
    columns = (
        ("joints °", lambda p: " ".join(f"{x:.0f}" for x in p.joints_deg)),
        ("wait", lambda p: f"{p.wait_s / 60:.0f} min" if p.wait_s else "–"),
        ("decided by then", lambda p: f"{p.probability:.0%}"),
    )
    show_columns("Take these views", columns, poses)
    deciding = (document.get("screen") or {}).get("deciding_view")
    if deciding is None:
        return

    def in_words(value: float) -> str:
        unit = deciding["value_unit"]
        return angle_text(value) if unit == "rad" else length_text(value, unit)

    expects = "; ".join(
        f"{row['effect']} {in_words(row['value'])} ± {in_words(2 * row['sigma'])}" for row in deciding["expected"]
    )
    say(f"In the first, {deciding['of']} would be off by: {expects} (95 %).")


def _why_nothing_proposed(diagnosis: Diagnosis) -> str:
    """Return a sentence, by the verdict, on why nothing is proposed."""
    from stitch.diagnosis.thresholds import ALIAS_CORRELATION

    effects = diagnosis.effects
    no_alias = "No effect correlates with {} by more than " + f"{ALIAS_CORRELATION} in these views"
    if diagnosis.verdict == "adequate":
        return "No missing effect was found: there is nothing to tell apart."
    if diagnosis.verdict == "unknown_effect":
        return "The error follows nothing that a further view could be taken at; stitch explain looks for a formula."
    if len(effects) > 1:
        return f"No pose within reach, and no artefact that is known here, separates {' from '.join(effects)}."
    if diagnosis.verdict == "missing_effect" and not diagnosis.likelier_than_not:
        return f"{no_alias.format(effects[0])}. More views, at any poses, can tell it from chance."
    return f"Nothing has to be told apart. {no_alias.format('the likeliest')}."
