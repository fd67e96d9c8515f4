"""Add diagnosis and comparison to a run folder: the screen and the evidence of its page, a tab of its recording."""

import shlex
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from markupsafe import escape

from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.next_view import NOT_IN_ODDS, deciding_words
from stitch.diagnosis.sentences import fitted_amounts, posterior_text
from stitch.diagnosis.systematic_laws import law_of
from stitch.model.model import uncertainty_scope
from stitch.numerics.units import MICROMETRES, length_text
from stitch.output.comparison.residual_tables import ResidualTables
from stitch.output.finding_screen import effects_tried, finding_screen
from stitch.output.plain_finding import (
    largest_error_sources,
    next_step_line,
    next_step_without_a_view,
    plain_finding,
    remedy_at_machine,
)
from stitch.output.plain_words import effect_description
from stitch.run_data import RunData
from stitch.system.files import whole_file
from viz import captions
from viz.diagnosis_plots import Plots, alias_rows, budget_rows, comparison_plots, diagnosis_plots
from viz.diagnosis_recording import add_diagnosis
from viz.machine_drawing import machine_svg
from viz.page_parts import Tile, render, script_json, unbroken, with_sections
from viz.part_data import colour_stops

# Candidate effects in the table of the page.
_SHOWN = 8
# What the scripts of the page draw from.
_DRAWN = ("now", "why", "formula", "candidates", "places", "deciding_view")
# What the command does that is proposed, where its purpose does not say it.
_DOES = {
    "add": "It adds what is missing and fits the same views anew.",
    "export": "It writes the hand-eye for ROS.",
}
# Verdicts that name what is missing: the screen shows what adding it would change.
_NAMING = ("missing_effect", "cannot_tell")


def write_diagnosis(found: Diagnosis, state: RunData, folder: Path) -> None:
    """Put a diagnosis on the screen and into the evidence of report.html, and into the recording."""
    screen = finding_screen(found)
    # Rerun's program writes the recording anew while the page is made.
    with ThreadPoolExecutor(1) as beside:
        recorded = beside.submit(add_diagnosis, found, screen, state.session, folder / "recording.rrd")
        _insert(folder / "report.html", _sections(found, screen, state, folder))
        recorded.result()


def _sections(found: Diagnosis, screen: dict[str, Any], state: RunData, folder: Path) -> dict[str, str]:
    """Return what a diagnosis says on the page of a run, by section."""
    unit = state.session.length_unit
    shown = {"verdict": found.verdict, "named": list(found.effects), "um": MICROMETRES[unit], "colours": colour_stops()}
    data = script_json({key: screen[key] for key in _DRAWN} | shown)
    parts = {
        "finding": f'<p class="verdict">{_words(screen["headline"])}</p>\n'
        f'<p class="evidence">{_words(screen["proof"])}</p>\n'
        f'<p class="evidence"><b>How sure:</b> {_words(screen["certainty"])}</p>',
        "doubts": render("doubts.html.j2", doubts=screen["doubts"]),
        "missing": render("missing.html.j2", **_bars(found, screen, unit)),
        "machine": _machine(found, screen, state),
        "next": _next(found, folder.absolute().name),
        "screen": f'<script type="application/json" id="screen-data">{data}</script>',
        "diagnosis": _evidence(found, unit),
        "uncertainty": f'<p class="soft">{uncertainty_scope(found.verdict)}</p>',
    }
    if found.verdict in _NAMING and screen["candidates"]:
        parts["numbers"] = render("tiles.html.j2", tiles=_tiles(screen, unit))
    return parts


def _words(text: str) -> str:
    return str(escape(unbroken(text)))


def _tiles(screen: dict[str, Any], unit: str) -> list[Tile]:
    """Return the three numbers now, and with the candidate that is named."""
    best, now = screen["candidates"][0], screen["now"]
    names = {"heldout": "rms on held-out views", "mean": "mean on the part", "worst": "worst place"}
    return [
        Tile(key, name, [now[key]] if best[key] is None else [now[key], best[key]], unit)
        for key, name in names.items()
        if now[key] is not None
    ]


