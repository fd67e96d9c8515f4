"""`stitch measure` and `stitch verify` on a small cell whose part and artefact are known."""

import csv
import json
import re
import shutil
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import tomli_w
from plyfile import PlyData
from typer.testing import CliRunner

import stitch
from data_synth.cells.verified_cell import write_verified_cell
from stitch.cli.main import build
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.plugins.metrology import verb
from stitch.plugins.metrology.budget import MeasuredFeatures, Number
from stitch.plugins.metrology.feature_file import read_features
from stitch.plugins.metrology.features import Feature
from stitch.plugins.metrology.planning.command import place_of
from stitch.plugins.metrology.verification import largest_E_n, verify
from stitch.run_data import HandEyeTransfer
from stitch.session.reading.clouds import read_cloud
from tests.in_browser import WAYS, require_for_everybody
from viz.features_page import write_certificate, write_features


def _stitch(*arguments):
    return CliRunner().invoke(build(), [str(a) for a in arguments])


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A part and an artefact on another day, and the run of the part; one cell for all of this file."""
    folder = tmp_path_factory.mktemp("cell")
    made = write_verified_cell(folder, 2, views=6, rays=80)
    done = _stitch("run", made["part"], "-o", folder / "run", "--no-recording")
    assert done.exit_code == 0, done.output
    return folder


@pytest.fixture(scope="module", autouse=True)
def worked_out_once():
    """The artefact under one hand-eye, and what errs at its places: lists of features are judged by the same."""
    stitched, placed, stitch_session, place_errors = {}, {}, verb.stitch_session, verb.place_errors

    def stitch_once(session, model):
        key = (session.path, model.T_mount.tobytes())
        if key not in stitched:
            stitched[key] = stitch_session(session, model)
        return stitched[key]

    def place_once(state):
        key = (state.session.path, state.T_mount.tobytes(), state.mount_covariance.tobytes())
        if key not in placed:
            placed[key] = place_errors(state)
        return placed[key]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(verb, "stitch_session", stitch_once)
        patched.setattr(verb, "place_errors", place_once)
        yield


def test_measure_writes_numbers_budgets_and_a_dfq_file(cell):
    done = _stitch("measure", cell / "run", cell / "part.toml", "--dfq", cell / "part.dfq")
    assert done.exit_code == 0, done.output
    assert re.search(r"[45] of 5 calibrated numbers agree", " ".join(done.output.split()))
    document = json.loads((cell / "run" / "features.json").read_text())
    numbers = {f"{n['feature']}.{n['quantity']}": n for n in document["numbers"]}
    point = numbers["point 1.deviation"]
    assert abs(point["value"]) < 3 * point["U"] and 0.002 < point["U"] < 0.2
    assert sum(line["variance_share"] for line in point["budget"]) == pytest.approx(1)
    matrix = np.array(document["covariance"]["matrix"])
    assert np.sqrt(np.diag(matrix)) == pytest.approx([n["u"] for n in document["numbers"]])
    rows = list(csv.DictReader((cell / "run" / "features.csv").open()))
    by_source = [float(rows[0][key]) for key in rows[0] if key.startswith("u: ")]
    assert np.sqrt(np.sum(np.square(by_source))) == pytest.approx(float(rows[0]["u"]), rel=1e-6)
    own = float(rows[0]["cov: point 1.deviation"]), float(rows[0]["cov: point 2.deviation"])
    assert own == pytest.approx(matrix[0, :2], rel=1e-6)
    write_features(document, cell / "page.html")
    page = (cell / "page.html").read_text(encoding="utf-8")
    assert "point 1.deviation" in page and "conforms" in page and document["not_included"][0] in page
    assert place_of(cell / "run", "point 2") == ",".join(
        map(str, [*numbers["point 2.deviation"]["at"], *numbers["point 2.deviation"]["normal"]])
    )
    assert place_of(cell / "run", "1,2,3") == "1,2,3"
    dfq = (cell / "part.dfq").read_text("utf-8-sig")
    assert f"K0100 {len(numbers)}" in dfq and "K2110/1 -0.1" in dfq


def test_measure_without_features_gives_every_point_a_sigma(cell):
    assert _stitch("measure", cell / "run").exit_code == 0
    sigma = PlyData.read(cell / "run" / "stitched.ply")["vertex"]["sigma"]
    assert np.isfinite(sigma).all() and 0.001 < np.median(sigma) < 0.2


def test_numbers_and_cloud_count_in_the_frame_of_a_datum_by_command_and_in_python(cell):
    part, artefact = (tomllib.loads((cell / name).read_text()) for name in ("part.toml", "artefact/artefact.toml"))
    datum = ["top.offset", "top.slope_u", "top.slope_v", "ball 1.x", "ball 1.y", "ball 2.y"]
    seen = [part["feature"][-1], *(row for row in artefact["feature"] if row["kind"] == "sphere")]
    (cell / "datum.toml").write_text(tomli_w.dumps(part | {"datum": datum, "feature": seen}))
    done = _stitch("measure", cell / "run", cell / "datum.toml")
    assert "Numbers count in the frame of the datum" in done.output
    document = json.loads((cell / "run" / "features.json").read_text())
    held = [n for n in document["numbers"] if f"{n['feature']}.{n['quantity']}" in datum]
    assert len(held) == 6 and all(abs(n["value"] - n["nominal"]) < 1e-6 and n["U"] == 0 for n in held)
    run = stitch.load_run(cell / "run")
    measured = stitch.measure(run, cell / "datum.toml")
    assert np.array_equal(measured.T_datum_reference, document["T_datum_reference"])
    _stitch("export", cell / "run", "--to", "ply", "--datum", "-o", cell / "a.ply")
    stitch.export_run(run, "ply", cell / "b.ply", datum=measured)
    points = read_cloud(cell / "b.ply").points
    assert np.array_equal(points, read_cloud(cell / "a.ply").points)
    expected = frames.transform(measured.T_datum_reference, run.fused.points)
    assert np.allclose(points, expected, atol=1e-3) and not np.allclose(points, run.fused.points, atol=5e-3)
    with pytest.raises(InputError, match="datum: is of a cloud; to fix"):
        stitch.export_run(run, "ros", datum=measured)
    with pytest.raises(InputError, match="measured without one; to fix: state datum"):
        stitch.export_run(run, "ply", cell / "b.ply", datum=replace(measured, T_datum_reference=None))


def _artefact(cell, name, limit, factor=1.0, first_by=0.0):
    """The artefact's features with another limit of sizes, calibrated values scaled, and the first one moved."""
    document = tomllib.loads((cell / "artefact" / "artefact.toml").read_text())
    document["limits"]["size"] = limit
    for row in document["feature"]:
        row["calibrated"] *= factor
    document["feature"][0]["calibrated"] += first_by
    (cell / name).write_text(tomli_w.dumps(document))
    return cell / name


