"""The dictionary of systematic laws: whatever is known of the views, at every place where it could act.

A name is worth no more than what it is compared with, and a library is a poor rival of itself. So an effect is held
against all that views may follow: every column of views.csv, time or view order, angle, last move and torque of every
joint, its approach, a step from some view on or as gravity falls to the other side of what hangs at the flange. Each
may move what the reference carries (the part, and the base of an arm whose base is the reference), what stands at the
far end of the arm, any one joint, or the length of one link, which follows no angle; as a line or smoothly; in all six
numbers, as a turn or a shift, or along or about one axis.

A place and what it follows are one law, each as likely before as any other; its forms share that.

A law that an effect of the library or of a user says too is no rival of it: it is that effect, by its name. What turns
the first joint turns the base about its axis, and the last one what the flange carries; they are one place. So is a
link whose growth moves part or base as a whole.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import numpy as np

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.ranking import Ranked
from stitch.effects.contract import EFFECTS, Effect, per_joint
from stitch.model.forward import pose_derivatives
from stitch.model.model import term_of
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import column_space
from stitch.observations.linear_model import LinearModel, Observation
from stitch.observations.pose_errors import usual_twist
from stitch.session.measurement import TEMPERATURES, Views
from stitch.session.robot import Links
from stitch.session.scan import even_indices

TIME = "time_s"
# Waves along a joint's angle, and how many there are a turn.
_WAVES = {
    "a wave, once a turn": 1,
    "a wave, twice a turn": 2,
    "a wave, three times a turn": 3,
    "a wave, four times a turn": 4,
}
# Drivers without a column: a step from some view on; a trend over the views where no time is stated; the side to which
# gravity pulls what hangs with play.
STEP = "view order"
NUMBER = "view number"
GRAVITY = "gravity"
# Degree of a smooth function of a covariate; each power usually half as large as the one before.
_DEGREE = 3
# Views that a step leaves at either end at least, and steps that are tried at the most.
_VIEWS_AT_END, _MOST_STEPS = 2, 50
# Columns of which this share of the square is in the span of others say the same.
_SAME = 0.999
# Values that differ by less are constant.
_CONSTANT = 1e-9
# Axes of the flange to whose other side gravity may drop what hangs there with play, and what each is called.
_FALL_AXES = np.array([[1, 0, 0], [1, 1, 0], [0, 1, 0], [-1, 1, 0], [0, 0, 1]])
_FALL_WORDS = ("along x", "between x and y", "along y", "between y and -x", "along z")
# What friction holds of the weight, steel on steel.
_FRICTION = 0.2
# Kinds of places at the ends of the arm: what stands in the reference frame, and what holds the scanner.
BODIES = ("part", "mount")
_NOT_LINKS = (*BODIES, "robot")
# A joint that turns less (rad) follows nothing of its own angle.
_STILL = np.radians(2.0)
# Usual error of a joint (rad); that of a flange is `usual_twist`.
_USUAL_JOINT = 4e-4
# Usual growth of a link's lengths: steel by 17 °C.
_USUAL_GROWTH = 2e-4
# Share of a law by which a link's length follows anything but warmth and time (judgement).
_SELDOM_GROWS = 0.1


def _grow(links: Links, views: Views, g: Array) -> Links:
    """DH lengths of row i ×(1+g_i)"""
    return replace(links, lengths=links.lengths * (1 + g))


_LENGTHS = Effect("lengths", "links", {"g": per_joint("1", _USUAL_GROWTH, 1.0)}, _grow, (), (), tier="empirical")


@dataclass(frozen=True, eq=False)
class Driver:
    """What views may follow, as a covariate, and the shapes in which a law may follow it."""

    name: str  # a column of views.csv, time, view order, angle of joint 3, view (a step)
    unit: str
    values: Array  # (V,) of the views
    shapes: dict[str, Array]  # by their words, (V, R): zero where the law begins, at most 1
    joint: int | None = None  # the only joint that may follow it, counted from 1; None: any
    kinds: tuple[str, ...] = ("part", "mount", "robot", "links")  # of places that may follow it

    @property
    def covariate(self) -> str:
        """What is followed, in whatever shape: short waves of j5_deg are j5_deg."""
        return self.name.partition(",")[0]


@dataclass(frozen=True, eq=False)
class Place:
    """Where a law acts: a body, a joint or a link, with the k axes along or about which it may move."""

    name: str  # joint 3, link 2, or all bodies that move alike: the part or the base
    twists: Array  # (V, 6, k) of the views about the observation's centre, per unit along or about each axis
    sizes: Array  # (k,) that are usual
    independent: Indices  # axes of which all others are combinations
    units: tuple[str, ...]  # (k,) rad, or length_unit
    joint: int | None = None  # counted from 1
    kind: str = "robot"  # place of effects that act there: robot, links, part, mount

    @property
    def with_base(self) -> bool:
        """True where the base is one of the bodies that move alike."""
        return "base" in self.name


@dataclass(frozen=True, eq=False)
class Law:
    """One form of a law, that a place follows a driver: in one shape, along or about some of the place's axes."""

    place: Place
    driver: Driver
    shape: str  # in words, a key of the driver's shapes
    axes: Indices  # (a,) of the place, along or about which it moves
    centred: bool = False  # True: zero on average over the views; False: zero where the driver stands at first

    @property
    def key(self) -> tuple[str, str]:
        """Names of place and driver, the same for all forms of a law."""
        return self.place.name, self.driver.name

    @property
    def is_full(self) -> bool:
        """True for the form with all independent axes of its place, zero where the driver stands at first."""
        return self.axes is self.place.independent and not self.centred

    @cached_property
    def shapes(self) -> Array:
        """(V, R) of the views."""
        shapes = self.driver.shapes[self.shape]
        return shapes - shapes.mean(axis=0) if self.centred else shapes

    @cached_property
    def sizes(self) -> Array:
        """(a·R,) usual sizes of its coefficients, axis by axis; each shape half as large as the one before."""
        return np.outer(self.place.sizes[self.axes], 0.5 ** np.arange(self.shapes.shape[1])).ravel()

    @property
    def column_indices(self) -> Indices:
        """(a·R,) which of the k·R columns of all axes of the place belong to its own axes."""
        shapes = self.shapes.shape[1]
        return (shapes * self.axes[:, None] + np.arange(shapes)).ravel()

    def reduced_columns(self, observation: Observation) -> Array:
        """Return the columns (n, a·R) of its coefficients in the reduced observations."""
        moved = self.place.twists[:, :, self.axes, None] * self.shapes[:, None, None, :]
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
class LawEffect(Effect):
    """A law as a candidate among effects; it has no function, since no law is ever added to a model."""

    law: Law = None  # type: ignore[assignment]


