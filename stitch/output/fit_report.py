"""A run as one block of text: what was found, how well, what is in the model and what is not."""

from collections.abc import Iterable, Mapping, Sequence
from textwrap import wrap

import numpy as np

from stitch.effects.contract import Parameter
from stitch.model.model import COVERAGE_FACTOR, hand_eye_lines
from stitch.numerics.units import angle_text, length_text, uncertainty_text
from stitch.output.comparison.model_history import effect_changes, model_history
from stitch.output.comparison.run_verdict import run_verdict
from stitch.run_data import RunData

# Characters of a line of the report.
_WIDTH = 100


def fit_report(run: RunData, at_part: tuple[float, float]) -> str:
    """Return a run as a block of text in the style of lmfit's fit_report: headings in double brackets, their lines.

    Args:
        at_part: U (k = 2) of the hand-eye at the part, mm and mrad; zero: not known.
    """
    session = run.session
    of_all = f" of {len(session.views) + len(run.left_out)}" if run.left_out else ""
    name, *numbers = run_hand_eye_lines(run)
    place, turn = (uncertainty_text(x) if x > 0 else "–" for x in at_part)
    parts = [
        f"[[{session.name}]] {len(session.views)}{of_all} views, {session.mount}, {session.length_unit}",
        f"  {run_verdict(run, model_history(run))}",
        f"[[Hand-eye]] {name.removeprefix('Hand-eye ')}",
        *numbers,
        *axis_lines(run),
        f"  U at the part {'not known' if run.unknown else f'{place} mm and {turn} mrad'}",
        *_part("Errors", _aligned(_errors(run))),
        *_part("Effects", _aligned((f"{effect}.{p.name}", str(p.formatted)) for effect, p in _fitted(run))),
        *_part("History", _aligned(_history(run))),
        *_part("Not observable", run.unobservable),
        *_part("Left out", [f"{item.view}: {item.why}" for item in run.left_out]),
        *_part("Notes", run.notes),
    ]
    return "\n".join(parts)


def run_hand_eye_lines(run: RunData) -> list[str]:
    """Return lines with the hand-eye of a run and its U (k = 2), those of each scanner where there are several.

    Directions that the views do not show are said to be unknown, or to be as stated.
    """
    lines = hand_eye_lines(
        run.T_mount,
        run.mount_covariance,
        run.session.mount,
        run.session.length_unit,
        unknown=run.unknown,
        stated=run.session.states_hand_eye,
    )
    unit = run.session.length_unit
    # Of several scanners, the first one's lines take the place of those above.
    for scanner in run.scanners:
        own = hand_eye_lines(scanner.T_mount, scanner.covariance, run.session.mount, unit, unknown=scanner.unknown)
        lines = [*(lines if scanner is not run.scanners[0] else []), f"Scanner {scanner.name}: {own[0]}", *own[1:]]
        if scanner.alone is not None:
            U, U_alone, distance = (length_text(x, unit, 2) for x in (scanner.U, scanner.U_alone, scanner.apart))
            lines.append(f"  U at the part {U}; by its own views alone {U_alone}, and {distance} from here")
    sigma = run.fit.sigma_anywhere
    if sigma is not None and not run.unknown:
        turn, shift = (COVERAGE_FACTOR * float(np.linalg.norm(part)) for part in (sigma[:3], sigma[3:]))
        place = length_text(shift, run.session.length_unit, 2)
        usual = "with usual sizes of effects that these views cannot show"
        lines.append(f"  U anywhere the arm reaches {place} and {angle_text(turn, 2)}, {usual}")
    # Without a robot the first external axis carries the scanner, and its frame stands for the base.
    if not run.session.has_poses:
        axis = run.session.reference_frame
        lines[0] = lines[0].replace("T_base", f"T_{axis}").replace("frame of the base", f"frame of axis {axis}")
    return lines + _guessed_lines(run.session.usual)


def _guessed_lines(usual: Mapping[str, str]) -> list[str]:
    """Return lines on what was assumed, such as a length unit, because neither files nor scans state it.

    Args:
        usual: the value assumed, by what it is of.
    """
    of = {"length_unit": "the poses", "cloud_unit": "the clouds"}
    units = [f"{of[what]} are in {value}" for what, value in usual.items() if what in of]
    others = [f"{what} {value}" for what, value in usual.items() if what not in of]
    lines = [f"  ? scale not known: lengths hold if {' and '.join(units)}, as is usual"] if units else []
    return lines + ([f"  ? guessed, shown by neither files nor scans: {', '.join(others)}"] if others else [])


def axis_lines(run: RunData) -> list[str]:
    """Return where the external axes stand with U (k = 2); none without axes."""
    where = "base frame" if run.session.has_poses else "scanner's frame"
    unit = run.session.length_unit
    return [f"Axis {place.line(unit)} ({where})" for place in run.axes]


def report_rows(run: RunData) -> list[tuple[str, str]]:
    """Return rows (name, text) of a run's numbers: errors, noise, scatter of the poses, fitted effects.

    The error on views left out is that of every model in the ledger.
    """
    (_, heldout), (_, inside), (_, noise), scatter = _errors(run)
    amounts: dict[str, list[str]] = {}
    for effect, p in _fitted(run):
        amounts.setdefault(effect, []).append(f"{p.name} = {p.formatted}")
    return [
        ("error on views left out", ", ".join(f"{model} {text}" for model, text in _history(run)) or heldout),
        ("error in the fit", inside),
        ("sensor's noise alone", noise),
        scatter,
        *((effect, ", ".join(texts)) for effect, texts in amounts.items()),
    ]


def _part(heading: str, lines: Sequence[str]) -> list[str]:
    """Return a heading in double brackets, then lines wrapped to `_WIDTH` and indented; empty without lines."""
    wrapped = [wrap(line, _WIDTH, initial_indent="  ", subsequent_indent="    ") for line in lines]
    return [f"[[{heading}]]", *(row for rows in wrapped for row in rows)] if lines else []


def _aligned(rows: Iterable[tuple[str, str]]) -> list[str]:
    return [f"{name + ':':<30}{text}" for name, text in rows]


def _errors(run: RunData) -> list[tuple[str, str]]:
    """Return four rows (name, text): residual on views left out, in the fit, noise floor, scatter of the poses."""
    unit, scatter = run.session.length_unit, run.repeatability
    return [
        ("on views left out", length_text(run.heldout_rms, unit)),
        ("in the fit", length_text(run.residual_rms, unit)),
        ("noise floor", length_text(run.noise_floor, unit)),
        ("scatter of the robot's poses", f"{length_text(scatter.translation, unit)}, {angle_text(scatter.rotation)}"),
    ]


def _fitted(run: RunData) -> list[tuple[str, Parameter]]:
    """Return (effect, parameter) for each parameter that was fitted, or of which a grid of values was tried.

    Without those that describe the geometry of the cell, such as external axes.
    """
    return [
        (term.name, p) for term in run.terms for p in term.parameters if (p.fitted or p.grid) and not term.is_geometry
    ]


def _history(run: RunData) -> list[tuple[str, str]]:
    """Return rows (change of the model, error on views left out) of the ledger; empty if the model never changed."""
    if len(run.ledger) < 2:
        return []
    unit = run.session.length_unit
    return [(effect_changes(run.ledger, i), length_text(s.heldout_rms, unit)) for i, s in enumerate(run.ledger)]
