"""The dictionary of systematic laws: whatever is known of the views, at every place where it could act.

A name is worth no more than what it is compared with, and a library is a poor rival of itself. So an effect is held
against all that views may follow: every column of views.csv, time or view order, angle, last move and torque of every
joint, its approach, a step from some view on or as gravity falls to the other side of what hangs at the flange. Each
may move what the reference carries (the part, and the base of an arm whose base is the reference), what stands at the
far end of the arm, any one joint, or the length of one link, which follows no angle; as a line or smoothly; in all six
numbers, as a turn or a shift, or along or about one axis.

A place and what it follows are one law, each as likely before as any other; its forms share that. All forms are sized
at the variances of the model, the likeliest few with all variances anew (`score.try_form`), as effects are.

A law that an effect of the library or of a user says too is no rival of it: it is that effect, by its name. What turns
the first joint turns the base about its axis, and the last one what the flange carries; they are one place. So is a
link whose growth moves part or base as a whole.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Candidate, Form
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import Score, try_form
from stitch.effects.contract import EFFECTS, Effect, Parameter, per_joint
from stitch.model.forward import pose_derivatives
from stitch.model.model import Term, term_of
from stitch.numerics import frames
from stitch.numerics.distributions import f_limits
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import column_space
from stitch.observations.linear_model import LinearModel, Observation
from stitch.observations.pose_errors import usual_twist
from stitch.session.measurement import TEMPERATURES, Views
from stitch.session.robot import Links

TIME = "time_s"
# Waves along a joint's angle, and how many there are a turn.
_WAVES = {
    "a wave, once a turn": 1,
    "a wave, twice a turn": 2,
    "a wave, three times a turn": 3,
    "a wave, four times a turn": 4,
}
# What views follow in their order: a step from some view on, or where no time is stated a trend.
STEP = "view order"
NUMBER = "view number"
# To which side of what it holds it falls.
GRAVITY = "gravity"
# Degree of a smooth function of a covariate; each power usually half as large as the one before.
_DEGREE = 3
# Views at an end that make a step; steps that are tried at the most, and laws and forms whose variances are fitted anew
# (time).
_VIEWS_AT_END, _MOST_STEPS = 2, 50
_LAWS_FITTED, _FORMS_FITTED = 6, 12
# Nats by which places may come nearer to the likeliest once variances are fitted anew.
_NEAR_BEFORE = 2.0
# Two columns of which this share is common are one.
_SAME = 0.999
_SAME_VALUE = 1e-9
# Directions of the flange to whose other side gravity may drop what hangs there with play.
_ACROSS = np.array([[1, 0, 0], [1, 1, 0], [0, 1, 0], [-1, 1, 0], [0, 0, 1]])
_FALLS = ("along x", "between x and y", "along y", "between y and -x", "along z")
# What friction holds of the weight, steel on steel.
_FRICTION = 0.2
_BODIES = ("part", "mount")
_NOT_LINKS = (*_BODIES, "robot")
# A joint that turns less (rad) follows nothing of its own angle.
_STILL = np.radians(2.0)
# What is usual of a joint (rad); of a flange `usual_twist` says it.
_JOINT = 4e-4
# The same of a link's lengths: steel by 17 °C.
_GROWN = 2e-4
# Share of a law by which a link's length follows anything but warmth and time (judgement).
_SELDOM_GROWS = 0.1
# Draws of what chance makes of the clearest law, their seed; by-count chances beyond which none is clear, and numbers
# among which there is no time to draw.
_DRAWS, _SEED = 499, 20
_DRAWN_UP_TO, _MOST_DRAWN = 1.0, 400


def _grow(links: Links, views: Views, g: Array) -> Links:
    """DH lengths of row i ×(1+g_i)"""
    return replace(links, lengths=links.lengths * (1 + g))


_LENGTHS = Effect("lengths", "links", {"g": per_joint("1", _GROWN, 1.0)}, _grow, needs=(), prefers=(), tier="empirical")


@dataclass(frozen=True, eq=False)
class Driver:
    """What views may follow."""

    name: str  # a column of views.csv, time, view order, angle of joint 3, view (a step)
    unit: str
    values: Array  # (V,)
    shapes: dict[str, Array]  # in words: (V, R), nought where the law is none yet, 1 at the most
    joint: int | None = None  # the one that alone may follow it, counted from 1
    kinds: tuple[str, ...] = ("part", "mount", "robot", "links")  # of places that may

    @property
    def covariate(self) -> str:
        """What is followed, in whatever shape: short waves of j5_deg are j5_deg."""
        return self.name.partition(",")[0]


@dataclass(frozen=True, eq=False)
class Place:
    """Where a law acts."""

    name: str  # joint 3, link 2, or all that moves alike: the part or the base
    twists: Array  # (V, 6, k) of the views about the observation's centre, per rad and length_unit
    sizes: Array  # (k,) that are usual
    whole: Indices  # all that is independent of these; the others are further axes
    units: tuple[str, ...]  # rad, or length_unit
    joint: int | None = None  # counted from 1
    kind: str = "robot"  # place of effects that act there: robot, links, part, mount

    @property
    def with_base(self) -> bool:
        """True where the base is told too, since it moves alike."""
        return "base" in self.name


@dataclass(frozen=True, eq=False)
class Law:
    """A place that follows something, in one form."""

    place: Place
    driver: Driver
    shape: str  # of those of the driver
    columns: Indices  # of the place's that it has
    centred: bool = False  # nought on average over the views, and not where the driver stands at first

    @property
    def key(self) -> tuple[str, str]:
        """What tells laws from each other, whatever their form."""
        return self.place.name, self.driver.name

    @property
    def is_whole(self) -> bool:
        """True for all six numbers, or a joint that counts from where its driver stands at first."""
        return self.columns is self.place.whole and not self.centred

    @cached_property
    def shapes(self) -> Array:
        """(V, R) of the views."""
        shapes = self.driver.shapes[self.shape]
        return shapes - shapes.mean(axis=0) if self.centred else shapes

    @cached_property
    def sizes(self) -> Array:
        """(k·R,) usual sizes."""
        return np.outer(self.place.sizes[self.columns], 0.5 ** np.arange(self.shapes.shape[1])).ravel()

    @property
    def among(self) -> Indices:
        """(k·R,) which of the columns of all axes of the place are its own."""
        shapes = self.shapes.shape[1]
        return (shapes * self.columns[:, None] + np.arange(shapes)).ravel()

    def reduced(self, observation: Observation) -> Array:
        """(n, k·R) columns of the reduced observations."""
        moved = self.place.twists[:, :, self.columns, None] * self.shapes[:, None, None, :]
        return observation.from_twists(moved.reshape(6 * len(moved), -1))

    @property
    def in_part_of_a_wave(self) -> bool:
        """True where the driven range holds no whole period: how many a turn has is not known."""
        periods = _WAVES.get(self.shape)
        return periods is not None and periods * float(np.ptp(self.driver.values)) < 360

    @property
    def words(self) -> str:
        """Joint 3 follows ambient_c (a line); the part sits displaced from view v010 on."""
        if self.driver.name == STEP:
            verb = "is off" if self.place.kind in ("robot", "links") else "sits displaced"
            return f"{self.place.name} {verb} from {self.shape.removeprefix('a step at ')} on"
        return f"{self.place.name} follows {self.driver.name} ({self.shape})"


@dataclass(frozen=True)
class Dictionary:
    """All laws that views can show, and the prior share of each form of its law."""

    laws: tuple[Law, ...]
    shares: Array  # (L,)
    said_by: dict[tuple[str, str], frozenset[str]]  # of each law, the effects that say it
    observation: Observation

    def credited(self, effect: Ranked, laws: Sequence[Ranked]) -> Ranked:
        """Return an effect with the evidence of the law that it says, which may be of one axis where it has six.

        A law has several shapes, of which an effect may say one: a wave twice a turn is none once a turn. And it is of
        one joint, which an effect does not tell before: of so many joints, each alone or all together.
        """
        whole = _whole_forms(effect.score.candidate)
        joints = sum(place is not None for place in {law.place.joint for law in self.laws})
        said = [
            r.score.log_bayes_factor - (float(np.log(2 * joints)) if law_of(r).place.joint else 0.0)
            for r in laws
            if effect.name in self.said_by[law_of(r).key]
            and any(form.contains(Span(r.score.form.columns)) for form in whole)
        ]
        more = max([0.0, *(factor - effect.score.log_bayes_factor for factor in said)])
        return replace(effect, log_posterior=effect.log_posterior + more)

    @cached_property
    def numbers(self) -> dict[tuple[str, str], list[int]]:
        """Numbers of the forms of each law that is told from the others."""
        numbers: dict[tuple[str, str], list[int]] = {key: [] for key in self.said_by}
        for i, law in enumerate(self.laws):
            numbers[law.key].append(i)
        return numbers

    @cached_property
    def stacks(self) -> list[tuple[Place, Array, Indices]]:
        """All laws as `stacked`."""
        return list(stacked(self.laws))

    def without(self, linear: LinearModel, laws: Sequence[Ranked], effect: Ranked) -> tuple[Ranked, ...]:
        """Return the laws that are something else than an effect: it does not say them, nor are they it in these views.

        There, a law of the effect's own place is the effect where its columns are combinations of the effect's.
        """
        rivals = [r for r in laws if effect.name not in self.said_by[law_of(r).key]]
        place = effect.score.candidate.effect.place
        explained = Span(linear.residual(effect.score.form.columns))
        return tuple(
            r
            for r in rivals
            if law_of(r).place.joint is not None
            or law_of(r).place.kind != place
            or law_of(r).driver.name == GRAVITY
            or not explained.contains(Span(linear.residual(r.score.form.columns)))
        )


def dictionary_of(linear: LinearModel, candidates: Sequence[Candidate] = ()) -> Dictionary:
    """Return the laws of a session, and which of the candidates says each."""
    laws, shares, said_by = list[Law](), list[float](), dict[tuple[str, str], frozenset[str]]()
    views = linear.measurement.views
    drivers = list(drivers_of(views))
    effects = [(c, _whole_forms(c)) for c in candidates if not c.empirical]
    for place in _places(linear):
        for driver in drivers:
            if driver.joint not in (None, place.joint) or place.kind not in driver.kinds:
                continue
            forms = list(_forms(place, driver))
            laws += [law for law, _ in forms]
            shares += [share for _, share in forms]
            # Mostly words tell: what the columns say is asked of few.
            spans = cache(partial(_spans, place, driver, linear.observation))
            said = (c.name for c, forms in effects if _says(views, c, forms, place, driver, spans))
            said_by[place.name, driver.name] = frozenset(said)
    return Dictionary(tuple(laws), np.array(shares), said_by, linear.observation)


def stacked(laws: Sequence[Law]) -> Iterator[tuple[Place, Array, Indices]]:
    """Yield laws with the same place and number R of shape columns together, so that their sums are computed at once.

    Each item is the place, shapes (S, V, R) of S laws over V views, and indices (S, F) in `laws` of their F forms: one
    for each choice of the place's axes, all of them first.
    """
    alike: dict[tuple[str, int], list[int]] = {}
    for i, law in enumerate(laws):
        alike.setdefault((law.place.name, law.shapes.shape[1]), []).append(i)
    for numbers in alike.values():
        shapes = [laws[i].shapes for i in numbers if laws[i].columns is laws[i].place.whole]
        yield laws[numbers[0]].place, np.array(shapes), np.reshape(numbers, (len(shapes), -1))


def rank_laws(linear: LinearModel, dictionary: Dictionary) -> tuple[Ranked, ...]:
    """Return the likeliest laws beside a model, best first, with their log posterior as that of effects (`Ranked`)."""
    laws = dictionary.laws
    if not laws:
        return ()
    starts = (linear, *linear.alternative_starts)
    gains, scales, p_value = np.full(len(laws), -np.inf), np.ones(len(laws)), 1.0
    best_start = np.zeros(len(laws), np.int64)
    for k, at in enumerate(starts):
        tried, scale = _gains(at, dictionary)
        tried = tried + 0.5 * (linear.null.deviance - at.null.deviance)
        better = tried > gains
        gains, scales = np.where(better, tried, gains), np.where(better, scale, scales)
        best_start[better] = k
    weighted = gains + np.log(dictionary.shares)
    by_key = dictionary.numbers
    order = sorted(by_key, key=lambda key: -np.logaddexp.reduce(weighted[by_key[key]]))
    likeliest = order[:_LAWS_FITTED]
    if weighted.max() > limits.LOG_BAYES_FACTOR:
        # Where it acts is told too: of every place that may be the one, its likeliest.
        of_places = {place: key for key in reversed(order) for place in key[:1]}
        near = weighted.max() - limits.ODDS - _NEAR_BEFORE
        likeliest += [key for key in of_places.values() if key not in likeliest and weighted[by_key[key]].max() > near]
    prior = float(np.log(limits.PRIOR_LAWS / len(by_key)))
    ranked = list[Ranked]()
    for key in likeliest:
        among = sorted(by_key[key], key=lambda i: -weighted[i])
        fits = dict[int, tuple[Candidate, Score]]()
        for i in among[: _FORMS_FITTED // _LAWS_FITTED]:
            fits[i] = _fitted(linear, laws[i], starts[best_start[i]].null.variances, float(scales[i]))
            weighted[i] = fits[i][1].log_bayes_factor + np.log(dictionary.shares[i])
        best = max(fits, key=lambda i: weighted[i])
        total = float(logsumexp(weighted[among]))
        scored = fits[best][1]
        p_value = scored.p_value / float(dictionary.shares[best]) * len(by_key)
        ranked.append(Ranked(replace(scored, log_bayes_factor=total), p_value, total + prior, 0.0, len(by_key)))
    ranked.sort(key=lambda r: -r.log_posterior)
    first, *others = ranked
    others = [replace(r, adjusted=min(r.adjusted, 1.0)) for r in others]
    return replace(first, adjusted=_family_wise(linear, dictionary, first)), *others


def _family_wise(linear: LinearModel, dictionary: Dictionary, ranked: Ranked) -> float:
    """Return the family-wise p-value of the clearest law: the chance that any law looks as clear in mere scatter.

    Bonferroni's value is too large, since laws resemble each other. Where it does not decide by itself, residuals are
    drawn at random `_DRAWS` times, and the draws counted in which some law is as clear (Monte Carlo test).

    Args:
        ranked: the law, with Bonferroni's value in `adjusted`.
    """
    by_count = ranked.adjusted
    if by_count < limits.ALPHA_UNKNOWN or by_count > _DRAWN_UP_TO or linear.mixed.z.size > _MOST_DRAWN:
        return min(by_count, 1.0)
    rng = np.random.default_rng(_SEED)
    known = linear.mixed.size - linear.design.shape[1]
    drawn = rng.standard_normal((linear.mixed.z.size, _DRAWS)) / np.sqrt(rng.chisquare(known, _DRAWS) / known)
    by_rank: dict[int, list[tuple[Array, float]]] = {}
    for law, share in zip(dictionary.laws, dictionary.shares, strict=True):
        U = column_space(linear.residual(law.reduced(linear.observation)))
        by_rank.setdefault(U.shape[1], []).append((U, share))
    as_clear = np.zeros(_DRAWS, bool)
    for rank, laws in by_rank.items():
        if not rank:
            continue
        least = np.array([by_count * share for _, share in laws]) / len(dictionary.numbers)
        limit = rank * f_limits(np.minimum(least, 1.0), rank, known)
        squares = (np.hstack([U for U, _ in laws]).T @ drawn) ** 2
        as_clear |= (squares.reshape(len(laws), rank, -1).sum(axis=1) >= limit[:, None]).any(axis=0)
    return float((1 + as_clear.sum()) / (1 + _DRAWS))


def laws_of_base(
    linear: LinearModel, dictionary: Dictionary, laws: Sequence[Ranked], effect: Score | None = None
) -> tuple[Ranked, ...]:
    """Return laws of the base that explain the views as a joint's law among some laws does, each as likely as that one.

    Args:
        dictionary: all laws that were tried.
        laws: the ranked ones, of which those of joints are asked.
        effect: the score of the joint's effect; None: as each law was fitted.
    """
    of_base = list[Ranked]()
    for ranked in laws:
        law, scored = law_of(ranked), effect or ranked.score
        if law.place.joint is None or law.place.with_base:
            continue
        if not could_be_base(linear, scored.form.columns @ scored.values, law.shapes):
            continue
        follows = (law.driver.name, law.shape)
        for other in dictionary.laws:
            of_body = other.place.kind in _BODIES and other.place.with_base
            if of_body and other.is_whole and (other.driver.name, other.shape) == follows:
                base_score = _fitted(linear, other, linear.null.variances, 1.0)[1]
                of_base.append(replace(ranked, score=base_score))
    return tuple(of_base)


def could_be_base(linear: LinearModel, effect: Array, shapes: Array) -> bool:
    """Return whether a base that moves about fixed axes, in the course of some shapes, would explain an effect as well.

    It would where what the base leaves of the effect is small on two scales: beside the scatter, so that likelihoods
    differ by less than 20 to 1, and beside the effect itself, so that the two are aliases in these views.

    Args:
        effect: (n,) reduced observations that the effect makes.
        shapes: (V, R) courses over the views, whose sizes about the six axes are free.
    """
    # Where the scanner is carried, the base stands where the part does; where it is fixed, with the scanner.
    bodies = [twists for _, _, twists in _bodies(linear)]
    base = bodies[1] if linear.measurement.eye_to_hand else bodies[0]
    twists = (base[:, :, :, None] * shapes[:, None, None, :]).reshape(6 * len(base), -1)
    basis = column_space(linear.residual(linear.observation.from_twists(twists)))
    white = linear.residual(effect[:, None])[:, 0]
    left_square = float(np.sum((white - basis @ (basis.T @ white)) ** 2))
    alias_square = (1 - limits.ALIAS_CORRELATION**2) * float(np.sum(white**2))
    # A log likelihood is half a sum of squares.
    return left_square < min(2 * limits.ODDS, alias_square)


def law_of(ranked: Ranked) -> Law:
    """Return the law of a ranked candidate."""
    effect = ranked.score.candidate.effect
    assert isinstance(effect, LawEffect)
    return effect.law


def law_size(linear: LinearModel, ranked: Ranked) -> tuple[float, float, str]:
    """Return the size of a law with its sigma and unit: the largest change of the joint's angle, or of the views.

    The change is counted from the view with the least angle, or from the first view; views move at the part. The unit
    is rad, or the length unit.
    """
    scored = ranked.score
    law = law_of(ranked)
    if law.place.joint is not None:
        change = law.shapes - law.shapes[np.argmin(law.shapes @ scored.values)]
        farthest = change[np.argmax(np.abs(change @ scored.values))]
        unit = "rad"
    else:
        moved = np.stack([linear.observation.part_displacements(column) for column in scored.form.columns.T], axis=2)
        moved = moved - moved[0]
        k = int(np.argmax(np.linalg.norm(moved @ scored.values, axis=1)))
        along = moved[k] @ scored.values
        farthest = along / max(float(np.linalg.norm(along)), 1e-300) @ moved[k]
        unit = linear.measurement.length_unit
    sigma = float(np.sqrt(max(farthest @ scored.covariance @ farthest, 0.0)))
    return abs(float(farthest @ scored.values)), sigma, unit


@dataclass(frozen=True)
class LawEffect(Effect):
    """A law as a candidate among effects: no function of a library undoes it."""

    law: Law = None  # type: ignore[assignment]


def _fitted(linear: LinearModel, law: Law, start: Array, scale: float) -> tuple[Candidate, Score]:
    """Return a law as a candidate, and its score beside the null.

    Args:
        start: (c,) variances to begin with.
        scale: of its plausible sizes, the likeliest.
    """
    reduced = law.reduced(linear.observation)
    k = reduced.shape[1] // len(law.columns)
    units = [unit for unit in np.array(law.place.units)[law.columns] for _ in range(k)]
    parameters = tuple(
        Parameter(f"c{i}", unit, typical=float(size))
        for i, (unit, size) in enumerate(zip(units, law.sizes, strict=True))
    )
    kind = law.place.kind
    effect = LawEffect(
        law.words, kind, {}, _no_function, needs=(), prefers=(), tier="empirical", group=law.driver.name, law=law
    )
    whole = linear.observation.expand(reduced)
    form = Form(Term(effect, parameters), np.ones(len(parameters), bool), whole, reduced, law.sizes)
    candidate = Candidate(effect, (form,), whole, None)
    trial = try_form(linear, form, start, scale)
    assert trial.values is not None and trial.covariance is not None
    return candidate, Score(
        candidate,
        True,
        form,
        trial.p_value,
        trial.log_bayes_factor,
        values=trial.values,
        covariance=trial.covariance,
        scale=trial.scale,
        variances=trial.variances,
    )


def _no_function(*_: object) -> None:
    """A law of the dictionary"""


def _gains(linear: LinearModel, dictionary: Dictionary) -> tuple[Array, Array]:
    """Return log Bayes factors (L,) of all L forms at the null's variances, over all scales, and the likeliest scales.

    With eigenvalues k of the information and projections g of the vector, parameters in plausible sizes, log BF at
    scale s is ½ Σ [s² g² / (1 + s² k) − log(1 + s² k)].
    """
    scales = regime_of(linear).scales
    at = np.array(list(scales))[:, None, None, None]
    share = np.log(list(scales.values()))
    gains, likeliest = np.zeros((2, len(dictionary.laws)))
    for place, shapes, index in dictionary.stacks:
        information, vector = linear.information_of_motions(place.twists, shapes)
        forms = [dictionary.laws[i] for i in index[0]]
        for width in {len(form.columns) for form in forms}:
            numbers = [f for f, form in enumerate(forms) if len(form.columns) == width]
            among = np.array([forms[f].among for f in numbers])
            sizes = np.array([forms[f].sizes for f in numbers])
            per_size = sizes[:, :, None] * sizes[:, None, :]
            k, turned = np.linalg.eigh(information[:, among[:, :, None], among[:, None, :]] * per_size)
            g = np.einsum("sfij,sfi->sfj", turned, vector[:, among] * sizes)
            square = at**2 * np.maximum(k, 0.0)
            evidence = 0.5 * (at**2 * g**2 / (1 + square) - np.log1p(square)).sum(axis=3) + share[:, None, None]
            gains[index[:, numbers]] = logsumexp(evidence, axis=0)
            likeliest[index[:, numbers]] = at[evidence.argmax(axis=0), 0, 0, 0]
    return gains, likeliest


def _bodies(linear: LinearModel) -> Iterator[tuple[str, str, Array]]:
    """Yield the two bodies at the ends of the arm, what the reference carries and what the arm's far end does.

    Each as name, kind, and (V, 6, 6): left twists of the views about the observation's centre per unit of a twist of
    the body, which is counted in its own frame; rotation first, rad and length_unit.
    """
    measurement = linear.measurement
    to_centre = frames.make(np.eye(3), -linear.observation.centre)
    still = np.broadcast_to(np.eye(4), (measurement.views.count, 4, 4))
    if measurement.eye_to_hand:
        names = ("the part on the flange", "the scanner's stand or the base")
    else:
        names = ("the part or the base", "the scanner or its mount")
    for name, kind, carried in zip(names, _BODIES, (still, measurement.capture.T_reference_mount), strict=True):
        yield name, kind, frames.adjoint(to_centre @ carried)


def _places(linear: LinearModel) -> Iterator[Place]:
    """Yield the places where a law may act: the two bodies at the ends of the arm, each joint, and each link's length.

    A link that moves the views as a body does, or hardly at all, is no place of its own.
    """
    measurement = linear.measurement
    centre = linear.observation.centre
    count = measurement.views.count
    usual = usual_twist(measurement.length_unit)
    sizes = np.append(4 * usual, 4 * usual[:3])
    units = ("rad",) * 3 + (measurement.length_unit,) * 3 + ("rad",) * 3
    bodies = list[Array]()
    about_centre = np.broadcast_to(np.eye(6)[:, :3], (count, 6, 3))
    for name, kind, moved in _bodies(linear):
        axes = moved[:, :3, :3]
        about = np.concatenate([axes, np.zeros_like(axes)], axis=1) if kind == "mount" else about_centre
        bodies.append(moved.reshape(-1, 6))
        yield Place(name, np.concatenate([moved, about], axis=2), sizes, np.arange(6), units, kind=kind)
    if measurement.views.joints.shape[1] and measurement.robot is not None:
        terms = [term_of(measurement, effect) for effect in (EFFECTS["joint_offset"], _LENGTHS)]
        of_joints, of_links = pose_derivatives(measurement, linear.model, terms, centre)
        ends = {0: " or the base", len(of_joints) - 1: " or what the flange carries"}
        for k, (turned, grown) in enumerate(zip(of_joints, of_links, strict=True)):
            end = ends.get(k, "")
            yield Place(f"joint {k + 1}{end}", turned[..., None], np.array([_JOINT]), np.arange(1), ("rad",), k + 1)
            moves_a_body = any(Span(body).contains(Span(grown.reshape(-1, 1))) for body in bodies)
            if np.abs(grown).max() * _GROWN > usual[-1] / 10 and not moves_a_body:
                size = np.array([_GROWN])
                yield Place(f"link {k + 1}{end}", grown[..., None], size, np.arange(1), ("1",), kind="links")


def drivers_of(views: Views) -> Iterator[Driver]:
    """Yield what the error of views may depend on, with its shapes.

    These are time or order, covariates, a step at some view, angles and moves of joints, torques, and gravity.
    """
    order = np.arange(views.count, dtype=float)
    known = [(TIME, "s", views.time)] if views.has("time") else [(NUMBER, "view", order)]
    known += [(name, "", values) for name, values in views.covariates.items()]
    for name, unit, values in known:
        if np.ptp(values) > _SAME_VALUE:
            yield Driver(name, unit, values, _smooth(values))
    starts = np.arange(_VIEWS_AT_END, views.count - _VIEWS_AT_END + 1)
    picked = starts[np.unique(np.linspace(0, len(starts) - 1, min(len(starts), _MOST_STEPS)).astype(int))]
    steps = {f"a step at view {views.names[views.number[k]]}": (order >= k)[:, None].astype(float) for k in picked}
    if steps:
        yield Driver(STEP, "view", order, steps)
    for k, angle in enumerate(views.joints.T):
        if np.ptp(angle) < _STILL:
            continue
        waves = {shape: np.column_stack([np.sin(n * angle), np.cos(n * angle)]) for shape, n in _WAVES.items()}
        # Errors of a gear of one and two periods a turn have a name; those of three and four have not.
        turns, teeth = ({shape: waves[shape] for shape, n in _WAVES.items() if (n > 2) == short} for short in (0, 1))
        yield Driver(f"j{k + 1}_deg", "deg", np.degrees(angle), _smooth(angle) | turns, kinds=_NOT_LINKS)
        yield Driver(f"j{k + 1}_deg, in short waves", "deg", np.degrees(angle), teeth, k + 1)
        moves = np.degrees(angle - views.previous[:, k])
        yield from _lines(f"j{k + 1}_move_deg", "deg", moves)
        yield from _lines(f"j{k + 1}_approach", "", views.approach[:, k].astype(float))
    for name, torque in zip(views.torques.names, views.torques.values.T, strict=True):
        yield from _lines(f"j{name}_torque_nm", "N m", torque)
    for kind, gravity in (("mount", views.gravity_at_mount), ("part", views.gravity_at_part)):
        if gravity is None or np.ptp(gravity, axis=0).max() < _SAME_VALUE:
            continue
        falls = {
            f"a step as it falls {words}{held}": side[:, None].astype(float)
            for held, friction in (("", 0.0), (", held by friction", _FRICTION))
            for words, side in zip(_FALLS, _fallen(gravity @ _ACROSS.T, friction).T, strict=True)
            if _VIEWS_AT_END <= side.sum() <= views.count - _VIEWS_AT_END
        }
        if falls:
            yield Driver(GRAVITY, "g", gravity[:, 1], falls, kinds=(kind,))


def _fallen(along: Array, friction: float) -> Mask:
    """Return (V, k) True where gravity last pulled to the positive side of an axis, by more than friction holds.

    Args:
        along: (V, k) components of gravity along k axes, in the order of the views; the first view counts in any case.
        friction: component below which nothing moves.
    """
    pulled = np.abs(along) > friction
    pulled[0] = True
    last = np.maximum.accumulate(np.where(pulled, np.arange(len(along))[:, None], 0), axis=0)
    return np.take_along_axis(along, last, axis=0) > 0


def _lines(name: str, unit: str, values: Array) -> Iterator[Driver]:
    """Yield a driver with the one shape "in proportion", values over their largest size; nothing if they are constant.

    Args:
        values: (V,) of the views.
    """
    if np.ptp(values) > _SAME_VALUE * max(np.abs(values).max(), 1.0):
        shapes = {"in proportion": (values / np.abs(values).max())[:, None]}
        yield Driver(name, unit, values, shapes, kinds=_NOT_LINKS)


def _smooth(values: Array) -> dict[str, Array]:
    """Return shapes (V, R) over values (V,): a line, and Legendre polynomials where there are enough different values.

    They are zero in the first view, and 1 at the most.
    """
    x = 2 * (values - values.min()) / np.ptp(values) - 1
    powers = np.polynomial.legendre.legvander(x, _DEGREE)[:, 1:]
    powers = powers - powers[0]
    line = powers[:, :1] / np.abs(powers[:, 0]).max()
    if len(np.unique(values)) <= _DEGREE + 1:
        return {"a line": line}
    return {"a line": line, "smoothly": powers / np.abs(powers).max(axis=0)}


def _forms(place: Place, driver: Driver) -> Iterator[tuple[Law, float]]:
    """Yield the forms of one law with their shares of its prior, which add up to 1 but for rarely growing links.

    A form is a shape together with a choice of the place's axes; of joints, counted from the first view or the mean.
    """
    shares = 1 / len(driver.shapes)
    for shape in driver.shapes:
        if place.joint is not None:
            yield Law(place, driver, shape, place.whole), shares / 2
            yield Law(place, driver, shape, place.whole, centred=True), shares / 2
            continue
        if place.kind == "links":
            grows = driver.name == TIME or driver.name in TEMPERATURES
            yield Law(place, driver, shape, place.whole), shares * (1.0 if grows else _SELDOM_GROWS)
            continue
        axes = np.arange(place.twists.shape[2])
        for columns in (place.whole, *axes.reshape(-1, 3), *axes.reshape(-1, 1)):
            yield Law(place, driver, shape, columns), shares / 3 / (len(axes) // len(columns))


@dataclass(frozen=True, eq=False)
class Span:
    """What columns (n, p) can say."""

    columns: Array

    @cached_property
    def basis(self) -> Array:
        """(n, r) orthonormal."""
        return column_space(self.columns)

    def contains(self, other: "Span") -> bool:
        """Return whether the other's columns are combinations of these."""
        if not self.square or not other.square:
            return False
        return float(np.sum((self.basis.T @ other.columns) ** 2)) > _SAME * other.square

    @cached_property
    def square(self) -> float:
        """Sum of squares of the columns."""
        return float(np.sum(self.columns**2))