def law_of(ranked: Ranked) -> Law:
    """Return the law that a ranked candidate is; only for candidates of `law_ranking`."""
    effect = ranked.score.candidate.effect
    assert isinstance(effect, LawEffect)
    return effect.law


@dataclass(frozen=True)
class Dictionary:
    """All laws that views can show, in all their forms, with the prior share of each form in its law."""

    laws: tuple[Law, ...]  # L forms, several of each law
    shares: Array  # (L,)
    said_by: dict[tuple[str, str], frozenset[str]]  # by the key of a law, the effects that say it
    observation: Observation

    def credited(self, effect: Ranked, laws: Sequence[Ranked]) -> Ranked:
        """Return an effect with the log posterior of a law that it says, where that explains more than the effect.

        The law may act along one axis where the effect has six. It counts only in a shape that the effect can have: a
        wave twice a turn is none once a turn. A law of one of J joints is charged log 2J: an effect does not say
        beforehand which joint errs, or whether all do.

        Args:
            effect: scored in the model in which the laws are.
            laws: ranked laws of this dictionary.
        """
        effect_spans = _full_spans(effect.score.candidate)
        joints = {law.place.joint for law in self.laws if law.place.joint is not None}
        gain = 0.0
        for ranked in laws:
            law, score = law_of(ranked), ranked.score
            if effect.name not in self.said_by[law.key]:
                continue
            law_span = Span(score.form.columns)
            if any(span.contains(law_span) for span in effect_spans):
                charge = 0.0 if law.place.joint is None else float(np.log(2 * len(joints)))
                gain = max(gain, score.log_bayes_factor - charge - effect.score.log_bayes_factor)
        return replace(effect, log_posterior=effect.log_posterior + gain)

    @cached_property
    def forms_of(self) -> dict[tuple[str, str], list[int]]:
        """By the key of a law, the indices of its forms in `laws`."""
        forms: dict[tuple[str, str], list[int]] = {key: [] for key in self.said_by}
        for i, law in enumerate(self.laws):
            forms[law.key].append(i)
        return forms

    @cached_property
    def stacks(self) -> list[tuple[Place, Array, Indices]]:
        """All laws as `stacked`."""
        return list(stacked(self.laws))

    def without(self, linear: LinearModel, laws: Sequence[Ranked], effect: Ranked) -> tuple[Ranked, ...]:
        """Return the laws that are rivals of an effect: those that it does not say, and that are not the same here.

        A law of the body on which the effect acts is the same in these views if its columns are combinations of the
        effect's.
        """
        rivals = [r for r in laws if effect.name not in self.said_by[law_of(r).key]]
        place = effect.score.candidate.effect.place
        span = Span(linear.residual(effect.score.form.columns))
        return tuple(
            r
            for r in rivals
            if law_of(r).place.joint is not None
            or law_of(r).place.kind != place
            or law_of(r).driver.name == GRAVITY
            or not span.contains(Span(linear.residual(r.score.form.columns)))
        )


