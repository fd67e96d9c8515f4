"""How a flange may err in time by one shape: swings to and fro, and stretches of views after which it comes back."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis import unnamed_joint_laws
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import Score
from stitch.diagnosis.unnamed_joint_laws import (
    ANY_SIZE,
    JOINT_ANGLES,
    FittedProcess,
    JointLaw,
    SizedProcess,
    SmoothProcess,
    fit_process,
    joint_motions,
    joint_pair_processes,
    significant_laws,
    single_joint_processes,
    size_process,
    wandering_flange,
)
from stitch.numerics.frames import Array
from stitch.numerics.parameter_selection import log_mean_exp
from stitch.numerics.reml import NOISE, at_variances, fit_variances
from stitch.numerics.units import duration_text
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import (
    DRIFT,
    DRIFT_MEMORY,
    JOINT_SCATTER,
    STOP_COMPONENTS,
    flange_twists,
    time_in_steps,
    usual_time_step,
    usual_twist,
)
from stitch.system.threads import parallel

# Of a Gaussian its full width at half maximum.
_FULL_WIDTH = 2.355
# Periods between those that are tried, where one of them is clear.
_PERIOD_REFINEMENT = 17
# Of a swing in which all that moves does so at once: one of these is within a sixteenth of a period of any phase.
_PHASES = 8
# Times (T,) in steps from view to view → shapes (T, R) of a process.
_TimeCourse = Callable[[Array], Array]
_DescribedCourse = tuple[
    str, str, _TimeCourse, float | None
]  # its kind, in words, and with its frequency if it is a swing
_SWING, _SWING_IN_PHASE, _STRETCH = "swing", "swing at once", "stretch"


@dataclass(frozen=True)
class TimeProcess:
    """A motion of the flange in one course of time."""

    kind: str
    words: str  # what they do: "they …"
    process: SmoothProcess
    course: _TimeCourse
    frequency: float | None = None  # 1/step, of a swing


def time_processes(linear: LinearModel) -> list[TimeProcess]:
    """All that are tried, of any size and direction in the flange's frame."""
    time = time_in_steps(linear.measurement)
    span = _span(time)
    apart = max(limits.FREQUENCY_STEP / span, limits.FASTEST_SWING / limits.MOST_FREQUENCIES)
    frequencies = np.arange(limits.LEAST_SWINGS / span, limits.FASTEST_SWING, apart)
    at_once = _swings_in_phase(linear, frequencies)
    return _processes(linear, time, [*_swings(linear, frequencies), *at_once, *_stretches(linear, time)])


def processes_near_period(linear: LinearModel, swing: TimeProcess) -> list[TimeProcess]:
    """A swing, and others between it and the next ones that are tried."""
    assert swing.frequency is not None
    time = time_in_steps(linear.measurement)
    reach = limits.FREQUENCY_STEP / _span(time)
    return _processes(linear, time, _swings(linear, swing.frequency + np.linspace(-reach, reach, _PERIOD_REFINEMENT)))


def _span(time: Array) -> float:
    """Return the length of the session in steps, one at least."""
    return max(float(np.ptp(time)), 1.0)


def _processes(linear: LinearModel, time: Array, courses: Iterable[_DescribedCourse]) -> list[TimeProcess]:
    carried = flange_twists([linear.measurement], [linear.observation.centre]).reshape(len(time), 6, 6)
    return [
        TimeProcess(kind, words, SmoothProcess(None, carried, course(time)), course, frequency)
        for kind, words, course, frequency in courses
    ]


def _swings(linear: LinearModel, frequencies: Array) -> Iterator[_DescribedCourse]:
    """Sines, of another phase in each motion, in words."""
    for f in map(float, frequencies):
        yield _SWING, f"swing to and fro about every {_duration_in_words(linear, 1 / f)}", partial(_waves, f), f


def _swings_in_phase(linear: LinearModel, frequencies: Array) -> Iterator[_DescribedCourse]:
    """Yield swings with one phase for all motions, as where one temperature moves them: half as many numbers."""
    for _, words, waves, f in _swings(linear, frequencies):
        for phase in np.arange(_PHASES) * np.pi / _PHASES:
            yield _SWING_IN_PHASE, words, partial(_at_phase, waves, phase), f


def _waves(frequency: float, time: Array) -> Array:
    """(T, 2) of which all sines of a frequency (1/step) are made."""
    phase = 2 * np.pi * frequency * time
    return np.stack([np.cos(phase), np.sin(phase)], axis=1)


