"""What a run found, as Markdown for the recording."""

from stitch.comparison.model_history import ModelHistory
from stitch.comparison.run_verdict import run_verdict
from stitch.runs.run import Run
from stitch.units import MICROMETRES

_COLOURS = "Pale: the views agree. Dark red: they disagree. Grey: seen by one view only."


def run_markdown(run: Run, history: ModelHistory | None) -> str:
    """Verdict, how the error fell, what could not be seen."""
    um = MICROMETRES[run.session.length_unit]
    lines = [f"# {run.session.name}", "", f"**{run_verdict(run, history)}**", "", run.verdict, ""]
    if history is not None:
        lines += ["| step of the model | views disagree by (µm) |", "|---|---:|"]
        lines += [f"| {s.name} | {s.field.mean_abs * um:.3g} |" for s in history.steps]
        lines += ["", _COLOURS, ""]
    lines += [f"- Not observable from these motions: {direction}" for direction in run.unobservable]
    lines += [f"- {note}" for note in run.notes]
    return "\n".join(lines)
