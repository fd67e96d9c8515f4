"""A run as one block of text: what was found, how well, what is in the model and what is not."""

from collections.abc import Sequence
from textwrap import wrap

from stitch.model.model import hand_eye_lines
from stitch.numerics.units import angle_text, length_text, uncertainty_text
from stitch.output.comparison.model_history import effect_changes, model_history
from stitch.output.comparison.run_verdict import run_verdict
from stitch.run_data import RunData

# Scanners leave a few points in the air beside edges, which is no news.
_WORTH_A_LINE = 0.005

# Characters of a line of the report.
_WIDTH = 100


def fit_report(run: RunData, at_part: tuple[float, float]) -> str:
    """Return the block, as lmfit's fit_report has it: a heading in double brackets, and its lines.

    Args:
        at_part: U (k = 2) of the hand-eye at the part, mm and mrad.
    """
    session = run.session
    left = f" of {len(session.views) + len(run.left_out)}" if run.left_out else ""
    head = f"[[{session.name}]] {len(session.views)}{left} views, {session.mount}, {session.length_unit}"
    name, *numbers = run_hand_eye_lines(run)
    place, turn = (uncertainty_text(x) if x > 0 else "–" for x in at_part)
    at = "not known" if run.unknown else f"{place} mm and {turn} mrad"
    parts = [
        [head, f"  {run_verdict(run, model_history(run))}"],
        [f"[[Hand-eye]] {name.removeprefix('Hand-eye ')}", *numbers, f"  U at the part {at}"],
        _part("Errors", _aligned(_errors(run))),
        _part("Effects", _aligned(_effects(run))),
        _part("History", _aligned(_history(run))),
        _part("Not observable", run.unobservable),
        _part("Left out", [f"{item.view}: {item.why}" for item in run.left_out]),
        _part("Notes", run.notes),
    ]
    return "\n".join(line for part in parts for line in part)


def run_hand_eye_lines(run: RunData) -> list[str]:
    """Return the hand-eye of a run with U (k = 2); what its views do not show is not known, or as it was stated."""
    return hand_eye_lines(
        run.T_mount,
        run.mount_covariance,
        run.session.mount,
        run.session.length_unit,
        unknown=run.unknown,
        stated=run.session.scanner.T_mount is not None,
    )


def report_rows(run: RunData) -> list[tuple[str, str]]:
    """Return names and values: errors, of every model so far on views left out, noise, scatter, fitted effects."""
    (_, heldout), (_, inside), (_, noise), scatter = _errors(run)
    parameters = {
        term.name: ", ".join(f"{p.name} = {p.formatted}" for p in term.parameters if p.fitted or p.grid)
        for term in run.terms
    }
    return [
        ("error on views left out", ", ".join(f"{model} {text}" for model, text in _history(run)) or heldout),
        ("error in the fit", inside),
        ("sensor's noise alone", noise),
        scatter,
        *((name, text) for name, text in parameters.items() if text),
        *([("points left out of the cloud", _unsupported(run))] if run.fit.unsupported.share > _WORTH_A_LINE else []),
    ]


def _unsupported(run: RunData) -> str:
    dropped = run.fit.unsupported
    alone, through = (n / dropped.points for n in (dropped.alone, dropped.looked_through))
    return f"{dropped.share:.1%} ({alone:.1%} on no surface, {through:.1%} where other views look past)"


def _part(heading: str, lines: Sequence[str]) -> list[str]:
    if not lines:
        return []
    wrapped = (wrap(line, _WIDTH, initial_indent="  ", subsequent_indent="    ") for line in lines)
    return [f"[[{heading}]]", *(row for rows in wrapped for row in rows)]


def _aligned(rows: Sequence[tuple[str, str]]) -> list[str]:
    return [f"{name + ':':<30}{text}" for name, text in rows]


def _errors(run: RunData) -> list[tuple[str, str]]:
    """Residuals, noise and the scatter of the poses."""
    unit, scatter = run.session.length_unit, run.repeatability
    return [
        ("on views left out", length_text(run.heldout_rms, unit)),
        ("in the fit", length_text(run.residual_rms, unit)),
        ("noise floor", length_text(run.noise_floor, unit)),
        ("scatter of the robot's poses", f"{length_text(scatter.translation, unit)}, {angle_text(scatter.rotation)}"),
    ]


def _effects(run: RunData) -> list[tuple[str, str]]:
    """Parameters that were fitted or tried."""
    return [
        (f"{term.name}.{p.name}", str(p.formatted)) for term in run.terms for p in term.parameters if p.fitted or p.grid
    ]


def _history(run: RunData) -> list[tuple[str, str]]:
    """Every step of the model, where there are several, with its error on views left out."""
    steps = run.ledger if len(run.ledger) > 1 else ()
    return [
        (effect_changes(run.ledger, i), length_text(s.heldout_rms, run.session.length_unit))
        for i, s in enumerate(steps)
    ]