def _at_phase(waves: _TimeCourse, phase: float, time: Array) -> Array:
    """(T, 1) the one of them with a phase."""
    return np.asarray(waves(time) @ np.array([[np.cos(phase)], [np.sin(phase)]]))


def _stretches(linear: LinearModel, time: Array) -> Iterator[_DescribedCourse]:
    """Bumps that begin and end within the session, in words."""
    first, last, width = float(time.min()), float(time.max()), limits.SHORTEST_STRETCH
    views = linear.measurement.views
    while width <= limits.LONGEST_STRETCH * (last - first):
        # A grid of this width within the session, where there are views: it may hold breaks of days.
        steps = np.floor((time - first) / width)
        middles = first + width * np.unique([steps, steps + 1])
        for middle in middles[(middles > first) & (middles < last - width / 2)]:
            away = np.abs(time - middle) / width
            if np.count_nonzero(away < _FULL_WIDTH / 2) >= limits.STRETCH_VIEWS:
                name = views.names[views.number[away.argmin()]]
                words = f"are off for a stretch of {_duration_in_words(linear, _FULL_WIDTH * width)} about view {name}"
                yield _STRETCH, words, partial(_bump, middle, width), None
        width *= 2


def _bump(middle: float, width: float, time: Array) -> Array:
    """(T, 1) of unit height, with its standard deviation `width`."""
    return np.asarray(np.exp(-0.5 * ((time - middle) / width) ** 2)[:, None])


def _duration_in_words(linear: LinearModel, steps: float) -> str:
    """A time in steps from view to view, in words."""
    step = usual_time_step(linear.measurement)
    return f"{steps:.2g} views" + (f" ({duration_text(steps * step)})" if step > 0 else "")


# Laws without a name in time: a flange that swings to and fro, or that stands off for a stretch of views.
#
# A cabinet that cools in turns, air that is conditioned in turns, a draught, somebody who leans on the cell. Errors
# half a period apart are opposite, and a stretch of large errors lies amid small ones: no process that forgets and has
# one size throughout does that. Beside such a prior they count as white scatter, and a model that left 0.1 mrad of them
# was adequate; or an effect that goes with time got its name from a part of a swing.


@dataclass(frozen=True)
class TimeLaw:
    """The flange errs in one course of time, of which this is the likeliest."""

    course: TimeProcess
    log_bayes_factor: float  # of all courses that were tried, over everything else, each at its likeliest size
    fitted: FittedProcess
    base: LinearModel  # without the law


def likeliest_time_law(linear: LinearModel) -> TimeLaw | None:
    """The likeliest beside a model; None where poses have no prior of errors, or a session is too short for any.

    Of each kind of courses one may be there, each kind and each of its courses as likely before: what counts is the
    mean of their Bayes factors. All variances are sought anew for the likeliest few; for the others that is a bound.
    """
    courses = [] if linear.pose_errors is None else time_processes(linear)
    if not courses:
        return None
    sized = [size_process(linear, course.process) for course in courses]
    gains = np.array([own.gain for own in sized])
    found = {k: fit_process(linear, sized[k], tried=1) for k in np.argsort(-gains)[: limits.TIME_LAWS_FITTED]}
    for k, own in found.items():
        gains[k] = max(gains[k], own.log_bayes_factor)
    best = max(found, key=lambda k: gains[k])
    kinds = np.array([course.kind for course in courses])
    together = log_mean_exp([float(log_mean_exp(gains[kinds == kind])) for kind in np.unique(kinds)])
    return TimeLaw(courses[best], float(together), found[best], linear)


def time_law_log_posterior(linear: LinearModel) -> float:
    """Return the log posterior of such a law, none of its sizes known; −∞ where there is none."""
    law = likeliest_time_law(linear)
    return -np.inf if law is None else law.log_bayes_factor - ANY_SIZE + float(np.log(limits.PRIOR_UNKNOWN))


def significant_time_law(linear: LinearModel) -> TimeLaw | None:
    """The likeliest, where it is 20 to 1 likelier than none, beside all else that poses may do or in place of what
    wanders; a swing with the likeliest of all periods near its own.

    As with a joint's law (`significant_laws`) the odds are those of the likeliest sizes.
    """
    law = likeliest_time_law(linear)
    if law is None or law.log_bayes_factor <= limits.ODDS:
        law = _law_replacing_wander(linear)
    return law if law is None or law.course.frequency is None else _refine_period(law)


