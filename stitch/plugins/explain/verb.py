"""`stitch.explain`: what `stitch explain` does, of a run in memory."""

from stitch.diagnosis.diagnose import linear_model_of
from stitch.errors import InputError
from stitch.plugins.explain import explain as explanation
from stitch.plugins.explain.explain import EFFECT_NAME, Explanation
from stitch.run_data import RunData


def explain(run: RunData) -> Explanation:
    """Find a formula for what the model of a run leaves, as `stitch explain` does.

    Returns:
        `found`, `why` in a sentence, `formula` in rad and length_unit, and `source`, a Python file of effects.

    Raises:
        InputError: a formula of such a search is in the model already.
        NoResultError: no two views overlap.

    Example:
        >>> stitch.explain(run).found
        False
    """
    if EFFECT_NAME in run.model.effects:
        raise InputError(
            f"{run.session.name}: has an effect {EFFECT_NAME!r} in its model; to fix: give it another name in its "
            "file, and add that"
        )
    return explanation.explain(linear_model_of(run), f"Found by `stitch explain` in {run.session.name}.")
