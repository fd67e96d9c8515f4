"""`stitch compare RUN`: where model and measurement differ."""

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust


def compare_run(
    run: RunFolder,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Show the residual by view, pair, target, joint, range, incidence, field, time, covariate and place.

    Views are the samples. What follows a property clearly is told with the chance of it over all bins that were asked.

    \b
    Examples:
      stitch compare runs/blade-17
      stitch compare runs/blade-17 --json
    """
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.compared_run import run_compare

    run_compare(run, effects_file, trust=trust, as_json=as_json)