def dictionary_of(linear: LinearModel, candidates: Sequence[Candidate] = ()) -> Dictionary:
    """Return the dictionary of a session: each place with each driver that it may follow, and the effects that say it.

    Args:
        candidates: effects that may say a law.
    """
    laws, shares, said_by = list[Law](), list[float](), dict[tuple[str, str], frozenset[str]]()
    views = linear.measurement.views
    drivers = list(drivers_of(views))
    effects = [(c, _full_spans(c)) for c in candidates if not c.empirical]
    for place in _places(linear):
        for driver in drivers:
            if driver.joint not in (None, place.joint) or place.kind not in driver.kinds:
                continue
            forms = list(_forms(place, driver))
            laws += [law for law, _ in forms]
            shares += [share for _, share in forms]
            # Mostly the declared needs of an effect tell: the spans, computed when first asked, are wanted of few.
            spans = cache(partial(_full_law_spans, place, driver, linear.observation))
            said = (c.name for c, forms in effects if _says(views, c, forms, place, driver, spans))
            said_by[place.name, driver.name] = frozenset(said)
    return Dictionary(tuple(laws), np.array(shares), said_by, linear.observation)


def stacked(laws: Sequence[Law]) -> Iterator[tuple[Place, Array, Indices]]:
    """Yield laws with the same place and number R of shape columns together, so that their sums are computed at once.

    Each item is the place, shapes (S, V, R) of S laws over V views, and indices (S, F) in `laws` of their F forms: one
    for each choice of the place's axes, all of them first.
    """
    stacks: dict[tuple[str, int], list[int]] = {}
    for i, law in enumerate(laws):
        stacks.setdefault((law.place.name, law.shapes.shape[1]), []).append(i)
    for indices in stacks.values():
        shapes = [laws[i].shapes for i in indices if laws[i].axes is laws[i].place.independent]
        yield laws[indices[0]].place, np.array(shapes), np.reshape(indices, (len(shapes), -1))


def bodies_of(linear: LinearModel) -> Iterator[tuple[str, str, Array]]:
    """Yield the two bodies at the ends of the arm: what stands in the reference frame, then what holds the scanner.

    Each as name, kind, and (V, 6, 6): left twists of the views about the observation's centre per unit of a twist of
    the body in its own frame; rotation first, rad and length_unit.
    """
    measurement = linear.measurement
    still = np.broadcast_to(np.eye(4), (measurement.views.count, 4, 4))
    if measurement.eye_to_hand:
        names = ("the part on the flange", "the scanner's stand or the base")
    else:
        names = ("the part or the base", "the scanner or its mount")
    for name, kind, carried in zip(names, BODIES, (still, measurement.capture.T_reference_mount), strict=True):
        yield name, kind, frames.adjoint_about(linear.observation.centre, carried)