def _whole_forms(candidate: Candidate) -> list[Span]:
    """Return the forms of an effect with all its parameters."""
    forms = candidate.forms
    return [Span(form.columns) for form in forms if form.keep.sum() == forms[0].keep.sum()]


def _spans(place: Place, driver: Driver, observation: Observation) -> list[Span]:
    """Return each shape of a law with all numbers of its place."""
    return [Span(Law(place, driver, shape, place.whole).reduced(observation)) for shape in driver.shapes]


def _says(
    views: Views,
    candidate: Candidate,
    whole: Sequence[Span],
    place: Place,
    driver: Driver,
    laws: Callable[[], Sequence[Span]],
) -> bool:
    """Return whether an effect implies a law: same place and driver, as the effect declares or as its columns show."""
    effect = candidate.effect
    # An external axis moves a body as a whole: the part, or the base of what it carries.
    if effect.place != place.kind and not (effect.place == "axis" and place.kind in _BODIES):
        return False
    follows = {*effect.needs, *effect.prefers}
    if effect.prefers and not any(views.has(name) for name in effect.prefers):
        follows.add(TIME)
    event = any(p.discrete for p in candidate.parameters)
    declared = driver.name in follows or (driver.name == STEP and event)
    whole_body = place.joint is None and place.kind != "links"
    if whole_body and declared:
        return True
    if (driver.name == STEP) != event:
        return False
    if whole_body:
        return any(law.contains(form) for law in laws() for form in whole)
    return any(form.contains(law) for law in laws() for form in whole)
