"""The history of a model as a table, its parameters, and whether the last effect earned its place."""

from rich.table import Table

from stitch.comparison.model_history import model_history
from stitch.comparison.run_verdict import run_verdict
from stitch.diagnosis.thresholds import CLEAR_SIGMAS, FAINT_SIGMAS, HELDOUT_FALL, HELDOUT_RISE
from stitch.model.hand_eye_uncertainty import hand_eye_lines
from stitch.model.term import Term
from stitch.runs.run import Run
from stitch.system.console import console
from stitch.units import length_text


def show_ledger(result: Run) -> None:
    """History of the model, fitted parameters, and whether the last effect earned its place."""
    terminal, unit = console(), result.session.length_unit
    table = Table(title=f"{result.session.name}: history of the model", title_justify="left")
    for heading in ("step", "effects", "residual", "held-out", "noise floor"):
        table.add_column(heading, justify="left" if heading == "effects" else "right")
    for i, s in enumerate(result.ledger):
        numbers = (length_text(x, unit, 4, zeros=True) for x in (s.residual_rms, s.heldout_rms, s.noise_floor))
        table.add_row(str(i), ", ".join(s.effects) or "hand-eye alone", *numbers)
    terminal.print(table)
    terminal.print(run_verdict(result, model_history(result)), soft_wrap=True, style="bold")
    for p, name in ((p, term.name) for term in result.terms for p in term.parameters):
        if p.fitted or p.grid:
            how = "" if p.fitted else " (of those tried, this explains most)"
            terminal.print(f"  {name}.{p.name} = {p.formatted}{how}")
    for line in remarks(result):
        terminal.print(line, soft_wrap=True)
    hand_eye = hand_eye_lines(result.T_mount, result.mount_covariance, result.session.mount, unit)
    for line in (*result.notes[len(result.left_out) :], *hand_eye):
        terminal.print(line, soft_wrap=True)


def remarks(result: Run) -> list[str]:
    """Did the effects earn their place? Are they of a believable size?"""
    out, earned = [], set[str]()
    if len(result.ledger) > 1:
        before, after = result.ledger[-2], result.ledger[-1]
        grown = sorted(set(after.effects) - set(before.effects))
        if after.heldout_rms < HELDOUT_FALL * before.heldout_rms:
            earned = set(grown)
        elif grown:
            clear = max(_clearest(term) for term in result.terms if term.name in grown)
            rose = after.heldout_rms > HELDOUT_RISE * before.heldout_rms
            out.append(_unseen_in_residuals(", ".join(grown), clear, "rose" if rose else "did not fall"))
    for term in result.terms:
        wild = [p.name for p in term.parameters if not p.grid and abs(p.value) > p.limit]
        if wild:
            out.append(f"{term.name}: {', '.join(wild)} is larger than anybody would believe.")
        if _clearest(term) < FAINT_SIGMAS:
            out.append(
                f"{term.name}: views left out are predicted better with it, though no parameter differs from zero by "
                "two sigmas, which count all that an arm may do beside it."
                if term.name in earned
                else f"{term.name}: no parameter differs from zero by two sigmas; it can be dropped."
            )
    return out


def _unseen_in_residuals(names: str, clear: float, residual: str) -> str:
    """Of effects with which the held-out residual is no smaller, the clearest number so many sigmas from zero."""
    if clear > CLEAR_SIGMAS:
        return f"{names}: {clear:.0f} sigmas from zero, but too small for a residual to show."
    if clear < FAINT_SIGMAS:
        return f"{names} did not earn a place: the held-out residual {residual}."
    return (
        f"{names}: the held-out residual {residual}, and the clearest number is {clear:.1f} sigmas from zero; a "
        "diagnosis of the model without it asks the poses of views left out whether it is there."
    )


def _clearest(term: Term) -> float:
    """The largest |value|/sigma of an effect's parameters; 0 where the views see none."""
    return max((abs(p.value) / p.sigma for p in term.parameters if p.fitted and not p.grid), default=0.0)