def _places(linear: LinearModel) -> Iterator[Place]:
    """Yield the places where a law may act: the two bodies at the ends of the arm, each joint, and each link's length.

    A body has nine axes: the six of its twist in its own frame, and three rotations about the observation's centre. A
    link that moves the views as a body does, or hardly at all, is no place of its own.
    """
    measurement = linear.measurement
    centre = linear.observation.centre
    count = measurement.views.count
    usual = usual_twist(measurement.length_unit)
    sizes = np.append(4 * usual, 4 * usual[:3])
    units = ("rad",) * 3 + (measurement.length_unit,) * 3 + ("rad",) * 3
    bodies = list[Array]()
    about_centre = np.broadcast_to(np.eye(6)[:, :3], (count, 6, 3))
    for name, kind, moved in bodies_of(linear):
        rotations = moved[:, :3, :3]
        turned_mount = np.concatenate([rotations, np.zeros_like(rotations)], axis=1)
        about = turned_mount if kind == "mount" else about_centre
        bodies.append(moved.reshape(-1, 6))
        yield Place(name, np.concatenate([moved, about], axis=2), sizes, np.arange(6), units, kind=kind)
    if measurement.views.joints.shape[1] and measurement.robot is not None:
        terms = [term_of(measurement, effect) for effect in (EFFECTS["joint_offset"], _LENGTHS)]
        of_joints, of_links = pose_derivatives(measurement, linear.model, terms, centre)
        ends = {0: " or the base", len(of_joints) - 1: " or what the flange carries"}
        for k, (turned, grown) in enumerate(zip(of_joints, of_links, strict=True)):
            end = ends.get(k, "")
            yield Place(
                f"joint {k + 1}{end}", turned[..., None], np.array([_USUAL_JOINT]), np.arange(1), ("rad",), k + 1
            )
            moves_a_body = any(Span(body).contains(Span(grown.reshape(-1, 1))) for body in bodies)
            if np.abs(grown).max() * _USUAL_GROWTH > usual[-1] / 10 and not moves_a_body:
                size = np.array([_USUAL_GROWTH])
                yield Place(f"link {k + 1}{end}", grown[..., None], size, np.arange(1), ("1",), kind="links")


def drivers_of(views: Views) -> Iterator[Driver]:
    """Yield what the errors of views may follow, with its shapes.

    These are time or order, covariates, a step at some view, angles and moves of joints, torques, and gravity. What
    hardly changes over the views is left out.
    """
    order = np.arange(views.count, dtype=float)
    known = [(TIME, "s", views.time)] if views.has("time") else [(NUMBER, "view", order)]
    known += [(name, "", values) for name, values in views.covariates.items()]
    for name, unit, values in known:
        if np.ptp(values) > _CONSTANT:
            yield Driver(name, unit, values, _smooth_shapes(values))
    starts = np.arange(_VIEWS_AT_END, views.count - _VIEWS_AT_END + 1)
    tried = starts[even_indices(len(starts), _MOST_STEPS)]
    steps = {f"a step at view {views.names[views.number[k]]}": (order >= k)[:, None].astype(float) for k in tried}
    if steps:
        yield Driver(STEP, "view", order, steps)
    yield from _joint_drivers(views)
    for name, torque in zip(views.torques.names, views.torques.values.T, strict=True):
        yield from _proportional_driver(f"j{name}_torque_nm", "N m", torque)
    for kind, gravity in (("mount", views.gravity_at_mount), ("part", views.gravity_at_part)):
        if gravity is None or np.ptp(gravity, axis=0).max() < _CONSTANT:
            continue
        falls = {
            f"a step as it falls {words}{held}": side[:, None].astype(float)
            for held, friction in (("", 0.0), (", held by friction", _FRICTION))
            for words, side in zip(_FALL_WORDS, _fallen(gravity @ _FALL_AXES.T, friction).T, strict=True)
            if _VIEWS_AT_END <= side.sum() <= views.count - _VIEWS_AT_END
        }
        if falls:
            yield Driver(GRAVITY, "g", gravity[:, 1], falls, kinds=(kind,))


def _joint_drivers(views: Views) -> Iterator[Driver]:
    """Yield the angle, the last move and the approach of every joint that turns.

    Waves of one and two periods a turn, which errors of a gear have, may show at any place. Those of three and four are
    a driver of the joint alone.
    """
    for k, angle in enumerate(views.joints.T):
        if np.ptp(angle) < _STILL:
            continue
        waves = {shape: np.column_stack([np.sin(n * angle), np.cos(n * angle)]) for shape, n in _WAVES.items()}
        long_waves = {shape: waves[shape] for shape, periods in _WAVES.items() if periods <= 2}
        short_waves = {shape: waves[shape] for shape, periods in _WAVES.items() if periods > 2}
        yield Driver(f"j{k + 1}_deg", "deg", np.degrees(angle), _smooth_shapes(angle) | long_waves, kinds=_NOT_LINKS)
        yield Driver(f"j{k + 1}_deg, in short waves", "deg", np.degrees(angle), short_waves, k + 1)
        yield from _proportional_driver(f"j{k + 1}_move_deg", "deg", np.degrees(angle - views.previous[:, k]))
        yield from _proportional_driver(f"j{k + 1}_approach", "", views.approach[:, k].astype(float))


