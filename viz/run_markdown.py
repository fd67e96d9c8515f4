"""What a run found, as Markdown for the recording."""

from stitch.comparison.disagreement_field import ModelHistory
from stitch.comparison.run_verdict import run_headline
from stitch.runs.run import Run
from stitch.units import length_text
from stitch.writing.diagnosis_document import effect_in_words


def run_markdown(run: Run, history: ModelHistory | None) -> str:
    """Verdict, how the error fell, what could not be seen."""
    lines = [f"# {run.session.name}", "", f"**{run_headline(run, history)}**", ""]
    for doubt in run.doubts:
        lines += [doubt, ""]
    if run.effects:
        lines += [f"In the model: {', '.join(map(effect_in_words, run.effects))}.", ""]
    lines += [run.verdict, ""]
    if history is not None:
        lines += ["| step of the model | views disagree by |", "|---|---:|"]
        lines += [f"| {s.name} | {length_text(s.field.mean_abs, run.session.length_unit)} |" for s in history.steps]
        lines += [""]
    lines += [f"- Registered by {stage.remark}." for stage in run.stages if stage.method]
    lines += [f"- Not observable from these motions: {direction}" for direction in run.unobservable]
    lines += [f"- {note}" for note in run.notes]
    return "\n".join(lines)