def _verify(cell, features, run="run"):
    done = _stitch("verify", cell / run, cell / "artefact", "--features", features, "-o", cell / "certificate")
    return done.exit_code, json.loads((cell / "certificate" / "certificate.json").read_text())


def test_verify_passes_a_good_cell_and_fails_a_wrong_artefact(cell):
    features = _artefact(cell, "good.toml", 0.15)
    done = _stitch("verify", cell / "run", cell / "artefact", "--features", features, "-o", cell / "good")
    assert done.exit_code == 0, done.output
    good = json.loads((cell / "good" / "certificate.json").read_text())
    write_certificate(good, cell / "certificate.html")
    assert good["sentence"] in (cell / "certificate.html").read_text(encoding="utf-8").replace("\u00a0", " ")
    assert good["passed"] and good["agreeing"] >= 13 and len(good["numbers"]) == 15
    assert {"hand_eye", "scanner"} <= set(good["answers_to"]) and good["hand_eye"]["agrees"]
    assert all("scanner" in number["answers_to"] for number in good["numbers"])
    code, wrong = _verify(cell, _artefact(cell, "wrong.toml", 0.15, factor=1.002))  # 0.2 mm on 100 mm
    assert code == 3 and wrong["passed"] is False


def test_verify_cannot_decide_where_U_is_larger_than_a_limit(cell):
    code, open_ = _verify(cell, _artefact(cell, "open.toml", 0.03))
    assert code == 3 and open_["passed"] is None
    assert "U is too large for the limit of ball" in open_["sentence"]
    assert None in [number["passes"] for number in open_["numbers"]]


def test_verify_fails_one_number_that_is_off_however_many_agree(cell):
    features = _artefact(cell, "one.toml", 1.0, first_by=0.25)
    code, one = _verify(cell, features)
    assert one["agreeing"] == 14 and [number["passes"] for number in one["numbers"]].count(False) == 1
    assert code == 3 and one["passed"] is False and "ball 1 is off by" in one["sentence"]


@pytest.mark.parametrize(("together", "holds"), [(True, True), (False, False)])
def test_numbers_that_one_thing_displaces_count_as_one(together, holds):
    features = [Feature(f"point {k}", "point", calibrated=0.0) for k in range(20)]
    moved = np.where(np.arange(20) < 7, 1.1, 0.3)
    numbers = [
        Number(feature, "deviation", "mm", by, 0.0, 0.5, np.inf, {}, 100, 0.01)
        for feature, by in zip(features, moved.tolist(), strict=True)
    ]
    covariance = 0.25 * np.eye(20)
    if together:
        covariance[:7, :7] = 0.2475 + 0.0025 * np.eye(7)
    agrees = HandEyeTransfer(0.0, 0.0, 0.5, 0.1, 0.1, 0.9)
    result = verify(MeasuredFeatures(tuple(numbers), covariance, (), "mm"), None, agrees)
    assert result.agreeing == 13 and result.U_holds is holds