def _bars(found: Diagnosis, screen: dict[str, Any], unit: str) -> dict[str, Any]:
    """Return a bar of the error on views left out for the model as it is and for each candidate."""
    rows = [{"words": "nothing added", "effect": "", "heldout": screen["now"]["heldout"]}, *screen["candidates"]]
    most = max(row["heldout"] or 0.0 for row in rows) or 1.0
    bars = [
        {
            "fits": row.get("fits", ""),
            "words": row["words"],
            "effect": row["effect"],
            "told": "–" if row["heldout"] is None else _in_um(row["heldout"], unit),
            "share": 100 * (row["heldout"] or 0.0) / most,
            "noise": 100 * screen["noise"] / most,
            "best": row["effect"] in found.effects,
            "shown": bool(row["effect"]),
        }
        for row in rows
    ]
    others = effects_tried(found) - len(screen["candidates"])
    titles = {"adequate": "Tried beside the model", "unknown_effect": "Tried, and none named"}
    return {
        "title": titles.get(found.verdict, "What is missing?"),
        "bars": bars,
        **_sources(screen, unit),
        "unseen": screen["unseen"],
        "untested": screen["untested"],
        "noise": length_text(screen["noise"], unit, 2),
        "others": f"{others} {'more effects' if screen['candidates'] else 'effects'} were tried" if others else "",
    }


def _sources(screen: dict[str, Any], unit: str) -> dict[str, Any]:
    """Return the strip of what the error on views left out comes from: shares of its square, sizes, a sentence."""
    square = sum(source["rms"] ** 2 for source in screen["sources"])
    rows = [
        source | {"share": source["rms"] ** 2 / square, "told": _in_um(source["rms"], unit)}
        for source in screen["sources"]
    ]
    said = ", ".join(f"{row['words']} {row['told']} µm" for row in rows)
    return {"sources": rows, "said": f"{said}." if rows else "", "total": length_text(square**0.5, unit, 2)}


def _in_um(value: float, unit: str) -> str:
    """Return a length in µm as one remembers it, without its unit."""
    um = value * MICROMETRES[unit]
    return f"{um:,.0f}" if um >= 10 else f"{um:.2g}"


def _next(found: Diagnosis, run: str) -> str:
    why, command = next_step_line(found, shlex.quote(run)).rsplit(": ", 1)
    said = "Type, where the folder of this page stands" if why == "Next" else _purpose(why)
    poses = [proposal for proposal in found.next if proposal.probability is not None]
    scan = instead = ""
    if poses and command.endswith("next.src"):
        odds = f"with a probability of {poses[0].probability:.0%}: {poses[0].do}. {NOT_IN_ODDS}"
        said = f"The view that decides {deciding_words(found)}, {odds} Its robot program"
        scan = "<p>Scan there, add scan and row to the session, and run it again.</p>"
        why_now, now = next_step_without_a_view(found, shlex.quote(run)).rsplit(": ", 1)
        instead = "" if now.startswith("stitch next") else f"<p>No time? {_words(_purpose(why_now))}:</p>{_typed(now)}"
    does = _DOES.get(command.split()[1], "")
    after = "".join(f"<p>{_words(text)}</p>" for text in (does, remedy_at_machine(found)) if text)
    return f'<div class="card next"><h2>Next</h2><p>{_words(said)}:</p>{_typed(command)}{scan}{instead}{after}</div>'


def _purpose(why: str) -> str:
    """Return what a command is for, of the words before it."""
    return why.removeprefix("Next, ").capitalize()


def _typed(command: str) -> str:
    """Return a command with a button that copies it."""
    button = '<button type="button" title="Copies the command." data-copy>Copy</button>'
    return f"<p><code>{escape(command)}</code> {button}</p>"


def _machine(found: Diagnosis, screen: dict[str, Any], state: RunData) -> str:
    """Return the machine with what errs marked; after an effect was added what it cures."""
    places, is_one = _places(found, screen)
    drawing = machine_svg(state, places, found.linear.observation.centre, suspected=not is_one)
    if not drawing:
        return ""
    title = "The machine"
    if places and is_one:
        title += f": {places[0]}{', in the model' if found.verdict == 'adequate' else ' errs'}"
    elif places:
        title += f". Suspected: {', '.join(places)}"
    return f'<div class="card machine"><h2>{_words(title)}</h2>{drawing}</div>'


