"""A diagnosis as native views in the recording of its run: the tab "What is missing"."""

import os
import subprocess
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.sentences import curve_sentences, fitted_amounts, posterior_text
from stitch.numerics.units import MICROMETRES
from stitch.output.plain_finding import next_step_line, remedy_at_machine
from stitch.output.plain_words import effect_description, effect_in_words
from stitch.session.session import SessionData
from stitch.system.files import whole_file
from viz.colours import COLOURS_OF_FEW
from viz.course_recording import log_course
from viz.rrd_file import RecordingFile, id_of, words
from viz.viewer import rerun_program

os.environ.setdefault("RERUN_ANALYTICS", "off")

_SHOWN = 8
NOT_YET = "Not diagnosed yet: `stitch diagnose RUN` says which effect is missing."


def add_diagnosis(found: Diagnosis, screen: dict[str, Any], session: SessionData, path: Path) -> None:
    """Put a diagnosis into a recording, in place of an earlier one; nothing where there is no recording.

    Args:
        session: with the views that were diagnosed.

    Raises:
        OSError: the recording cannot be written.
    """
    if not path.is_file():
        return
    own = path.with_name(".diagnosis.part.rrd")
    try:
        file = RecordingFile("stitch", own, id_of(found.linear.measurement.capture.name))
        log_diagnosis(file.stream, found, screen, session)
        file.write()
        with whole_file(path) as scratch:
            subprocess.run(
                [rerun_program(), "rrd", "merge", str(path), str(own), "-o", str(scratch)],
                env=os.environ | {"RERUN_ANALYTICS": "off"},
                capture_output=True,
                check=True,
            )
    except subprocess.CalledProcessError:
        raise OSError(f"{path}: the diagnosis could not be put into this recording; run `stitch run` again") from None
    finally:
        own.unlink(missing_ok=True)


def log_diagnosis(rec: rr.RecordingStream, found: Diagnosis, screen: dict[str, Any], session: SessionData) -> None:
    """Verdict with the table of candidate effects, bars of the evidence, displacements of the views."""
    length_unit = session.length_unit
    um = MICROMETRES[length_unit]
    shown = [c for c in found.candidates if c.ranked.score.observable][:_SHOWN]
    posteriors = {c.name: c.ranked.posterior for c in shown}
    posterior = partial(posterior_text, found.verdict, found.effects, posteriors)
    on_part = {c["effect"]: f"{c['mean'] * um:.3g}" for c in screen["candidates"] if c["mean"] is not None}
    headline = f"**{screen['headline']}**"
    proof = [screen["proof"], f"How sure: {screen['certainty']}", remedy_at_machine(found)]
    rec.log("diagnosis/plain", words("\n\n".join([headline, *proof])), static=True)
    courses = [line for told in curve_sentences(found, length_unit) for line in (told, "")]
    lines = [headline, "", found.sentence, "", *courses, next_step_line(found, "RUN"), ""]
    lines += [
        "| | candidate effect | p | posterior | on the part if added (µm) | size |",
        "|---:|---|---:|---:|---:|---|",
    ]
    lines += [
        f"| {i} | {c.name} | {c.ranked.adjusted:.1g} | {posterior(c.name)} | {on_part.get(c.name, '–')} "
        f"| {fitted_amounts(c.ranked).replace('-', '−')} |"
        for i, c in enumerate(shown)
    ]
    lines += ["", *(f"- {effect_in_words(c.name)}" for c in shown if effect_description(c.name))]
    lines += ["", *(f"- To measure next: {p.do} (separates {' and '.join(p.separates)})" for p in found.next)]
    rec.log("diagnosis/verdict", words("\n".join(lines)), static=True)
    if screen["why"] is not None:
        log_course(rec, screen["why"], session.names, um)
    evidence = np.array([c.ranked.score.log_bayes_factor for c in shown])
    rec.log("diagnosis/evidence", rr.BarChart(evidence, color=COLOURS_OF_FEW[1]), static=True)
    moved = np.linalg.norm(found.linear.view_displacements(), axis=1) * um
    rec.log("diagnosis/displaced", rr.BarChart(moved, color=COLOURS_OF_FEW[0]), static=True)