def _law_replacing_wander(linear: LinearModel) -> TimeLaw | None:
    """Return the law of a flange that wanders only by it: 20 to 1 likelier than none, and no less likely than all that
    wanders, which can do what a stretch does, so that beside it a stretch gains nothing."""
    steady = linear.restricted(linear.causes - DRIFT)
    law = likeliest_time_law(steady)
    wandering = 0.5 * (steady.null.deviance - linear.null.deviance)
    if law is None or law.log_bayes_factor <= max(limits.ODDS, wandering):
        return None
    return replace(law, log_bayes_factor=law.log_bayes_factor - wandering)


def _refine_period(law: TimeLaw) -> TimeLaw:
    """Refine the period between those that were tried; its evidence stays."""
    beside = replace(law.base, null=law.fitted.fit)
    near = [(course, size_process(beside, course.process)) for course in processes_near_period(law.base, law.course)]
    course, sized = max(near, key=lambda own: own[1].gain)
    return replace(law, course=course, fitted=fit_process(law.base, sized, tried=1))


# Laws without a name as rivals of names: of some joint, or of the flange in time.


def unnamed_law_log_posterior(base: LinearModel) -> float:
    """Return the log posterior of the likelier, as those of effects (`Ranked`); −∞ where there is none."""
    return max(unnamed_joint_laws.joint_law_log_posterior(base), time_law_log_posterior(base))


# When in a session the flange errs that follows a course of time without a name: what it does then, with bands.

_PLACES = 6  # from one view to the next
ROTATION_PART, TRANSLATION_PART = slice(3), slice(3, 6)


@dataclass(frozen=True)
class TimeCurve:
    """How far the flange turns and moves in time, in its own frame, beside where it stands otherwise.

    Example:
        >>> stitch.diagnose(run).time_curve is None  # of a flange that does not
        True
    """

    steps: Array  # (G,) times in usual steps from one view to the next
    seconds: float  # that a step takes; 0 where no time is stated
    error: Array  # (G, 6) rotation (rad), then translation (length_unit)
    sigma: Array  # (G, 6)

    def largest(self, of: slice) -> tuple[int, float, float]:
        """Return where rotation or translation is largest, how large it is there, and its sigma.

        Example:
            >>> from stitch.diagnosis.unnamed_time_laws import TimeCurve
            >>> curve = TimeCurve(np.arange(2.0), 60.0, np.eye(6)[:2] * 1e-3, np.full((2, 6), 1e-4))
            >>> curve.largest(slice(0, 3))
            (0, 0.001, 0.0001)
        """
        size = np.linalg.norm(self.error[:, of], axis=1)
        k = int(size.argmax())
        along = self.error[k, of] / max(float(size[k]), 1e-300)
        return k, float(size[k]), float(np.linalg.norm(along * self.sigma[k, of]))


def time_curve(law: TimeLaw) -> TimeCurve:
    """The course of a law of the flange in time, and its sigma: a free fit at the fitted sizes of all other errors."""
    linear = law.base
    time = np.sort(time_in_steps(linear.measurement))
    places = np.linspace(0, len(time) - 1, _PLACES * (len(time) - 1) + 1)
    steps = np.interp(places, np.arange(len(time)), time)
    shapes, found = law.course.course(steps), law.fitted
    G, wide = linear.in_blocks(found.columns), np.full(found.columns.shape[1], limits.FREE_SIZES * found.size)
    fit = at_variances(linear.mixed, found.fit.variances, G, wide)
    # Of every motion of the flange one coefficient for each shape.
    coefficients = fit.mean[-len(wide) :].reshape(6, -1)
    covariance = fit.covariance[-len(wide) :, -len(wide) :].reshape(*coefficients.shape, *coefficients.shape)
    variance = np.einsum("gr,prps,gs->gp", shapes, covariance, shapes)
    # Where the flange carries the part, the views move the other way.
    unit = usual_twist(linear.measurement.length_unit)
    way = -unit if linear.measurement.eye_to_hand else unit
    return TimeCurve(
        steps=steps,
        seconds=usual_time_step(linear.measurement),
        error=way * (shapes @ coefficients.T),
        sigma=unit * np.sqrt(np.maximum(variance, 0.0)),
    )


