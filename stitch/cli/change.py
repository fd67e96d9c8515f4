"""`stitch add RUN EFFECT…`, `stitch drop RUN EFFECT…`: change the model, refit, print the ledger."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import EffectsFile, Json, Trust
from stitch.errors import InputError

AT_MOST = 5  # effects that --suggested adds one by one
_Recording = Annotated[bool, typer.Option("--recording/--no-recording", help="Write recording.rrd anew.")]


def add(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder; changed in place.")],
    effects: Annotated[list[str] | None, typer.Argument(metavar="EFFECT...", help="Effects to add.")] = None,
    suggested: Annotated[bool, typer.Option("--suggested", help="Diagnose and add until nothing is left.")] = False,
    group: Annotated[bool, typer.Option("--group", help="Diagnose; add effects that it cannot tell apart.")] = False,
    at_most: Annotated[int, typer.Option("--at-most", help="Limit for --suggested.")] = AT_MOST,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    recording: _Recording = True,
    as_json: Json = False,
) -> None:
    """Add effects to the model of a run, fit hand-eye and all effects anew, and show what it brought.

    \b
    Examples:
      stitch add runs/blade-17 backlash
      stitch add runs/blade-17 --suggested
      stitch add runs/blade-17 --group
    """
    if bool(effects) + suggested + group != 1:
        raise InputError("add what? to fix: name the effects, or let --suggested or --group choose; one of the three")
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.changed_run import add_diagnosed, add_effects

    if effects:
        add_effects(run, effects, effects_file, trust=trust, recording=recording, as_json=as_json)
    else:
        limit = at_most if suggested else None
        add_diagnosed(run, limit, effects_file, trust=trust, recording=recording, as_json=as_json)


def drop(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder; changed in place.")],
    effects: Annotated[list[str], typer.Argument(metavar="EFFECT...", help="Effects to take out.")],
    effects_file: EffectsFile = None,
    trust: Trust = False,
    recording: _Recording = True,
    as_json: Json = False,
) -> None:
    """Take effects out of the model of a run and fit the rest anew.

    \b
    Examples:
      stitch drop runs/blade-17 backlash
    """
    from stitch.cli.actions.changed_run import drop_effects

    drop_effects(run, effects, effects_file, trust=trust, recording=recording, as_json=as_json)