def test_verify_fails_a_hand_eye_that_its_numbers_do_not_show(cell):
    shutil.copytree(cell / "run", cell / "moved")
    model = tomllib.loads((cell / "moved" / "model.toml").read_text())
    T = np.array(model["hand_eye"]["corrected"])
    sigma = np.array(model["hand_eye"]["sigma"])
    T[:3, 3] += T[:3, 0] * 5 * 2 * sigma[3]
    model["hand_eye"]["corrected"] = T.tolist()
    (cell / "moved" / "model.toml").write_text(tomli_w.dumps(model))
    code, moved = _verify(cell, _artefact(cell, "good.toml", 0.15), run="moved")
    assert code == 3 and moved["passed"] is False and not moved["hand_eye"]["agrees"]
    assert moved["agreeing"] >= 13 and moved["hand_eye"]["distance"] == pytest.approx(10 * sigma[3], rel=0.5)
    assert any("does not fit these views" in doubt for doubt in moved["doubts"])


def test_scans_of_the_fit_verify_nothing_under_another_name(cell):
    shutil.copytree(cell / "part", cell / "copy")
    with pytest.raises(InputError, match="on which .* was fitted"):
        CliRunner().invoke(build(), ["verify", str(cell / "run"), str(cell / "copy")], catch_exceptions=False)


@pytest.mark.parametrize(("count", "largest"), [(1, 1.288), (15, 1.701), (100, 1.945)])
def test_the_largest_E_n_that_chance_lets_grows_with_the_numbers(count, largest):
    normal = np.abs(np.random.default_rng(0).standard_normal((200_000 // count, count))).max(axis=1) / 2
    assert largest_E_n(count) == pytest.approx(largest, abs=1e-3)
    assert np.mean(normal > largest_E_n(count)) == pytest.approx(0.01, abs=0.006)


@pytest.mark.slow  # a browser
@pytest.mark.parametrize("way", WAYS)
def test_the_certificate_is_readable_by_everybody(cell, browser, way):
    _stitch("verify", cell / "run", cell / "artefact", "-o", cell / "good")
    write_certificate(json.loads((cell / "good" / "certificate.json").read_text()), cell / "certificate.html")
    require_for_everybody(browser, cell / "certificate.html", way)


def test_the_session_of_the_fit_verifies_nothing(cell):
    with pytest.raises(InputError, match="was fitted on it"):
        CliRunner().invoke(build(), ["verify", str(cell / "run"), str(cell / "part")], catch_exceptions=False)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "asks for nothing"),
        ('[[feature]]\nkind = "ball"', "kind is"),
        ('[[feature]]\nkind = "sphere"\nat = [0, 0, 0]', "diameter"),
        ('[[feature]]\nkind = "sphere"\nat = [0, 0]\ndiameter = 2', "at is"),
        ('[[feature]]\nkind = "distance"\nbetween = ["a", "b"]', "between is"),
        ('[[feature]]\nkind = "point"\nat = [0, 0, 0]\nnormal = [0, 0, 1]\nradus = 2', "unknown key"),
        ('[[feature]]\nkind = "point"\nat = [0, 0, 0]\nnormal = [0, 0, 0]', "no direction"),
        ('[[feature]]\nkind = "deviation"\nat = [0, 0, 0]', "cad is"),
    ],
)
def test_a_wrong_file_is_refused_by_what_is_wrong(tmp_path, text, message):
    file = tmp_path / "features.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_features(file, "mm", 0.5)


def test_lengths_come_into_the_unit_of_the_run(tmp_path):
    file = tmp_path / "features.toml"
    file.write_text(
        'length_unit = "m"\n[frame]\npose = [[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n'
        '[[feature]]\nkind = "sphere"\nat = [0.1, 0, 0]\ndiameter = 0.03\ntolerance = [-1e-4, 2e-4]\n'
    )
    feature = read_features(file, "mm", 0.5).features[0]
    assert feature.at == pytest.approx([1000, 100, 0]) and feature.size == pytest.approx(30)
    assert feature.tolerance == pytest.approx((-0.1, 0.2))


def test_a_feature_that_nobody_saw_is_named_and_the_others_stand(cell):
    document = tomllib.loads((cell / "artefact" / "artefact.toml").read_text())
    document["feature"][0]["at"] = [900.0, 0.0, 0.0]
    document["limits"]["size"] = 0.15
    (cell / "unseen.toml").write_text(tomli_w.dumps(document))
    code, unseen = _verify(cell, cell / "unseen.toml")
    assert code == 3 and unseen["passed"] is None and len(unseen["numbers"]) == 10
    assert set(unseen["not_measured"]) == {"ball 1", *(f"distance {k}-1" for k in (2, 3, 4, 5))}
    write_certificate(unseen, cell / "unseen.html")
    assert "Not measured" in (cell / "unseen.html").read_text(encoding="utf-8")
    assert "Not measured: ball 1" in unseen["sentence"]