# Errors without a name as rivals of names where no prior of pose errors stands beside these: labelled points, and
# views by the hundred.
#
# Whatever is smooth gets the name of what it resembles, unless something smooth is what the name is held against. So a
# name must be wanted beside single joints that follow the joint angles, or the angles that they come from, by no law,
# and beside a flange that wanders in time: smooth processes of few numbers each (the leading eigenvectors of their
# covariance) and of a size that the views tell.


def unnamed_courses(linear: LinearModel) -> tuple[FittedProcess, ...]:
    """The likeliest of them beside a model; () where pose errors have a prior."""
    if regime_of(linear).prior:
        return ()
    found = [size_process(linear, wandering_flange(linear))]
    if linear.measurement.views.has("joints"):
        motions = joint_motions(linear)

        def sized(
            processes: Callable[[LinearModel, Array, int], Iterator[SmoothProcess]], k: int
        ) -> list[SizedProcess]:
            return [size_process(linear, process) for process in processes(linear, motions, k)]

        by_joint = list(parallel(partial(sized, single_joint_processes), range(len(motions))))
        clearest = sorted(range(len(by_joint)), key=lambda k: -max(course.gain for course in by_joint[k]))
        pairs = parallel(partial(sized, joint_pair_processes), clearest[: limits.PAIRED_JOINTS])
        found += [course for own in (*by_joint, *pairs) for course in own]
    likeliest = sorted(found, key=lambda course: -course.gain)[: limits.COURSES_FITTED]
    courses = parallel(lambda c: fit_process(linear, c, len(found)), likeliest)
    return tuple(sorted(courses, key=lambda c: -c.log_bayes_factor))


def significant_course(linear: LinearModel) -> FittedProcess | None:
    """The likeliest of them, where it is 20 to 1 likelier than scatter alone though it is the best of all.

    Scatter of the joints counts here, as what repeats least resembles it. It does not where names are asked for: an arm
    that errs by many small laws at once seems to scatter by its joints, and of two tracked arms of one series one was
    then not what it was named for on the other's poses.
    """
    courses = unnamed_courses(linear.restricted({JOINT_SCATTER}))
    return next((course for course in courses if course.log_bayes_factor > limits.ODDS), None)


def least_log_bayes_factor(linear: LinearModel, scored: Score) -> float:
    """Log Bayes factor of an effect beside that process which leaves least of it; ∞ where pose errors have a prior."""
    wanted = parallel(lambda course: _factor_with_course(linear, course, scored), unnamed_courses(linear))
    return min(wanted, default=np.inf)


def _factor_with_course(linear: LinearModel, course: FittedProcess, scored: Score) -> float:
    both = linear.in_blocks(np.hstack([course.columns, scored.form.columns]))
    own, start = np.full(course.columns.shape[1], course.size), course.fit.variances
    priors = [np.append(times * own, scored.sizes) for times in limits.COURSE_SIZES]
    return 0.5 * (course.fit.deviance - min(fit_variances(linear.mixed, both, p, start).deviance for p in priors))


# What the poses do wrong again without a name: which processes of the prior the views want, and how large they are.

# Processes that stand for the same in words; what is in none of them is an arm's own, of every joint and link.
_FOLLOW_JOINTS, _WANDER_IN_TIME = "follow the joints", "wander in time"


@dataclass(frozen=True)
class RepeatingError:
    """One kind of errors that repeat, beside all others."""

    words: str  # "they …"
    log_bayes_factor: float  # over the same errors without it
    joints: bool  # follows the pose rather than time
    of_one: bool = False  # one joint, or one course of time, stands out
    laws: tuple[JointLaw, ...] = ()  # of single joints, where they are clear
    curve: TimeCurve | None = None  # of the flange in time, where that is clear
    process: FittedProcess | None = None  # and the rest beside it, where the null counts it as scatter


def reportable(unnamed: tuple[RepeatingError, ...], implausible: bool) -> tuple[RepeatingError, ...]:
    """Those of them that are said: where poses scatter as no arm does, only beside a law that stands out."""
    return unnamed if not implausible or any(u.of_one for u in unnamed) else ()


