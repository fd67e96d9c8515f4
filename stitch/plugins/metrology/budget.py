"""The numbers of features with U, their correlations, and which source brings how much of it (JCGM 100).

All numbers of a run answer to the same sources, so their covariance is one matrix: a distance is better known than its
ends where what moves both is the same.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial import cKDTree

from stitch.errors import NoResultError
from stitch.numerics.frames import Array
from stitch.plugins.metrology.error_sources import NOT_INCLUDED
from stitch.plugins.metrology.feature_file import Contribution, FeatureList
from stitch.plugins.metrology.features import NUMBERS, Feature, FittedFeature, fit_feature, position_of, reach_of
from stitch.plugins.metrology.place_errors import ErrorSource, PlaceErrors, RunPoints, twist_slopes
from stitch.plugins.watch.dfq_file import Characteristic
from stitch.system.values import Table

# The variances are posterior means, which hold already that they are not well known: twice their root covers 95 %
# whatever the degrees of freedom. These are told for who compares with a factor of Student's t.
COVERAGE_FACTOR = 2.0
OWN_NOISE = "noise of the feature's own points"
# Points of a feature that a trial fits; what views share does not average out among them.
_TRIAL_POINTS = 300
_TRIAL_BLOCK = 200
# Features of which nothing is measured along the axis: a coordinate within 6° of it would have a tenth of the U across.
AXIAL, _ALONG_AXIS = ("cylinder", "circle"), 0.995
MEASURE_FORMAT = "stitch-measure/1"


@dataclass(frozen=True)
class Number:
    """One number of a feature; lengths in length_unit, slopes in rad."""

    feature: Feature
    quantity: str
    unit: str
    value: float
    nominal: float
    u: float  # standard uncertainty
    degrees: float  # effective degrees of freedom (Welch 1947; Satterthwaite 1946)
    shares: dict[str, float]  # of every source in the variance; they add up to 1
    points: int  # that count
    form: float  # width of the band of 95 % of the residuals; NaN of a distance

    @property
    def name(self) -> str:
        """Feature and quantity."""
        return f"{self.feature.name}.{self.quantity}"

    @property
    def U(self) -> float:
        """Expanded uncertainty, coverage about 95 %."""
        return COVERAGE_FACTOR * self.u

    @property
    def limits(self) -> tuple[float, float] | None:
        """Of the value, where its feature has a tolerance and this is the number that it is of."""
        tolerance = self.feature.tolerance
        if tolerance is None or self.quantity != NUMBERS[self.feature.kind][0]:
            return None
        return self.nominal + tolerance[0], self.nominal + tolerance[1]

    @property
    def conforms(self) -> bool | None:
        """Whether it lies within its limits by more than U, beyond them by more than U (ISO 14253-1), or neither."""
        if self.limits is None:
            return None
        low, high = self.limits
        if low + self.U <= self.value <= high - self.U:
            return True
        return False if self.value < low - self.U or self.value > high + self.U else None


@dataclass(frozen=True, eq=False)
class MeasuredFeatures(Table, document="stitch.plugins.metrology.budget:measure_document", table="numbers"):
    """Numbers (Q) of the features of one run, with what is known of all of them together.

    Example:
        >>> at = run.stitched.points[len(run.stitched) // 2]
        >>> patch = stitch.Feature("patch", "plane", at=at, axis=run.stitched.normals[len(run.stitched) // 2])
        >>> measured = stitch.measure(run, [patch])
        >>> [number.quantity for number in measured.numbers]
        ['offset', 'slope_u', 'slope_v']
    """

    numbers: tuple[Number, ...]
    covariance: Array  # (Q, Q)
    fits: tuple[FittedFeature, ...]  # of all features but distances
    length_unit: str
    not_measured: dict[str, str] = field(default_factory=dict)  # features without numbers, and why
    T_datum_reference: Array | None = None  # (4, 4) from the run's reference frame into that of its datum
    checked: "MonteCarlo | None" = None  # trials that were drawn of all sources

    @property
    def correlation(self) -> Array:
        """(Q, Q)."""
        sigma = np.maximum(np.sqrt(np.diag(self.covariance)), 1e-300)
        return self.covariance / np.outer(sigma, sigma)


def measure_features(places: PlaceErrors, wanted: FeatureList) -> MeasuredFeatures:
    """Fit features to the points of a run; those on which too few points lie are named, and the others stand.

    Raises:
        NoResultError: too few points lie on each of them.
    """
    fits, not_measured = fit_features(places.points, wanted.features)
    if not fits:
        raise NoResultError(next(iter(not_measured.values())))
    for feature in wanted.features:
        if feature.kind == "distance" and (missing := not_measured.keys() & set(feature.between)):
            not_measured[feature.name] = f"{feature.name}: {', '.join(sorted(missing))} was not measured"
        elif feature.kind == "distance" and (of := _runs_along_axis(feature, fits)):
            not_measured[feature.name] = (
                f"{feature.name}: runs along the axis of {of}, where its centre is not measured; "
                "to fix: measure it between planes, spheres or points"
            )
    measured = replace(wanted, features=tuple(f for f in wanted.features if f.name not in not_measured))
    return replace(evaluate(places, measured, fits), not_measured=not_measured)


def fit_features(points: RunPoints, features: Sequence[Feature]) -> tuple[tuple[FittedFeature, ...], dict[str, str]]:
    """Return the fits of features but distances, and by name why others have none: too few points lie there."""
    tree = cKDTree(points.points, balanced_tree=False, compact_nodes=False)
    fits = []
    not_measured = dict[str, str]()
    for feature in features:
        if feature.kind == "distance":
            continue
        near = np.sort(np.array(tree.query_ball_point(feature.at, reach_of(feature)), np.int64))
        try:
            fits.append(fit_feature(feature, points, near))
        except NoResultError as error:
            not_measured[feature.name] = str(error)
    return tuple(fits), not_measured


def evaluate(places: PlaceErrors, wanted: FeatureList, fits: Sequence[FittedFeature]) -> MeasuredFeatures:
    """Return the numbers of fits and of distances between them, under all that may be wrong about the places."""
    quantities, values, nominal, slopes = number_table(wanted.features, fits)
    aligned = free_of_datum(slopes, fits, places.centre, datum_rows(quantities, wanted.datum))
    slopes = aligned @ slopes
    counted = replace(places, sources=_not_stated(places, wanted))
    of_fits = [counted.loadings(fit.at, fit.gradient) for fit in fits]
    own = [fit.slopes * fit.noise for fit in fits]
    variances, vectors = np.linalg.eigh(block_diag(*(by_point @ by_point.T for by_point in own)))
    ends = np.cumsum([source.views.shape[1] for source in counted.sources])[:-1]
    of_sources = np.split(slopes @ np.vstack(of_fits), ends, axis=1)
    rows = [(s.name, loadings, s.degrees) for s, loadings in zip(counted.sources, of_sources, strict=True)]
    rows.append((OWN_NOISE, slopes @ (vectors * np.sqrt(np.maximum(variances, 0.0))), np.inf))
    rows += [(c.source, aligned @ _stated_loadings(c, quantities, values), c.degrees) for c in wanted.contributions]
    covariance = np.sum([loadings @ loadings.T for _, loadings, _ in rows], axis=0)
    by_fit = {fit.feature.name: fit for fit in fits}
    length_unit = places.measurement.length_unit
    numbers = []
    kept = measured_rows(quantities)
    for q in kept:
        feature, quantity = quantities[q]
        squares = np.array([loadings[q] @ loadings[q] for _, loadings, _ in rows])
        total = max(squares.sum(), 1e-300)
        shares = dict.fromkeys((name for name, _, _ in rows), 0.0)
        for (name, _, _), square in zip(rows, squares, strict=True):
            shares[name] += float(square / total)
        spread = np.sum(squares**2 / np.array([degrees for _, _, degrees in rows]))
        fit = by_fit.get(feature.name)
        numbers.append(
            Number(
                feature=feature,
                quantity=quantity,
                unit="rad" if quantity.startswith("slope") else length_unit,
                value=float(values[q]),
                nominal=float(nominal[q]),
                u=float(np.sqrt(squares.sum())),
                degrees=float(total**2 / spread) if spread > 0 else np.inf,
                shares=dict(sorted(shares.items(), key=lambda item: -item[1])),
                points=0 if fit is None else len(fit.residual),
                form=float("nan") if fit is None else fit.form,
            )
        )
    return MeasuredFeatures(tuple(numbers), covariance[np.ix_(kept, kept)], tuple(fits), length_unit)


def _not_stated(places: PlaceErrors, wanted: FeatureList) -> tuple[ErrorSource, ...]:
    """Return the sources that count: what is stated under the name of one takes the place of what is usual."""
    stated = {contribution.source for contribution in wanted.contributions}
    return tuple(source for source in places.sources if source.name not in stated)


def measured_rows(quantities: Sequence[tuple[Feature, str]]) -> list[int]:
    """Return which numbers are measured: all but the coordinate along which a cylinder's or circle's axis runs."""
    return [
        q
        for q, (feature, quantity) in enumerate(quantities)
        if feature.kind not in AXIAL or quantity == "diameter" or abs(feature.axis["xyz".index(quantity)]) < _ALONG_AXIS
    ]


def _runs_along_axis(feature: Feature, fits: Sequence[FittedFeature]) -> str | None:
    """Return the cylinder or circle along whose axis a distance runs; None where both ends are measured across."""
    ends = [fit for name in feature.between for fit in fits if fit.feature.name == name]
    plane = next((fit for fit in ends if fit.feature.kind == "plane"), None)
    if plane is not None:
        along = plane.feature.axis
    else:
        along = position_of(ends[0].feature, ends[0].values) - position_of(ends[1].feature, ends[1].values)
        along /= max(float(np.linalg.norm(along)), 1e-300)
    axial = (fit.feature for fit in ends if fit.feature.kind in AXIAL)
    return next((f.name for f in axial if abs(f.axis @ along) > _ALONG_AXIS), None)


def number_table(
    features: Sequence[Feature], fits: Sequence[FittedFeature]
) -> tuple[list[tuple[Feature, str]], Array, Array, Array]:
    """Return all numbers in the order of the features: what each is, values (Q,), nominal values (Q,), and slopes
    (Q, B) in the B numbers of all fits."""
    start = dict(zip([f.feature.name for f in fits], np.cumsum([0, *(len(f.values) for f in fits)]), strict=False))
    by_name = {fit.feature.name: fit for fit in fits}
    width = sum(len(fit.values) for fit in fits)
    quantities = list[tuple[Feature, str]]()
    values = list[float]()
    nominal = list[float]()
    slopes = list[Array]()
    for feature in features:
        row = np.zeros((len(NUMBERS[feature.kind]), width))
        quantities += [(feature, quantity) for quantity in NUMBERS[feature.kind]]
        if feature.kind == "distance":
            a, b = (by_name[name] for name in feature.between)
            distance, of_a, of_b = _distance_slopes(a, b)
            row[0, start[a.feature.name] :][: len(of_a)] = of_a
            row[0, start[b.feature.name] :][: len(of_b)] = of_b
            as_placed = distance_between(a.feature, _nominal_values(a.feature), b.feature, _nominal_values(b.feature))
            values.append(distance)
            nominal.append(float(as_placed) if feature.nominal is None else feature.nominal)
        else:
            fit = by_name[feature.name]
            row[:, start[feature.name] :][:, : len(fit.values)] = np.eye(len(fit.values))
            values += fit.values.tolist()
            nominal += _nominal_values(feature).tolist()
        slopes.append(row)
    return quantities, np.array(values), np.array(nominal), np.vstack(slopes)


def _nominal_values(feature: Feature) -> Array:
    """(q,) of a feature as it should be."""
    if "x" in NUMBERS[feature.kind]:
        return np.append(feature.size, feature.at)
    return np.zeros(len(NUMBERS[feature.kind]))


def distance_between(a: Feature, of_a: Array, b: Feature, of_b: Array) -> Array:
    """Return the distance (...,) of two features with numbers (..., q): of centres, or of a place from a plane."""
    if a.kind == "plane" and b.kind != "plane":
        return distance_between(b, of_b, a, of_a)
    if b.kind != "plane":
        return np.linalg.norm(position_of(a, of_a) - position_of(b, of_b), axis=-1)
    x, y, z = np.moveaxis((position_of(a, of_a) - b.at) @ b.R, -1, 0)
    h, su, sv = np.moveaxis(of_b, -1, 0)
    return np.abs(z - h - su * x - sv * y) / np.sqrt(1 + su**2 + sv**2)


def datum_rows(quantities: Sequence[tuple[Feature, str]], datum: Sequence[str]) -> list[int]:
    """Return where the numbers of a datum stand among all."""
    names = [f"{feature.name}.{quantity}" for feature, quantity in quantities]
    return [names.index(number) for number in datum]


def free_of_datum(slopes: Array, fits: Sequence[FittedFeature], centre: Array, rows: Sequence[int]) -> Array:
    """Return what is left (Q, Q) of changes of numbers where six of them, the rows of a datum, stay nominal.

    The part is moved back by what the six change: 1 − M·M_d⁻¹·P_d, with the answers M (Q, 6) to a motion.
    """
    left = np.eye(len(slopes))
    if rows:
        motions = answers_to_motion(slopes, fits, centre)
        left[:, rows] -= motions @ np.linalg.inv(motions[rows])
        left[rows] = 0.0
    return left


def answers_to_motion(slopes: Array, fits: Sequence[FittedFeature], centre: Array) -> Array:
    """Return the change (Q, 6) of numbers with a motion of the part about a centre (3,): turn in rad, then shift."""
    return slopes @ np.vstack([twist_slopes(fit.at.points - centre, fit.gradient) for fit in fits])


def _distance_slopes(a: FittedFeature, b: FittedFeature) -> tuple[float, Array, Array]:
    """The distance of two fits, and its slopes in the numbers of either."""
    if a.feature.kind == "plane" and b.feature.kind != "plane":
        distance, of_b, of_a = _distance_slopes(b, a)
        return distance, of_a, of_b
    distance = float(distance_between(a.feature, a.values, b.feature, b.values))
    if b.feature.kind != "plane":
        e = position_of(a.feature, a.values) - position_of(b.feature, b.values)
        e /= max(distance, 1e-300)
        return distance, e @ a.position_slopes, -e @ b.position_slopes
    x, y, z = (position_of(a.feature, a.values) - b.feature.at) @ b.feature.R
    h, su, sv = b.values
    sign = np.sign(z - h - su * x - sv * y) / np.sqrt(1 + su**2 + sv**2)
    return distance, sign * (b.feature.R @ [-su, -sv, 1.0]) @ a.position_slopes, -sign * np.array([1.0, x, y])


def _stated_loadings(stated: Contribution, quantities: Sequence[tuple[Feature, str]], values: Array) -> Array:
    """(Q, ·) what a stated contribution does to the numbers: a relative one to all lengths together."""
    lengths = np.array([quantity in ("distance", "diameter") for _, quantity in quantities])
    each = np.array([stated.length * (not quantity.startswith("slope")) for _, quantity in quantities])
    return np.column_stack([stated.relative * values * lengths, np.diag(each)])


@dataclass(frozen=True)
class MonteCarlo:
    """Trials beside the linear propagation of the same fits, to at most so many points of each feature."""

    trials: int
    ratio: Array  # (Q,) of their standard deviation over u by the slopes; its own standard deviation is 1/√(2 · trials)


def monte_carlo(places: PlaceErrors, wanted: FeatureList, fits: Sequence[FittedFeature], trials: int) -> MonteCarlo:
    """Return what trials say of the numbers of some fits; nothing of the slopes of the fits is used."""
    rng = np.random.default_rng(0)
    thin = [fit.thinned(_TRIAL_POINTS) for fit in fits]
    linear = evaluate(places, wanted, thin)
    modes = [(s, rng.standard_normal((s.views.shape[1], trials))) for s in _not_stated(places, wanted)]
    by_feature = {fit.feature.name: (fit.feature, _refits(places, fit, modes, trials, rng)) for fit in thin}
    quantities, values, _, slopes = number_table(wanted.features, thin)
    aligned = free_of_datum(slopes, thin, places.centre, datum_rows(quantities, wanted.datum))
    columns = list[Array]()
    for feature in wanted.features:
        if feature.kind == "distance":
            (a, of_a), (b, of_b) = (by_feature[name] for name in feature.between)
            columns.append(distance_between(a, of_a, b, of_b)[:, None])
        else:
            columns.append(by_feature[feature.name][1])
    drawn = np.hstack(columns)
    for stated in wanted.contributions:
        loadings = _stated_loadings(stated, quantities, values)
        drawn = drawn + rng.standard_normal((trials, loadings.shape[1])) @ loadings.T
    kept = measured_rows(quantities)
    drawn = drawn @ aligned.T
    return MonteCarlo(trials, drawn[:, kept].std(axis=0, ddof=1) / [max(n.u, 1e-300) for n in linear.numbers])


def _refits(
    places: PlaceErrors,
    fit: FittedFeature,
    modes: Sequence[tuple[ErrorSource, Array]],
    trials: int,
    rng: np.random.Generator,
) -> Array:
    """(M, q) numbers of a feature from its points as M trials move them."""
    twists = np.sum([s.views @ drawn for s, drawn in modes], axis=0).T
    of_points = np.sum([s.shapes @ drawn for s, drawn in modes], axis=0).T
    shapes = places.point_shapes(fit.at)
    noise = fit.noise[:, None] * fit.normal
    own = [(drawn, places.scan_shapes(fit.at, s.scan)) for s, drawn in modes if s.scan is not None]
    numbers = np.empty((trials, len(fit.values)))
    for start in range(0, trials, _TRIAL_BLOCK):
        block = slice(start, min(start + _TRIAL_BLOCK, trials))
        moved = fit.at.points + np.tensordot(of_points[block], shapes, axes=1)
        for drawn, shapes_of_scan in own:
            moved += np.tensordot(drawn[:, block].T, shapes_of_scan, axes=1)
        moved += noise * rng.standard_normal((*moved.shape[:2], 1))
        numbers[block] = [fit.refit(points) for points in places.moved(fit.at, twists[block], moved)]
    return numbers


def measure_document(measured: MeasuredFeatures, run: str = "") -> dict[str, Any]:
    """Return features.json: all numbers with their budgets, and the covariance of all of them together."""
    trials = measured.checked
    ratios = [None] * len(measured.numbers) if trials is None else trials.ratio.tolist()
    return {
        "format": MEASURE_FORMAT,
        "run": run,
        "length_unit": measured.length_unit,
        "k": COVERAGE_FACTOR,
        "numbers": [_number(n, ratio) for n, ratio in zip(measured.numbers, ratios, strict=True)],
        "covariance": {"numbers": [n.name for n in measured.numbers], "matrix": measured.covariance.tolist()},
        "T_datum_reference": None if (T := measured.T_datum_reference) is None else T.tolist(),
        "trials": None if trials is None else trials.trials,
        "not_measured": measured.not_measured,
        "not_included": list(NOT_INCLUDED),
    }


def _number(n: Number, ratio: float | None) -> dict[str, Any]:
    return {
        "feature": n.feature.name,
        "kind": n.feature.kind,
        "at": None if n.feature.kind == "distance" else n.feature.at.tolist(),
        "normal": n.feature.axis.tolist() if n.feature.kind in ("point", "plane", "deviation") else None,
        **{key: getattr(n, key) for key in ("quantity", "unit", "value", "nominal", "u", "U", "conforms", "points")},
        "degrees_of_freedom": n.degrees,
        "limits": None if n.limits is None else list(n.limits),
        "form_95": n.form,
        "budget": [
            {"source": source, "variance_share": share, "u": n.u * float(np.sqrt(share)), "unit": n.unit}
            for source, share in n.shares.items()
        ],
        "monte_carlo_over_propagation": ratio,
    }


def measure_csv(measured: MeasuredFeatures) -> str:
    """Return a table with a row a number: a column a source, its standard uncertainty in the number's unit, and a
    column a number, the covariance with that in the product of both units."""
    sources = sorted({source for n in measured.numbers for source in n.shares})
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n")
    columns = "feature kind quantity unit value nominal u k U degrees_of_freedom lower upper conforms points form_95"
    write.writerow(
        [*columns.split(), *(f"u: {source}" for source in sources), *(f"cov: {n.name}" for n in measured.numbers)]
    )
    for n, covariance in zip(measured.numbers, measured.covariance, strict=True):
        limits = n.limits or ("", "")
        conforms = {True: "yes", False: "no", None: "open" if n.limits else ""}[n.conforms]
        numbers = [_text(x) for x in (n.value, n.nominal, n.u, COVERAGE_FACTOR, n.U, n.degrees)]
        head = [n.feature.name, n.feature.kind, n.quantity, n.unit, *numbers, *map(_text, limits), conforms, n.points]
        by_source = [n.u * np.sqrt(n.shares.get(s, 0.0)) for s in sources]
        write.writerow([*head, *map(_text, (n.form, *by_source, *covariance))])
    return out.getvalue()


def _text(x: float | str) -> str:
    """A number with nine digits; empty where there is none."""
    return x if isinstance(x, str) else "" if not np.isfinite(x) else f"{x:.9g}"


def characteristics(measured: MeasuredFeatures) -> list[Characteristic]:
    """Return what a DFQ file says of the numbers."""
    return [Characteristic(n.name, n.unit, n.nominal, *(n.limits or (np.nan, np.nan))) for n in measured.numbers]
