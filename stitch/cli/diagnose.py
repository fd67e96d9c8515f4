"""`stitch diagnose RUN`: which effect is missing; `stitch next RUN`: what to measure."""

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust


def diagnose_run(
    run: RunFolder,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Say which physical effect is missing in the model of a run, or why nobody can tell.

    \b
    Examples:
      stitch diagnose runs/blade-17
      stitch diagnose runs/blade-17 --effects-file mine.py --json
    """
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.diagnosed_run import run_diagnose

    run_diagnose(run, effects_file, trust=trust, as_json=as_json)


def next_measurement(
    run: RunFolder,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Say which poses or artefacts would separate what cannot be told apart.

    \b
    Examples:
      stitch next runs/blade-17
    """
    from stitch.cli.actions.diagnosed_run import run_next

    run_next(run, effects_file, trust=trust, as_json=as_json)
