"""What an arm's model does on other sessions of the same arm: an effect stays that holds on all of them.

What imitates the arm among the poses of one day may err at those of another. Base, tool and targets of every session
are fitted with either arm, so that nothing but the arm makes the difference.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.api.pipeline import change, run
from stitch.errors import InputError
from stitch.model.model_toml import ModelFile, arm_model
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import significantly_smaller
from stitch.numerics.units import length_text
from stitch.output.result_document import model_of
from stitch.run_data import RunData
from stitch.session.session import SessionData

# That an effect is taken out which does nothing there, all effects counted (custom).
_CHANCE = 0.05
UNASKED = "No other session of the arm was asked: what its model leaves there is not known; name one with --on."
# Mean squares by the names of views.
Squares = dict[str, float]


@dataclass(frozen=True)
class Proof:
    """Rms over the views of a session that took no part in an arm's model, length_unit of the session."""

    session: str
    length_unit: str
    rms: float
    nominal_rms: float

    @property
    def worse(self) -> bool:
        """True if the nominal arm leaves less."""
        return self.rms > self.nominal_rms

    @property
    def sentence(self) -> str:
        """What was proved there."""
        here, nominal = (length_text(x, self.length_unit) for x in (self.rms, self.nominal_rms))
        return f"On session {self.session}, which took no part, it leaves {here}, the nominal arm {nominal}."


def keep_what_holds(calibrated: RunData, others: Sequence[SessionData]) -> tuple[RunData, list[str]]:
    """Return the run with those effects of its arm that hold on all sessions, fitted anew, and what was proved where.

    Raises:
        InputError: a session without a robot, or with another.
        NoResultError: a session that cannot be run.
    """
    nominal = [_squares(session, None) for session in others]
    taken_out = list[str]()
    here, left = calibrated, [_squares(session, _arm_of(calibrated)) for session in others]
    while others and (of_arm := _arm_effects(here)):
        tried = {}
        for name in of_arm:
            less = change(here, [effect for effect in here.effects if effect != name])
            tried[name] = less, [_squares(session, _arm_of(less)) for session in others]
        name = min(tried, key=lambda effect: _share(tried[effect][1], nominal))
        less, rest = tried[name]
        worse = [k for k, session in enumerate(others) if _rms(left[k], nominal[k]) > _rms(nominal[k], left[k])]
        idle = significantly_smaller(_joined(rest, nominal), _joined(left, nominal), _CHANCE / len(tried))
        if not worse and not idle:
            break
        at = worse[0] if worse else int(np.argmax([_rms(a, b) - _rms(b, a) for a, b in zip(left, rest, strict=True)]))
        with_it, without = (length_text(_rms(x[at], nominal[at]), others[at].length_unit) for x in (left, rest))
        taken_out.append(
            f"Taken out: {name}, which holds on {calibrated.session.name} alone; on session {others[at].name} the arm "
            f"leaves {with_it} with it and {without} without."
        )
        here, left = less, rest
    proofs = [proof.sentence for proof in _proofs(others, left, nominal)]
    return here, [*taken_out, *proofs] or [UNASKED]


def prove(arm: ModelFile, others: Sequence[SessionData]) -> tuple[Proof, ...]:
    """Return what an arm as it is leaves on other sessions, beside the nominal one.

    Raises:
        InputError, NoResultError: as `keep_what_holds`.
    """
    nominal = [_squares(session, None) for session in others]
    return _proofs(others, [_squares(session, arm) for session in others], nominal)


def require_held(arm: ModelFile, others: Sequence[SessionData]) -> tuple[Proof, ...]:
    """Return the same, and refuse an arm that makes a session worse.

    Raises:
        InputError: it does, or as `keep_what_holds`.
    """
    proofs = prove(arm, others)
    for proof in proofs:
        if proof.worse:
            raise InputError(
                f"the arm ({', '.join(arm.effects)}) makes another session worse. {proof.sentence.rstrip('.')}; "
                f"to fix: `stitch calibrate robot SESSION --on {proof.session}` keeps what holds on both"
            )
    return proofs


def _proofs(others: Sequence[SessionData], left: Sequence[Squares], nominal: Sequence[Squares]) -> tuple[Proof, ...]:
    return tuple(
        Proof(session.name, session.length_unit, _rms(here, plain), _rms(plain, here))
        for session, here, plain in zip(others, left, nominal, strict=True)
    )


def _arm_of(state: RunData) -> ModelFile | None:
    return arm_model(model_of(state))


def _arm_effects(state: RunData) -> list[str]:
    arm = _arm_of(state)
    return [] if arm is None else list(arm.effects)


def _squares(session: SessionData, arm: ModelFile | None) -> Squares:
    """Return mean squares of the views of a session, by their names, with an arm that is kept as it is."""
    judged = run(session, arm=arm)
    return dict(zip(judged.session.names, np.asarray(judged.view_rms, float) ** 2, strict=True))


def _rms(squares: Squares, others: Squares) -> float:
    """Return the rms over the views that both have."""
    return float(np.sqrt(np.mean([squares[view] for view in squares if view in others])))


def _share(squares: Sequence[Squares], nominal: Sequence[Squares]) -> float:
    """Return the mean over the sessions of what is left of the nominal arm's mean squares."""
    return float(np.mean([(_rms(a, b) / _rms(b, a)) ** 2 for a, b in zip(squares, nominal, strict=True)]))


def _joined(squares: Sequence[Squares], nominal: Sequence[Squares]) -> Array:
    """(ΣV,) mean squares of all views, each session in units of what its nominal arm leaves; NaN where left out."""
    return np.concatenate(
        [
            [of.get(view, np.nan) / _rms(plain, plain) ** 2 for view in plain]
            for of, plain in zip(squares, nominal, strict=True)
        ]
    )
