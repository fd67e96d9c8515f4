"""The diagnosis on cells of known truth: a small part of bench/blind.py, and its parts against closed forms."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import measured_blade
from hypothesis import given, settings
from hypothesis import strategies as st
from in_memory import session_of
from scipy.stats import binomtest

from data_synth.commands import judge
from data_synth.scene import load_scene
from data_synth.simulate import simulate
from data_synth.write import write_session, write_truth
from stitch import frames
from stitch.cli.main import main
from stitch.comparison.compare_surfaces import compare
from stitch.diagnosis.initial_values import evidence_of_state
from stitch.diagnosis.validation.cross_validation import present_square
from stitch.errors import InputError
from stitch.pipeline import run
from stitch.statistics.folds import grouped_folds, joint_ends
from stitch.statistics.identifiability import independent
from stitch.statistics.parameter_selection import omitted_rms, supported
from stitch.statistics.variance_components import Evidence, at_variances, fit_variances
from stitch.stored.load_state import load_state, state_of
from stitch.writing.diagnosis_document import diagnosis_document
from stitch.writing.json_file import to_json


def blade_run(seed, hidden, mount="eye_to_hand", views=12):
    measured = measured_blade(seed, views=views, mount=mount, hidden=hidden, pixels=90)
    return measured, run(session_of(measured))


# Sizes that are two to four times what these cells can show at the least.
VISIBLE = [
    ("joint_offset", "eye_in_hand", 4.0),
    ("joint_compliance", "eye_to_hand", 3.0),
    ("lens_distortion", "eye_to_hand", 3.0),
]


@pytest.mark.parametrize(("name", "mount", "size"), VISIBLE)
def test_a_hidden_effect_is_named_added_and_the_error_falls(name, mount, size):
    measured, before = blade_run(1, {name: size}, mount)
    found = before.diagnose()
    assert found.verdict in ("missing_effect", "cannot_tell"), found.sentence
    assert name in found.effects, found.sentence
    after = before.add(name)
    assert after.residual_rms < before.residual_rms
    assert after.heldout_rms < before.heldout_rms
    assert [s.effects for s in after.ledger] == [(), (name,)]
    # What the linear prediction promised comes true when everything is fitted and matched anew.
    left = next(s.cross_validation for s in found.candidates if s.name == name)
    assert after.residual_rms == pytest.approx(before.residual_rms * np.sqrt(left.inside), rel=0.15)
    # The truth, which no overlap knows, comes nearer too: a fit that borrows from the hand-eye would not show above.
    errors = [frames.log(frames.inverse(measured.T_mount) @ r.T_mount)[3:] for r in (before, after)]
    assert np.linalg.norm(errors[1]) < max(
        np.linalg.norm(errors[0]), 3 * np.sqrt(np.trace(after.mount_covariance[3:, 3:]))
    )
    term, sigmas = after.terms[0], after.sigmas[0]
    z = [
        (value - measured.hidden[name].get(p.name, 0.0)) / sigma
        for p, value, sigma in zip(after.measurement.parameters(term.effect), term.values, sigmas, strict=True)
        if np.isfinite(sigma) and not p.grid
    ]
    assert np.max(np.abs(z)) < 4.0


@pytest.mark.parametrize("seed", [11])
def test_nothing_hidden_is_adequate(seed):
    _, result = blade_run(seed, {}, ("eye_to_hand", "eye_in_hand")[seed % 2])
    found = result.diagnose()
    assert found.verdict == "adequate", found.sentence
    assert 5e-6 < found.rotation < 6e-5
    assert 5e-3 < found.translation < 6e-2


@pytest.mark.parametrize(("name", "follows"), [("covariate_bias", "humidity_percent")])
def test_what_the_library_does_not_know_gets_no_name(name, follows):
    _, result = blade_run(2, {name: 4.0}, "eye_in_hand", 14)
    found = result.diagnose()
    assert found.verdict == "unknown_effect", found.sentence
    assert not found.effects
    assert follows in [d.covariate for d in found.depends_on[:3]]


def test_offset_of_the_first_joint_is_never_named_where_the_hand_eye_hides_it():
    """eye_to_hand: joint 1 turns everything about one axis of the base; that is a hand-eye."""
    measured = measured_blade(3, views=16, pixels=90)
    session = session_of(measured)
    result = run(session).add("joint_offset")
    offsets, sigmas = result.terms[0].values, result.sigmas[0]
    assert offsets[0] == 0.0
    assert np.isnan(sigmas[0])
    assert offsets[5] == 0.0  # the last joint moves the whole part
    assert np.isnan(sigmas[5])


def test_turning_the_last_joint_alone_names_nothing():
    measured = measured_blade(
        4, views=16, pixels=90, tilt=0.0, roll=0.0, aim=0.0, distance=0.0, hidden={"joint_offset": 3.0}
    )
    found = run(session_of(measured)).diagnose()
    assert found.verdict in ("adequate", "cannot_tell")


def test_variances_are_found_again():
    """Components of known size: the mean estimate over 40 draws within three standard errors."""
    rng = np.random.default_rng(0)
    n, found = 90, []
    a, b = rng.standard_normal((2, n, n)) / np.sqrt(n)
    C = np.array([a @ a.T, b @ b.T, np.eye(n)])[:, None]
    A = rng.standard_normal((1, n, 5))
    truth = np.array([4.0, 2.0, 1.0])
    half = np.linalg.cholesky(np.einsum("c,cij->ij", truth, C[:, 0]))
    for _ in range(40):
        z = half @ rng.standard_normal(n) + A[0] @ rng.normal(0, 30, 5)
        found.append(fit_variances(Evidence(z[None], A, C)).variances)
    mean, error = np.mean(found, axis=0), np.std(found, axis=0) / np.sqrt(len(found))
    # The prior off the boundary lifts the first two by about a standard deviation of one estimate at most.
    assert (mean - truth < 3 * error + np.std(found, axis=0)).all()
    assert (truth - mean < 3 * error).all()


def test_evidence_is_the_gaussian_integral():
    """Integrating θ out by hand gives the same likelihood as the covariance V + G S Gᵀ."""
    rng = np.random.default_rng(1)
    n = 30
    C = np.array([np.diag(rng.uniform(0.5, 1, n)) for _ in range(3)])[:, None]
    z, A, G = rng.standard_normal((1, n)), rng.standard_normal((1, n, 2)), rng.standard_normal((1, n, 3))
    prior = np.array([0.5, 1.0, 2.0])
    variances = np.array([1.0, 0.7, 1.3])
    plain, wide = (at_variances(Evidence(z, A, c), variances) for c in (C, C))
    with_G = at_variances(Evidence(z, A, C), variances, G, prior)
    V = np.einsum("c,cij->ij", variances, C[:, 0])
    values = []
    for K in (V, V + (G[0] * prior**2) @ G[0].T):
        W = np.linalg.inv(K)
        M = A[0].T @ W @ A[0]
        P = W - W @ A[0] @ np.linalg.solve(M, A[0].T @ W)
        values.append(np.linalg.slogdet(K)[1] + np.linalg.slogdet(M)[1] + z[0] @ P @ z[0])
    assert with_G.deviance - plain.deviance == pytest.approx(values[1] - values[0], abs=1e-8)
    assert wide.deviance == plain.deviance


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(-6, 6))
def test_units_do_not_decide_what_is_visible(seed, exponent):
    """Counting a parameter in another unit, with its size, changes nothing."""
    rng = np.random.default_rng(seed)
    base, columns = rng.standard_normal((40, 4)), rng.standard_normal((40, 6))
    columns[:, 5] = columns[:, 0] + 1e-9 * rng.standard_normal(40)
    sizes = rng.uniform(0.5, 2.0, 6)
    unit = 10.0**exponent
    chosen = independent(base, columns, sizes, 0.3)
    assert np.array_equal(chosen, independent(base, columns / unit, sizes * unit, 0.3))
    assert chosen.sum() == 5  # of two that say the same, one


def test_of_an_effect_only_the_joint_that_is_off_is_fitted():
    """White noise, six groups, one of them true at ten sigmas: another one by chance at most 1 in 20."""
    groups, others = [[0, 1], [2, 3], [4, 5], [6], [7], [8]], 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        own, further = rng.standard_normal((60, 6)), rng.standard_normal((60, 9))
        z = further[:, 2] * 1.5 + own @ rng.standard_normal(6) + rng.standard_normal(60)
        chosen = supported(own, further, z, np.full(9, 0.5), groups, [0] * 6)
        assert chosen[2] and chosen[3]
        others += chosen.sum() > 2
    # 5 groups whose log evidence exceeds 2.5 by chance in some 0.4 % each.
    assert binomtest(others, 200, 0.05, alternative="greater").pvalue > 0.01


def test_an_effect_in_the_model_keeps_its_best_group_however_weak():
    rng = np.random.default_rng(0)
    chosen = supported(
        rng.standard_normal((60, 6)), rng.standard_normal((60, 3)), rng.standard_normal(60), np.full(3, 0.1),
        [[0], [1], [2]], [0, 0, 1],
    )  # fmt: skip
    assert chosen[2] and chosen[:2].sum() == 1


def test_what_stays_at_zero_may_be_as_large_as_it_is_on_the_average():
    """Amplitudes that are there in half the cases, drawn from their prior: mean squares told and true agree."""
    rng, told, true = np.random.default_rng(3), [], []
    for _ in range(4000):
        own, further, size = rng.standard_normal((12, 2)), 0.4 * rng.standard_normal((12, 1)), rng.uniform(0.2, 3)
        amplitude = size * rng.standard_normal() * rng.integers(0, 2)
        z = own @ rng.standard_normal(2) + further[:, 0] * amplitude + rng.standard_normal(12)
        told.append(omitted_rms(own, further, z, np.array([size]), np.zeros(1, bool))[0] ** 2 / size**2)
        true.append(amplitude**2 / size**2)
    apart = np.array(told) - true
    assert abs(apart.mean()) < 4 * apart.std() / np.sqrt(len(apart))
    # Beside a column that is fitted and says the same nothing is known of it but its size.
    same = omitted_rms(own, np.tile(further, 2), z, np.full(2, 0.3), np.array([True, False]))
    np.testing.assert_allclose(same, [0.0, 0.3 * np.sqrt(0.5)], rtol=1e-6)


def test_ends_of_joints_are_fifths_of_what_was_driven():
    rng = np.random.default_rng(0)
    joints = np.column_stack([rng.permutation(200), np.zeros(200)])
    seen = np.arange(0, 200, 2)
    low, high = joint_ends(joints, seen)  # none of the joint that stands still
    assert (low.joint, low.upper, high.upper) == (0, False, True)
    assert np.isin(low.views, seen).all() and 19 <= len(low.views) <= 21
    assert joints[low.views, 0].max() < np.quantile(joints[seen, 0], 0.21)
    assert joints[high.views, 0].min() > np.quantile(joints[seen, 0], 0.79)
    assert joint_ends(joints, seen[:60]) == []


def test_folds_leave_out_neighbours():
    T = np.tile(np.eye(4), (20, 1, 1))
    T[:, 0, 3] = np.arange(20) % 5 * 100.0
    folds = grouped_folds(T, 100.0)
    assert sorted(np.concatenate(folds[:5])) == list(range(20))
    assert all(np.ptp(f) == 3 for f in folds[:5])  # four in a row by time
    assert all(len(set(T[f, 0, 3])) == 1 for f in folds[5:])  # one place each by pose


def test_compare_counts_everything_and_shows_the_view_that_is_off():
    measured, result = blade_run(5, {})
    state = state_of(result)
    found = compare(state)
    assert found.rms == pytest.approx(result.residual_rms, rel=0.05)
    table = found.table("view")
    assert table.views.sum() == len(measured.clouds)
    assert {"range", "incidence", "j5", "time", "humidity_percent"} <= {t.name for t in found.tables}
    total = found.table("range").count.sum()
    assert all(t.count.sum() == total for t in found.tables if t.name != "pair")
    # Each correspondence is seen from both sides with opposite signs.
    assert np.average(table.mean, weights=table.count) == pytest.approx(0, abs=1e-12)


def test_prediction_of_the_null_is_the_present_residual():
    _, result = blade_run(6, {})
    evidence = evidence_of_state(state_of(result))
    g = evidence.freed.overlaps.gram
    assert np.sqrt(present_square(evidence) / g.weight.sum()) == pytest.approx(result.residual_rms, rel=0.15)


@pytest.fixture(scope="module")
def session_on_disk(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cli")
    scene = load_scene("blade")
    scene = replace(scene, scanner=replace(scene.scanner, columns=100, rows=100))
    measured = simulate(scene, {"joint_compliance": 3.0}, 0, 14)
    write_session(folder / "s", measured, "s")
    write_truth(folder / "s.truth.json", measured, 0)
    return folder


def test_the_whole_way_by_command_line(session_on_disk, capsys):
    folder = session_on_disk
    main_(["run", str(folder / "s"), "-o", str(folder / "r"), "--no-recording"])
    main_(["diagnose", str(folder / "r"), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert told["format"] == "stitch-diagnosis/1"
    assert told["effects"] == ["joint_compliance"]
    assert told == json.loads((folder / "r" / "diagnosis.json").read_text())
    keys = {"effect", "p_value", "posterior", "observable", "parameters", "rms_if_added", "heldout_rms_if_added",
            "minimum_detectable", "aliases"}  # fmt: skip
    assert all(keys <= set(c) for c in told["candidates"])
    seen = [c["observable"] for c in told["candidates"]]
    assert seen == sorted(seen, reverse=True)
    main_(["add", str(folder / "r"), "joint_compliance", "--no-recording"])
    assert not (folder / "r" / "diagnosis.json").exists()
    result = json.loads((folder / "r" / "result.json").read_text())
    assert result["effects"]["joint_compliance"]["c2"]["unit"] == "rad/(N m)"
    ledger = json.loads((folder / "r" / "ledger.json").read_text())
    assert [s["step"] for s in ledger] == [0, 1]
    assert ledger[1]["residual_rms"] < ledger[0]["residual_rms"]
    assert judge(folder / "r", folder / "s.truth.json")["judgement"] == "complete"
    assert load_state(folder / "r").terms[0].effect.name == "joint_compliance"
    main_(["run", str(folder / "s"), "-o", str(folder / "again"), "--hand-eye", str(folder / "r"), "--no-recording"])
    again = json.loads((folder / "again" / "result.json").read_text())
    assert again["residual_rms"] == pytest.approx(result["residual_rms"], rel=0.02)
    main_(["compare", str(folder / "r"), "--json"])
    assert "Where model and measurement differ" in (folder / "r" / "report.html").read_text()
    main_(["drop", str(folder / "r"), "joint_compliance", "--no-recording"])
    assert json.loads((folder / "r" / "result.json").read_text())["effects"] == {}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["diagnose", "nowhere"], ["nowhere", "no such run folder"]),
        (["add", "RUN", "elbow"], ["no effect 'elbow'"]),
        (["add", "RUN"], ["--suggested"]),
        (["drop", "RUN", "backlash"], ["not in the model"]),
        (["run", "SESSION", "--effects", "elbow"], ["no effect 'elbow'"]),
        (["diagnose", "RUN", "--effects-file", "mine.py"], ["mine.py", "no such file"]),
        (["effects", "elbow"], ["no effect 'elbow'"]),
    ],
)
def test_bad_use_ends_in_one_line(session_on_disk, capsys, arguments, words):
    folder = session_on_disk
    if not (folder / "r0").exists():
        main_(["run", str(folder / "s"), "-o", str(folder / "r0"), "--no-recording"])
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        main([a.replace("RUN", str(folder / "r0")).replace("SESSION", str(folder / "s")) for a in arguments])
    assert stop.value.code == 2
    line = capsys.readouterr().err.strip()
    assert "\n" not in line
    assert all(word in line for word in words)


def main_(arguments):
    """The command line, which ends with exit code 0."""
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 0


def test_document_has_no_infinite_number():
    _, result = blade_run(7, {}, views=12)
    text = to_json(diagnosis_document(result.diagnose()))
    assert json.loads(text)["verdict"] == "adequate"


def test_state_of_a_vanished_session_is_refused(tmp_path, session_on_disk):
    folder = session_on_disk
    if not (folder / "r0").exists():
        main_(["run", str(folder / "s"), "-o", str(folder / "r0"), "--no-recording"])
    document = json.loads((folder / "r0" / "result.json").read_text())
    document["session"] = str(tmp_path / "gone")
    (tmp_path / "r").mkdir()
    for name in ("model.toml", "ledger.json"):
        (tmp_path / "r" / name).write_text((folder / "r0" / name).read_text())
    (tmp_path / "r" / "result.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="has gone"):
        load_state(tmp_path / "r")
