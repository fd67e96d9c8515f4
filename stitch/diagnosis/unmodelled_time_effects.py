"""Unmodelled effects in time, and all errors of poses without a name that are held against names.

A flange swings to and fro, or stands off for a stretch of views after which it comes back: a cabinet that cools in
turns, air that is conditioned in turns, a draught, somebody who leans on the cell. Errors half a period apart are
opposite, and a stretch of large errors lies amid small ones: no process that forgets and has one size throughout does
that. Beside such a prior they count as white scatter, and a model that left 0.1 mrad of them was adequate; or an effect
that goes with time got its name from a part of a swing.

Where no prior of pose errors stands beside names (labelled points, and views by the hundred), whatever is smooth gets
the name of what it resembles, unless something smooth is what the name is held against. So a name must be wanted beside
single joints that follow the joint angles, or the angles that they come from, by no law, and beside a flange that
wanders in time: smooth processes of few numbers each and of a size that the views tell (`unmodelled_trends`).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import Score
from stitch.diagnosis.smooth_processes import (
    FittedProcess,
    SmoothProcess,
    fit_process,
    joint_motions,
    joint_pair_processes,
    single_joint_processes,
    size_process,
    wandering_flange,
)
from stitch.diagnosis.unmodelled_joint_effects import (
    JOINT_ANGLES,
    SIZE_PENALTY,
    JointEffect,
    joint_effects,
    log_posterior_of_any,
    significant_joint_effects,
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
from stitch.system.values import Value

# Of a Gaussian its full width at half maximum.
_FULL_WIDTH = 2.355
# Periods between those that are tried, where one of them is clear.
_PERIOD_REFINEMENT = 17
# Of a swing in which all that moves does so at once: one of these is within a sixteenth of a period of any phase.
_PHASES = 8
_SWING, _SWING_IN_PHASE, _STRETCH = "swing", "swing at once", "stretch"
_POINTS_PER_STEP = 6  # of a curve in time, from one view to the next
ROTATION_PART, TRANSLATION_PART = slice(3), slice(3, 6)
# What poses do that err by a kind of components.
_FOLLOW_JOINTS, _WANDER_IN_TIME = "follow the joints", "wander in time"


def time_processes(linear: LinearModel) -> list[SmoothProcess]:
    """Return all courses in time that are tried for the flange: swings of many periods, and stretches of many lengths.

    Each may move the flange by any amount along and about every axis of its frame.
    """
    time = time_in_steps(linear.measurement)
    span = max(float(np.ptp(time)), 1.0)
    spacing = max(limits.FREQUENCY_STEP / span, limits.FASTEST_SWING / limits.MOST_FREQUENCIES)
    frequencies = np.arange(limits.LEAST_SWINGS / span, limits.FASTEST_SWING, spacing)
    carried = flange_twists([linear.measurement], [linear.observation.centre]).reshape(len(time), 6, 6)
    swings = _swings(linear, carried, frequencies)
    # With one phase for all six motions, as where one temperature moves them: half as many numbers.
    in_phase = _swings(linear, carried, frequencies, [k * np.pi / _PHASES for k in range(_PHASES)])
    return [*swings, *in_phase, *_stretches(linear, carried, time)]


def likeliest_time_effect(linear: LinearModel) -> tuple[FittedProcess, float] | None:
    """Return the likeliest motion of the flange in time beside a model, and the log Bayes factor that there is any.

    That factor is the mean over kinds (swing, stretch, …) of the mean Bayes factor of each kind. All variances are
    fitted again for the likeliest few; the others keep a lower bound, their gain without that. None where pose errors
    have no prior, or the session is too short for any.
    """
    processes = [] if linear.pose_errors is None else time_processes(linear)
    if not processes:
        return None
    sized = [size_process(linear, process) for process in processes]
    gains = np.array([gain for _, gain in sized])
    likeliest = np.argsort(-gains)[: limits.TIME_EFFECTS_FITTED]
    fits = {k: fit_process(linear, processes[k], sized[k][0], tried=1) for k in likeliest}
    for k, fit in fits.items():
        gains[k] = max(gains[k], fit.log_bayes_factor)
    best = max(fits, key=lambda k: gains[k])
    kinds = np.array([process.kind for process in processes])
    together = log_mean_exp([float(log_mean_exp(gains[kinds == kind])) for kind in np.unique(kinds)])
    return fits[best], float(together)


def significant_time_effect(linear: LinearModel) -> FittedProcess | None:
    """Return the likeliest motion of the flange in time, a swing or a stretch; None where none is 20 to 1 over nothing.

    It is sought beside all other pose errors first. If nothing is clear there, it is sought without drift, which can do
    what a stretch does: then it has to gain at least as much as drift does. The period of a swing is refined at last.
    The log Bayes factor is that there is any such motion, at fitted sizes (`likeliest_time_effect`).
    """
    base = linear
    gain_of_drift = 0.0
    likeliest = likeliest_time_effect(base)
    if likeliest is None or likeliest[1] <= limits.ODDS:
        base = linear.without(DRIFT)
        likeliest = likeliest_time_effect(base)
        gain_of_drift = 0.5 * (base.null.deviance - linear.null.deviance)
        if likeliest is None or likeliest[1] <= max(limits.ODDS, gain_of_drift):
            return None
    fitted, log_bayes_factor = likeliest
    if fitted.process.frequency is not None:
        fitted = _with_refined_period(base, fitted)
    return replace(fitted, log_bayes_factor=log_bayes_factor - gain_of_drift)


def unmodelled_log_posterior(base: LinearModel) -> float:
    """Return the larger log posterior of an unmodelled effect of some joint, and of the flange in time.

    It is comparable with those of effects (`Ranked`); −∞ where neither can be tested.
    """
    in_time = likeliest_time_effect(base)
    of_flange = -np.inf if in_time is None else in_time[1] - SIZE_PENALTY + float(np.log(limits.PRIOR_UNKNOWN))
    factors = np.array([effect.log_bayes_factor for effect in joint_effects(base)])
    of_joint = float(log_posterior_of_any(factors)) if len(factors) else -np.inf
    return max(of_joint, of_flange)


def _with_refined_period(base: LinearModel, swing: FittedProcess) -> FittedProcess:
    """Return the likeliest of the swings with periods near that of `swing`, more finely spaced than those tried.

    They are compared at the variances of its fit; the likeliest is fitted with variances of its own.
    """
    frequency = swing.process.frequency
    assert frequency is not None
    time = time_in_steps(base.measurement)
    reach = limits.FREQUENCY_STEP / max(float(np.ptp(time)), 1.0)
    frequencies = frequency + np.linspace(-reach, reach, _PERIOD_REFINEMENT)
    beside = replace(base, null=swing.fit)
    swings = _sized(beside, _swings(base, swing.process.motions, frequencies))
    process, size, _ = max(swings, key=lambda sized: sized[2])
    return fit_process(base, process, size, tried=1)


def _sized(linear: LinearModel, processes: Iterable[SmoothProcess]) -> list[tuple[SmoothProcess, float, float]]:
    """Return processes, each with its likeliest size at the null's variances and its log Bayes factor there."""
    return [(process, *size_process(linear, process)) for process in processes]