def _places(found: Diagnosis, screen: dict[str, Any]) -> tuple[list[str], bool]:
    """Return where the error comes from or may come from, and whether that place is the only one."""
    rivals = found.verdict == "cannot_tell" or (found.verdict == "missing_effect" and not found.certain)
    if found.laws and found.verdict in ("unknown_effect", "cannot_tell"):
        told = [law_of(ranked).place.name for ranked in found.laws]
    else:
        told = [screen["why"]["of"]] if screen["why"] is not None and not found.effects else []
    among = found.effects if rivals else found.effects[:1]
    named = (c["place"] for c in screen["candidates"] if c["effect"] in among)
    places = [place for place in dict.fromkeys([*named, *told]) if place not in ("", "the views")]
    return places, len(places) == 1 and not rivals and " or " not in places[0]


def _evidence(found: Diagnosis, unit: str) -> str:
    """Return sentences, candidates, budget and plots of a diagnosis as a section of the page."""
    lacking = sorted({need for needs in found.missing.values() for need in needs})
    return render(
        "diagnosis.html.j2",
        found=found,
        plain=plain_finding(found, unit),
        rows=_rows(found, MICROMETRES[unit]),
        lacking=[(need, [name for name, needs in found.missing.items() if need in needs]) for need in lacking],
        unseen=[s.name for s in found.candidates if not s.ranked.score.observable],
        budget=budget_rows(found, unit),
        budget_caption=captions.BUDGET if largest_error_sources(found.budget) else captions.MEAN_SQUARES,
        plots=diagnosis_plots(found, unit),
        aliases=alias_rows(found),
        alias_caption=captions.ALIASES,
    )


def _rows(found: Diagnosis, um: float) -> list[dict[str, str]]:
    """The best candidate effects that these views can show."""
    shown = [s for s in found.candidates if s.ranked.score.observable][:_SHOWN]
    compared = finding_screen(found)["candidates"]
    on_part = {row["effect"]: f"{row['mean'] * um:.3g}" for row in compared if row["mean"] is not None}
    posteriors = {s.name: s.ranked.posterior for s in shown}
    return [
        {
            "name": s.name,
            "p": f"{s.ranked.adjusted:.1g}".replace("-", "−"),
            "posterior": posterior_text(found.verdict, found.effects, posteriors, s.name),
            "told": "; ".join(filter(None, [effect_description(s.name), fitted_amounts(s.ranked).replace("-", "−")])),
            "rms_if_added": _rms(found, s, 0, um),
            "heldout": _rms(found, s, 1, um),
            "on_part": on_part.get(s.name, "–"),
            "aliases": ", ".join(f"{name} {alike:.2f}" for name, alike in list(s.aliases.items())[:2]),
        }
        for s in shown
    ]


def _rms(found: Diagnosis, candidate: CandidateEffect, which: int, um: float) -> str:
    """Rms (µm) with the effect added, in the fit (0) or on views left out (1); a dash where it was not validated."""
    validation = candidate.cross_validation
    return "–" if validation is None else f"{um * found.rms_if_added(validation)[which]:.1f}"


def write_comparison(found: ResidualTables, state: RunData, folder: Path) -> None:
    """Put a comparison into the evidence of report.html."""
    unit = state.session.length_unit
    um = MICROMETRES[unit]
    title = f"Where model and measurement differ ({found.rms * um:.1f} µm rms)"
    worst = []
    for table in found.labelled:
        worst.append((table.name, ", ".join(f"{table.label[i]} {table.rms[i] * um:.1f}" for i in table.worst(5))))
    one = Plots(title, captions.COMPARISON, comparison_plots(found, unit))
    _insert(folder / "report.html", {"comparison": render("comparison.html.j2", one=one, worst=worst)})


def _insert(page: Path, parts: dict[str, str]) -> None:
    """Put sections into a page, if there is one."""
    if not page.is_file():
        return
    text = with_sections(page.read_text(encoding="utf-8"), parts)
    with whole_file(page) as file:
        file.write_text(text, encoding="utf-8")
