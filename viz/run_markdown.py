"""The verdict of a run with its tables, as Markdown for the recording."""

import numpy as np

from stitch.runs.run import Run
from stitch.units import MICROMETRES

_COLOURS = (
    "Colours: fused cloud dark = views agree, bright = they disagree (95 % quantile); scans blue/red = "
    "below/above the other views; grey = seen by one view only."
)


def run_markdown(run: Run) -> str:
    """Verdict, stage table and what could not be seen."""
    um = MICROMETRES[run.session.length_unit]
    sigma = np.sqrt(np.diag(run.mount_covariance))
    lines = [f"# {run.session.name}", "", f"**{run.verdict}**", ""]
    lines += ["| stage | rms (µm) | correspondences | seconds |", "|---|---:|---:|---:|"]
    lines += [f"| {s.name} | {s.rms * um:.1f} | {s.correspondences} | {s.seconds:.2f} |" for s in run.stages]
    rotation = ", ".join(f"{s * 1e3:.2f}" for s in sigma[:3])
    translation = ", ".join(f"{s * um:.0f}" for s in sigma[3:])
    lines += ["", f"Hand-eye sigma: rotation ({rotation}) mrad, translation ({translation}) µm.", ""]
    lines += [f"- Not observable from these motions: {direction}" for direction in run.unobservable]
    lines += [f"- {note}" for note in run.notes]
    lines += ["", _COLOURS]
    return "\n".join(lines)