def _swings(
    linear: LinearModel, carried: Array, frequencies: Array, phases: Sequence[float] = ()
) -> Iterator[SmoothProcess]:
    """Yield the swings of the flange with each frequency (1/step).

    Args:
        carried: (V, 6, 6) twists of the views per unit motion of the flange, along and about each of its axes.
        phases: rad; one swing of each, in which all six motions move at once. (): each motion has a phase of its own.
    """
    time = time_in_steps(linear.measurement)
    for f in map(float, frequencies):
        words = f"swing to and fro about every {_duration_in_words(linear, 1 / f)}"
        for trend in [partial(_wave, f, phase) for phase in phases] or [partial(_waves, f)]:
            yield SmoothProcess(None, carried, trend(time), _SWING_IN_PHASE if phases else _SWING, words, trend, f)


def _waves(frequency: float, time: Array) -> Array:
    """Return cosine and sine (T, 2) of a frequency (1/step) at times (T,) in steps; all its sines combine these."""
    phase = 2 * np.pi * frequency * time
    return np.stack([np.cos(phase), np.sin(phase)], axis=1)


def _wave(frequency: float, phase: float, time: Array) -> Array:
    """Return the wave (T, 1) of a frequency (1/step) with one phase (rad), at times (T,) in steps."""
    return np.cos(2 * np.pi * frequency * time - phase)[:, None]