def find_repeating_errors(linear: LinearModel) -> tuple[RepeatingError, ...]:
    """Kinds of errors without which the views cannot do, clearest first; () where white scatter explains them.

    Without a prior of pose errors the likeliest alone (`unnamed_courses`).

    Each is left out of the prior in turn, all other sizes fitted anew. A size that is not wanted goes to where its
    prior piles up and costs nothing; one that is wanted pays for its prior's tail alone and not for its width, about
    three nats (`reml`), which the odds of 20 to 1 stand for.
    """
    if linear.pose_errors is None:
        return _course_errors(linear)
    law = _likelier_errors(_joint_law_errors(linear), _time_law_errors(linear))
    if _log_evidence_gain(linear, linear.restricted({JOINT_SCATTER}).null.deviance) < limits.ODDS:
        return () if law is None else (law,)
    names = linear.pose_errors.names
    kinds = {
        _FOLLOW_JOINTS: tuple(n for n, of_arm in zip(names, linear.pose_errors.arm_components, strict=True) if of_arm),
        _WANDER_IN_TIME: tuple(DRIFT_MEMORY),
        "are shared by the scans of a stop": STOP_COMPONENTS,
    }
    found = [
        RepeatingError(words, _log_evidence_gain(linear, _deviance_without(linear, kind)), words == _FOLLOW_JOINTS)
        for words, kind in kinds.items()
        if any(name in kind for name in names)
    ]
    wanted = sorted((u for u in found if u.log_bayes_factor > limits.ODDS), key=lambda u: -u.log_bayes_factor)
    if law is not None:
        # What one joint does is part of what follows the joints, and as clear.
        alike = [u.log_bayes_factor for u in found if u.joints == law.joints]
        law = replace(law, log_bayes_factor=max([law.log_bayes_factor, *alike]))
        return (law, *(u for u in wanted if u.joints != law.joints))
    # Where each can stand in for the other, the likelier alone is said to be there.
    return tuple(wanted) or (max(found, key=lambda u: u.log_bayes_factor),)


def _joint_law_errors(linear: LinearModel) -> RepeatingError | None:
    """Return the error of one joint, beside all that the prior holds or in place of what an arm does."""
    laws = significant_laws(linear)
    if not laws:
        return None
    which = " or ".join(f"joint {joint}" for joint in sorted(law.joint for law in laws))
    followed = dict.fromkeys(number for law in laws for number in law.may_follow)
    # Of laws that nobody knows none is certain to be of the kind that explains most.
    words = f"come from {which} above all, likeliest by {' or '.join(followed)}"
    if JOINT_ANGLES in followed:
        words = f"{_FOLLOW_JOINTS}, {which} above all"
    return RepeatingError(words, laws[0].log_bayes_factor, joints=True, of_one=True, laws=laws)


def _time_law_errors(linear: LinearModel) -> RepeatingError | None:
    """Return the error of the flange in time."""
    law = significant_time_law(linear)
    if law is None:
        return None
    factor, curve = law.log_bayes_factor, time_curve(law)
    return RepeatingError(law.course.words, factor, joints=False, of_one=True, curve=curve, process=law.fitted)


def _likelier_errors(joint: RepeatingError | None, time: RepeatingError | None) -> RepeatingError | None:
    """Choose between a joint's law and one in time; both where 20 to 1 tells neither."""
    found = sorted((u for u in (joint, time) if u is not None), key=lambda u: -u.log_bayes_factor)
    if len(found) == 2 and found[0].log_bayes_factor - found[1].log_bayes_factor < limits.ODDS:
        return replace(found[0], words=f"{found[0].words}, or {found[1].words}")
    return found[0] if found else None


def _course_errors(linear: LinearModel) -> tuple[RepeatingError, ...]:
    """Return errors of poses that count as scattering independently."""
    course = significant_course(linear)
    if course is None:
        return ()
    words = _WANDER_IN_TIME if course.joint is None else f"{_FOLLOW_JOINTS}, joint {course.joint} above all"
    return (RepeatingError(words, course.log_bayes_factor, course.joint is not None, process=course),)


def _log_evidence_gain(linear: LinearModel, deviance: float) -> float:
    return 0.5 * (deviance - linear.null.deviance)


def _deviance_without(linear: LinearModel, kind: tuple[str, ...]) -> float:
    """Return the deviance of the null without some components."""
    assert linear.pose_errors is not None and linear.mixed.further is not None
    keep = np.array([name not in kind for name in linear.pose_errors.names], bool)
    every = np.append(np.ones(NOISE + 1, bool), keep)
    further = linear.mixed.further.select(keep)
    mixed = replace(linear.mixed, components=linear.mixed.components[every], further=further)
    plain = np.append(linear.restricted(()).null.variances, 1e-2 * further.scales**2)
    return min(fit_variances(mixed, start=start).deviance for start in (linear.null.variances[every], plain))