def _fallen(along: Array, friction: float) -> Mask:
    """Return a mask (V, k) of the views in which what hangs with play lies on the positive side of each of k axes.

    It lies where gravity last pulled it by more than friction holds.

    Args:
        along: (V, k) components of gravity along the axes, views in their order; the first view counts in any case.
        friction: component below which nothing moves.
    """
    pulled = np.abs(along) > friction
    pulled[0] = True
    last = np.maximum.accumulate(np.where(pulled, np.arange(len(along))[:, None], 0), axis=0)
    return np.take_along_axis(along, last, axis=0) > 0


def _proportional_driver(name: str, unit: str, values: Array) -> Iterator[Driver]:
    """Yield a driver with the one shape "in proportion", values over their largest size; nothing if they are constant.

    Args:
        values: (V,) of the views.
    """
    if np.ptp(values) > _CONSTANT * max(np.abs(values).max(), 1.0):
        shapes = {"in proportion": (values / np.abs(values).max())[:, None]}
        yield Driver(name, unit, values, shapes, kinds=_NOT_LINKS)


def _smooth_shapes(values: Array) -> dict[str, Array]:
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

    A form is a shape together with a choice of axes. Of a joint it is zero in the first view, or on average. Of a body
    it has all six axes, three of one kind (rotation, shift, rotation about the centre), or one: a third of the prior
    each.
    """
    share = 1 / len(driver.shapes)
    for shape in driver.shapes:
        if place.joint is not None:
            yield Law(place, driver, shape, place.independent), share / 2
            yield Law(place, driver, shape, place.independent, centred=True), share / 2
            continue
        if place.kind == "links":
            grows = driver.name == TIME or driver.name in TEMPERATURES
            yield Law(place, driver, shape, place.independent), share * (1.0 if grows else _SELDOM_GROWS)
            continue
        every = np.arange(place.twists.shape[2])
        for axes in (place.independent, *every.reshape(-1, 3), *every.reshape(-1, 1)):
            yield Law(place, driver, shape, axes), share / 3 / (len(every) // len(axes))


@dataclass(frozen=True, eq=False)
class Span:
    """The space of all combinations of columns (n, p)."""

    columns: Array

    @cached_property
    def basis(self) -> Array:
        """(n, r) orthonormal."""
        return column_space(self.columns)

    def contains(self, other: "Span") -> bool:
        """Return whether the other's columns are combinations of these, up to 0.1 % of their sum of squares."""
        if not self.square or not other.square:
            return False
        within = self.basis.T @ other.columns
        return float(np.vdot(within, within)) > _SAME * other.square

    @cached_property
    def square(self) -> float:
        """Sum of squares of the columns."""
        return float(np.sum(self.columns**2))


def _full_spans(candidate: Candidate) -> list[Span]:
    """Return the spans of the forms of an effect that have all its parameters, one for each value of its grid."""
    forms = candidate.forms
    return [Span(form.columns) for form in forms if form.keep.sum() == forms[0].keep.sum()]


def _full_law_spans(place: Place, driver: Driver, observation: Observation) -> list[Span]:
    """Return the span of a law in each of its shapes, with all independent axes of its place."""
    full_laws = (Law(place, driver, shape, place.independent) for shape in driver.shapes)
    return [Span(law.reduced_columns(observation)) for law in full_laws]


def _says(
    views: Views,
    candidate: Candidate,
    effect_spans: Sequence[Span],
    place: Place,
    driver: Driver,
    law_spans: Callable[[], Sequence[Span]],
) -> bool:
    """Return whether an effect says a law: that its place follows this driver is what the effect is.

    Of a body it says so where it declares the driver among its needs, or where it can do nothing that the law cannot:
    its columns lie in the span of the law's. Of a joint or link it says so where it can do all that the law can: what
    it declares may be meant of any joint. A step is said by events alone.

    Args:
        effect_spans: of the effect with all its parameters.
        law_spans: function that returns the spans of the law; called only where columns decide.
    """
    effect = candidate.effect
    is_body = place.kind in BODIES
    # An external axis moves a body as a whole: the part, or the base of what it carries.
    if effect.place != place.kind and not (effect.place == "axis" and is_body):
        return False
    is_event = any(p.discrete for p in candidate.parameters)
    declared = {*effect.needs, *effect.prefers}
    if effect.prefers and not any(views.has(name) for name in effect.prefers):
        declared.add(TIME)  # which stands in for the columns that it prefers
    if is_event:
        declared.add(STEP)
    if is_body and driver.name in declared:
        return True
    if (driver.name == STEP) != is_event:
        return False
    pairs = ((law, span) for law in law_spans() for span in effect_spans)
    return any(law.contains(span) if is_body else span.contains(law) for law, span in pairs)