def _stretches(linear: LinearModel, carried: Array, time: Array) -> Iterator[SmoothProcess]:
    """Yield the flange's stretches: Gaussian bumps that begin and end within the session, from narrow to wide.

    Args:
        carried: (V, 6, 6) twists of the views per unit motion of the flange, along and about each of its axes.
        time: (V,) of the views, in steps.
    """
    first = float(time.min())
    last = float(time.max())
    views = linear.measurement.views
    width = limits.SHORTEST_STRETCH
    while width <= limits.LONGEST_STRETCH * (last - first):
        # Middles a width apart, only where there are views: the session may hold breaks of days.
        steps = np.floor((time - first) / width)
        middles = first + width * np.unique([steps, steps + 1])
        for middle in middles[(middles > first) & (middles < last - width / 2)]:
            distance = np.abs(time - middle) / width
            if np.count_nonzero(distance < _FULL_WIDTH / 2) >= limits.STRETCH_VIEWS:
                name = views.names[views.number[distance.argmin()]]
                words = f"are off for a stretch of {_duration_in_words(linear, _FULL_WIDTH * width)} about view {name}"
                trend = partial(_bump, middle, width)
                yield SmoothProcess(None, carried, trend(time), _STRETCH, words, trend)
        width *= 2


def _bump(middle: float, width: float, time: Array) -> Array:
    """Return (T, 1) a Gaussian of height 1 and standard deviation `width`, all in steps."""
    return np.exp(-0.5 * ((time - middle) / width) ** 2)[:, None]


def _duration_in_words(linear: LinearModel, steps: float) -> str:
    """Return a time in steps from view to view, in words."""
    step = usual_time_step(linear.measurement)
    return f"{steps:.2g} views" + (f" ({duration_text(steps * step)})" if step > 0 else "")


@dataclass(frozen=True, eq=False)
class TimeCurve(Value):
    """How far the flange is off in time, in its own frame, by one swing or stretch.

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
            >>> from stitch.diagnosis.unmodelled_time_effects import TimeCurve
            >>> curve = TimeCurve(np.arange(2.0), 60.0, np.eye(6)[:2] * 1e-3, np.full((2, 6), 1e-4))
            >>> curve.largest(slice(0, 3))
            (0, 0.001, 0.0001)
        """
        size = np.linalg.norm(self.error[:, of], axis=1)
        k = int(size.argmax())
        along = self.error[k, of] / max(float(size[k]), 1e-300)
        return k, float(size[k]), float(np.linalg.norm(along * self.sigma[k, of]))


def time_curve(fitted: FittedProcess) -> TimeCurve:
    """Return what the flange does in time by a fitted process, with its sigma.

    The process is fitted freely, its prior so wide that it pulls at nothing, at the fitted variances of all else.
    """
    linear = fitted.base
    assert fitted.process.trend is not None
    time = np.sort(time_in_steps(linear.measurement))
    places = np.linspace(0, len(time) - 1, _POINTS_PER_STEP * (len(time) - 1) + 1)
    steps = np.interp(places, np.arange(len(time)), time)
    shapes = fitted.process.trend(steps)
    free_sizes = np.full(fitted.columns.shape[1], limits.FREE_SIZES * fitted.size)
    fit = at_variances(linear.mixed, fitted.fit.variances, linear.in_blocks(fitted.columns), free_sizes)
    # Six motions of the flange, each with one coefficient for each shape: the last of the fit's amplitudes.
    count = len(free_sizes)
    coefficients = fit.mean[-count:].reshape(6, -1)
    covariance = fit.covariance[-count:, -count:].reshape(*coefficients.shape, *coefficients.shape)
    variance = np.einsum("gr,prps,gs->gp", shapes, covariance, shapes)
    unit = usual_twist(linear.measurement.length_unit)
    # Where the flange carries the part, the views move the other way.
    direction = -unit if linear.measurement.eye_to_hand else unit
    return TimeCurve(
        steps=steps,
        seconds=usual_time_step(linear.measurement),
        error=direction * (shapes @ coefficients.T),
        sigma=unit * np.sqrt(np.maximum(variance, 0.0)),
    )


