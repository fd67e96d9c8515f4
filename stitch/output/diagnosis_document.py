"""diagnosis.json: a diagnosis as a document, and what is read of it again."""

from operator import itemgetter
from typing import Any

import numpy as np

from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis, Finding
from stitch.diagnosis.law_ranking import law_size
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.score import Score
from stitch.diagnosis.sentences import fitted_amounts, law_in_words
from stitch.diagnosis.systematic_laws import law_of
from stitch.diagnosis.validation import CrossValidation
from stitch.output.finding_screen import clearest_parameter, finding_screen
from stitch.output.plain_finding import next_step_line, next_step_without_a_view, plain_finding
from stitch.output.result_document import parameter_row
from stitch.output.schema import NUMBER, NUMBER_OR_NULL, TEXT, Document, Key, Kind, list_of, rows_of

FORMAT = "stitch-diagnosis/1"
_RIVALS = 5  # the likeliest, which stand beside a candidate
# Of a cross-validation, what its verdict on a fitted effect needs.
_VALIDATION_FIELDS = ("inside", "heldout", "heldout_sigma", "poses", "poses_sigma", "steadiness")


def diagnosis_document(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return diagnosis.json as a dictionary; candidates best first, those that the data cannot see last."""
    return DIAGNOSIS.write(diagnosis)


def finding_lines(document: dict[str, Any]) -> tuple[str, ...]:
    """Return finding, evidence and notes of a diagnosis in words, each once."""
    notes = (f"{note}." for note in document["notes"] if note not in document["sentence"])
    return (document["plain"], document["sentence"], *notes)


def named_before(document: dict[str, Any], tried: dict[str, str]) -> Finding | None:
    """Return what a stored diagnosis of a run names to be added; None where it names nothing.

    Nothing is named either where its first effect was dropped before, or is less likely than no effect at all.

    Args:
        document: diagnosis.json.
        tried: effects that were fitted in the run and dropped again, with the reason.
    """
    try:
        odds = document["log_odds_over_nothing"]
        if document["verdict"] != "missing_effect":
            return None
        if document["effects"][0] in tried or (odds is not None and odds <= 0):
            return None
        validations = {
            row["effect"]: CrossValidation(**row["left_out"]) for row in document["candidates"] if row["left_out"]
        }
        return Finding(finding_lines(document), tuple(document["together"]), validations)
    except (LookupError, TypeError):
        return None  # of an earlier version


def _candidate_rows(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return a row of diagnosis.json for each effect that was tested, then for each that could not be.

    An untested effect lacks something that it `needs`, such as joint angles; its numbers are null.
    """
    unknown = ("p_value", "rms_if_added", "heldout_rms_if_added", "left_out", "minimum_detectable")
    untested = [
        {
            "effect": name,
            "posterior": 0.0,
            "observable": False,
            "parameters": {},
            "amounts": "",
            "aliases": [],
            "needs": list(needs),
            "against": [],
        }
        | dict.fromkeys(unknown)
        for name, needs in diagnosis.missing.items()
    ]
    return [*(_candidate_row(diagnosis, candidate) for candidate in diagnosis.candidates), *untested]


def _candidate_row(diagnosis: Diagnosis, candidate: CandidateEffect) -> dict[str, Any]:
    """Return the row of diagnosis.json of an effect that was tested: chance, sizes, rivals, what it would bring.

    Values are null where the views cannot observe it, or where no cross-validation was made.
    """
    ranked, validation = candidate.ranked, candidate.cross_validation
    observable = ranked.score.observable
    inside, heldout = (None, None) if validation is None else diagnosis.rms_if_added(validation)
    detectable = {name: size for name, size in candidate.detectable.items() if np.isfinite(size)}
    clearest = clearest_parameter(candidate)
    return {
        "effect": candidate.name,
        "p_value": ranked.adjusted if observable else None,
        "posterior": ranked.posterior if observable else 0.0,
        "observable": observable,
        "parameters": _parameters(ranked.score),
        "amounts": fitted_amounts(ranked) if observable else "",
        "rms_if_added": inside,
        "heldout_rms_if_added": heldout,
        "left_out": None if validation is None else {name: getattr(validation, name) for name in _VALIDATION_FIELDS},
        # Of the parameter that these views know best against its plausible size; all below.
        "minimum_detectable": detectable.get(clearest or ""),
        "minimum_detectable_of": clearest,
        "minimum_detectable_each": detectable,
        "hand_eye_if_missed": candidate.hand_eye,
        "shape_if_missed": candidate.shape,
        "aliases": [{"effect": name, "correlation": alike} for name, alike in candidate.aliases.items()],
        "tier": ranked.score.candidate.effect.tier,
        "against": _rivals(diagnosis, ranked),
    }


def _rivals(diagnosis: Diagnosis, ranked: Ranked) -> list[dict[str, Any]]:
    """Return the likeliest alternatives to a candidate, and the log odds of the candidate over each of them.

    Alternatives are the other effects, laws without a name, and that nothing is missing. The likeliest comes first, at
    most `_RIVALS`; empty where the views cannot observe the candidate.
    """
    if not ranked.score.observable:
        return []
    odds = {c.name: c.ranked.log_posterior for c in diagnosis.candidates if c.ranked.score.observable}
    odds |= {law_of(law).words: law.log_posterior for law in diagnosis.laws}
    odds["nothing"] = ranked.log_posterior - ranked.log_odds_over_nothing
    del odds[ranked.name]
    likeliest = sorted(((other, what) for what, other in odds.items()), reverse=True)[:_RIVALS]
    return [{"what": what, "log_odds": ranked.log_posterior - other} for other, what in likeliest]


def _parameters(score: Score) -> dict[str, Any]:
    """Return the parameters of a candidate's best form by name: value, sigma and unit.

    Parameters of which a grid of values was tried, such as time constants, have no sigma. Those that enter linearly
    were fitted.
    """
    rows = {p.name: parameter_row(p) | {"sigma": None} for p in score.form.term.parameters if p.grid}
    if score.observable and score.fitted:
        for p, value, sigma in zip(score.form.free, score.values, score.sigmas, strict=True):
            rows[p.name] = {"value": float(value), "sigma": float(sigma), "unit": p.unit}
    return rows


def _law_rows(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return rows of the empirical laws of a diagnosis: at a place, the error follows a quantity in some shape.

    They are alternatives to the effect that is named, or the finding itself where no effect is.
    """
    rows = []
    for ranked in diagnosis.laws:
        law = law_of(ranked)
        size, sigma, unit = law_size(diagnosis.linear, ranked)
        row = {"place": law.place.name, "follows": law.driver.name, "shape": law.shape, "words": law_in_words(law)}
        rows.append(row | {"size": size, "sigma": sigma, "unit": unit, "p_value": ranked.adjusted})
    return rows


# What is read again of a candidate.
_CANDIDATE = Document(
    Key("effect", TEXT),
    Key("hand_eye_if_missed", NUMBER_OR_NULL, optional=True),
    Key("left_out", Kind({"type": ["object", "null"], "additionalProperties": NUMBER.schema}), optional=True),
)
# Where in its field the scanner errs along the ray, in length_unit; null where too few points were seen.
_NULLS = Kind({}, lambda values: np.where(np.isfinite(values), values, np.array(None)).tolist())
_FIELD_MAP = Document(
    Key("x_over_z", attribute="x"), Key("y_over_z", attribute="y"), Key("error", _NULLS), Key("sigma", _NULLS)
)
# When in the session a flange errs by no known law, in its own frame; rotation in rad, then translation.
_TIME_LAW = Document(
    Key("steps"), Key("seconds_a_step", write=lambda curve: curve.seconds or None), Key("error"), Key("sigma")
)
_TRIED = Document(Key("effect", TEXT, write=itemgetter(0)), Key("dropped", TEXT, write=itemgetter(1)))
# Lengths in length_unit, angles in rad.
DIAGNOSIS = Document(
    Key("format", write=lambda d: FORMAT),
    Key("verdict", Kind({"enum": ["adequate", "missing_effect", "cannot_tell", "unknown_effect"]})),
    Key("effects"),
    Key("certain"),
    Key("plain", write=lambda d: plain_finding(d, d.linear.measurement.length_unit)),
    Key("sentence"),
    Key("residual_rms"),
    Key("noise_floor"),
    Key("repeatability", write=lambda d: {"rotation": d.rotation, "translation": d.translation}),
    Key("candidates", Kind(list_of(_CANDIDATE.kind()).schema), write=_candidate_rows, optional=True),
    Key("depends_on", rows_of("covariate place score p_value bins mean sigma shape")),
    Key("laws", write=_law_rows),
    Key("places"),
    # Along what a joint errs by no known law, in the unit of its covariate; errors in rad.
    Key("joint_laws", rows_of("joint covariate share at error sigma may_follow"), "curves"),
    Key("time_law", _TIME_LAW.or_null(), "time_curve"),
    Key("next", rows_of("do separates joints_deg views T_base_flange wait_s probability")),
    Key("next_command", write=lambda d: next_step_line(d, "RUN")),
    Key("command_without_a_view", write=lambda d: next_step_without_a_view(d, "RUN")),
    Key(
        "alias_matrix",
        write=lambda d: {"effects": [c.name for c in d.candidates], "correlation": np.round(d.matrix, 4).tolist()},
    ),
    Key(
        "log_odds_over_nothing",
        write=lambda d: d.log_odds_over_nothing if np.isfinite(d.log_odds_over_nothing) else None,
    ),
    Key("notes"),
    Key("doubts"),
    Key("together"),
    Key("tried", _TRIED.rows(), write=lambda d: d.tried.items(), optional=True),
    Key("budget", rows_of("source variance_share sigma unit")),
    Key("field_map", _FIELD_MAP.or_null(), write=lambda d: d.scanner_error and d.scanner_error.map),
    Key("views", write=lambda d: d.linear.measurement.views.count),
    Key("evidence", write=lambda d: d.linear.mixed.size),
    Key("screen", write=finding_screen),
)