def unmodelled_trends(linear: LinearModel) -> tuple[FittedProcess, ...]:
    """Return the likeliest smooth errors of a joint or of the flange in time, fitted beside a model, best first.

    All are sized at the null's variances; those of one joint that also follow another only for the clearest joints. The
    best `TRENDS_FITTED` are then fitted. () where pose errors have a prior, which contains such errors already.
    """
    if regime_of(linear).prior:
        return ()
    sized = _sized(linear, [wandering_flange(linear)])
    if linear.measurement.views.has("joints"):
        motions = joint_motions(linear)
        joints = range(len(motions))
        singles = list(parallel(lambda k: _sized(linear, single_joint_processes(linear, motions, k)), joints))
        clearest = sorted(joints, key=lambda k: -max(gain for _, _, gain in singles[k]))[: limits.PAIRED_JOINTS]
        pairs = parallel(lambda k: _sized(linear, joint_pair_processes(linear, motions, k)), clearest)
        sized += [process for of_joint in (*singles, *pairs) for process in of_joint]
    likeliest = sorted(sized, key=lambda process: -process[2])[: limits.TRENDS_FITTED]
    fitted = parallel(lambda process: fit_process(linear, process[0], process[1], len(sized)), likeliest)
    return tuple(sorted(fitted, key=lambda process: -process.log_bayes_factor))


def least_log_bayes_factor(linear: LinearModel, scored: Score) -> tuple[float, str]:
    """Return an effect's log Bayes factor beside the unnamed smooth trend that leaves it least, and the trend in words.

    (∞, "") where pose errors have a prior: the effect was scored beside such trends already.
    """
    trends = unmodelled_trends(linear)
    factors = parallel(partial(_log_bayes_factor_beside, linear, scored), trends)
    return min(zip(factors, (trend.words for trend in trends), strict=True), default=(np.inf, ""))


def _log_bayes_factor_beside(linear: LinearModel, scored: Score, trend: FittedProcess) -> float:
    """Return the log Bayes factor of an effect beside a trend, which takes the likeliest of `TREND_SIZES`."""
    both = linear.in_blocks(np.hstack([trend.columns, scored.form.columns]))
    size = np.full(trend.columns.shape[1], trend.size)
    priors = [np.append(times * size, scored.sizes) for times in limits.TREND_SIZES]
    start = trend.fit.variances
    return 0.5 * (trend.fit.deviance - min(fit_variances(linear.mixed, both, p, start).deviance for p in priors))


@dataclass(frozen=True)
class RepeatingError:
    """One kind of pose errors without a name that repeat: with the joints, in time, or at a stop."""

    words: str  # "they …"
    log_bayes_factor: float  # of all pose errors over all but this kind
    joints: bool  # True: they follow the joints; False: time, or the stops
    of_one: bool = False  # one joint, or one trend in time, stands out
    joint_effects: tuple[JointEffect, ...] = ()  # of single joints, where they are clear
    curve: TimeCurve | None = None  # of the flange in time, where that is clear
    process: FittedProcess | None = None  # fitted with all variances, where the null counts it as scatter


def reportable(errors: tuple[RepeatingError, ...], implausible: bool) -> tuple[RepeatingError, ...]:
    """Return the errors that are reported: all, or none where the scatter is implausible and no single one stands out.

    Args:
        errors: kinds of errors that repeat.
        implausible: True if poses scatter more than those of any sound arm.
    """
    return errors if not implausible or any(error.of_one for error in errors) else ()


def find_repeating_errors(linear: LinearModel) -> tuple[RepeatingError, ...]:
    """Return the kinds of pose errors that repeat, clearest first; () where scatter explains the views as well.

    Without a prior of pose errors it is the likeliest trend alone (`unmodelled_trends`). With one, all kinds together
    must be 20 to 1 over scatter; then those are returned without which the views are 20 to 1 less likely. A single
    joint, or a single trend in time, that stands out takes the place of its kind.
    """
    if linear.pose_errors is None:
        return _trend_errors(linear)
    single = _single_error(linear)
    if 0.5 * (linear.restricted({JOINT_SCATTER}).null.deviance - linear.null.deviance) < limits.ODDS:
        return () if single is None else (single,)
    errors = _error_kinds(linear)
    required = sorted((e for e in errors if e.log_bayes_factor > limits.ODDS), key=lambda e: -e.log_bayes_factor)
    if single is not None:
        # What one joint does is part of what follows the joints, and as clear.
        same_kind = [e.log_bayes_factor for e in errors if e.joints == single.joints]
        single = replace(single, log_bayes_factor=max([single.log_bayes_factor, *same_kind]))
        return (single, *(e for e in required if e.joints != single.joints))
    # Where each can stand in for the other, none is required: the likelier alone is said to be there.
    return tuple(required) or (max(errors, key=lambda e: e.log_bayes_factor),)


def _error_kinds(linear: LinearModel) -> list[RepeatingError]:
    """Return the kinds of errors that the prior of pose errors holds, with the log Bayes factor of each.

    Each kind is left out of the prior in turn, and all other sizes are fitted again. A size that is not wanted goes to
    where its prior piles up and costs nothing. One that is wanted pays for its prior's tail alone and not for its
    width, about three nats (`reml`), which the odds of 20 to 1 stand for.
    """
    assert linear.pose_errors is not None
    names = linear.pose_errors.names
    of_arm = tuple(name for name, is_of_arm in zip(names, linear.pose_errors.arm_components, strict=True) if is_of_arm)
    kinds = {
        _FOLLOW_JOINTS: of_arm,
        _WANDER_IN_TIME: tuple(DRIFT_MEMORY),
        "are shared by the scans of a stop": STOP_COMPONENTS,
    }
    errors = list[RepeatingError]()
    for words, kind in kinds.items():
        if any(name in kind for name in names):
            gain = 0.5 * (_deviance_without(linear, kind) - linear.null.deviance)
            errors.append(RepeatingError(words, gain, joints=words == _FOLLOW_JOINTS))
    return errors


def _single_error(linear: LinearModel) -> RepeatingError | None:
    """Return the clear error of a single joint or of the flange in time, the likelier of the two; None without any.

    Where the two are within 20 to 1, its words name both.
    """
    errors = list[RepeatingError]()
    effects = significant_joint_effects(linear)
    if effects:
        which = " or ".join(effect.place for effect in sorted(effects, key=lambda effect: effect.joint))
        followed = dict.fromkeys(covariate for effect in effects for covariate in effect.may_follow)
        # Of functions that nobody knows none is certain to be of the kind that explains most.
        words = f"come from {which} above all, likeliest by {' or '.join(followed)}"
        if JOINT_ANGLES in followed:
            words = f"{_FOLLOW_JOINTS}, {which} above all"
        factor = effects[0].log_bayes_factor
        errors.append(RepeatingError(words, factor, joints=True, of_one=True, joint_effects=effects))
    fitted = significant_time_effect(linear)
    if fitted is not None:
        words, factor = fitted.process.words, fitted.log_bayes_factor
        curve = time_curve(fitted)
        errors.append(RepeatingError(words, factor, joints=False, of_one=True, curve=curve, process=fitted))
    errors.sort(key=lambda error: -error.log_bayes_factor)
    if len(errors) == 2 and errors[0].log_bayes_factor - errors[1].log_bayes_factor < limits.ODDS:
        return replace(errors[0], words=f"{errors[0].words}, or {errors[1].words}")
    return errors[0] if errors else None


def _trend_errors(linear: LinearModel) -> tuple[RepeatingError, ...]:
    """Return the likeliest smooth trend as a repeating error, where it is 20 to 1 likelier than scatter; else ().

    It is for poses that scatter independently. The number of trends that were tried is charged for.

    Scatter of the joints counts here, as what repeats least resembles it. It does not where names are asked for: an arm
    that errs by many small effects at once seems to scatter by its joints, and of two tracked arms of one series one
    was then not what it was named for on the other's poses.
    """
    trends = unmodelled_trends(linear.restricted({JOINT_SCATTER}))
    trend = next((trend for trend in trends if trend.log_bayes_factor > limits.ODDS), None)
    if trend is None:
        return ()
    words = _WANDER_IN_TIME if trend.joint is None else f"{_FOLLOW_JOINTS}, joint {trend.joint} above all"
    return (RepeatingError(words, trend.log_bayes_factor, trend.joint is not None, process=trend),)


def _deviance_without(linear: LinearModel, kind: tuple[str, ...]) -> float:
    """Return the deviance of the null fit without some components of the pose errors, by name: the lesser of two fits.

    One begins at the variances of the null fit; the other at those without any pose errors, which start small.
    """
    assert linear.pose_errors is not None and linear.mixed.further is not None
    keep = np.array([name not in kind for name in linear.pose_errors.names], bool)
    components = np.append(np.ones(NOISE + 1, bool), keep)
    further = linear.mixed.further.select(keep)
    mixed = replace(linear.mixed, components=linear.mixed.components[components], further=further)
    nearly_absent = np.append(linear.restricted(()).null.variances, 1e-2 * further.scales**2)
    starts = (linear.null.variances[components], nearly_absent)
    return min(fit_variances(mixed, start=start).deviance for start in starts)
