"""Where each of several scanners in one cell stands under their common model, beside what its own views alone say."""

from dataclasses import dataclass, field

import numpy as np

from stitch.effects.axis_effects import SCANNER_PLACEMENT
from stitch.model.model import COVERAGE_FACTOR, Model, displacement
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import length_text
from stitch.observations.observability import seen_part, unknown_numbers, unobservable
from stitch.session.measurement import Measurement
from stitch.system.values import Value

# Alone and together share a scanner's own views: what they differ by is less than the U of alone says. Beyond this
# multiple of it the scanners contradict each other (custom).
_CONTRADICTS = 1.5


@dataclass(frozen=True, eq=False)
class ScannerAlone(Value):
    """The hand-eye of one scanner from its own views alone.

    Example:
        >>> run.alone
        ()
    """

    scanner: str
    hand_eye: Array  # (4, 4) T_mount_scanner
    covariance: Array  # (6, 6) of T·exp(ξ)


@dataclass(frozen=True, eq=False)
class ScannerPlace(Value):
    """One scanner where a model of several puts it; lengths in length_unit, angles in rad.

    Example:
        >>> [scanner.name for scanner in run.scanners]
        []
    """

    name: str
    T_mount: Array  # (4, 4) T_base_scanner or T_flange_scanner
    covariance: Array  # (6, 6) of T·exp(ξ), rotation first
    U: float  # expanded uncertainty (k = 2) of the middle of what it saw
    alone: ScannerAlone | None = None
    U_alone: float = float("nan")  # the same by its own views alone
    apart: float = float("nan")  # distance between where its own views alone and all views put that middle
    unobservable: tuple[str, ...] = ()  # directions of its hand-eye that the motions do not show, in words
    unknown: tuple[str, ...] = field(default=())  # those of x, y, z, rx, ry, rz that they do not determine

    @property
    def sigma(self) -> Array:
        """(6,) standard deviations of T·exp(ξ), rad before length_unit."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def contradicts(self) -> bool:
        """Whether its own views put it elsewhere than the others do, beyond what their U allows."""
        return self.apart > _CONTRADICTS * self.U_alone


def scanner_places(
    measurement: Measurement, model: Model, alone: tuple[ScannerAlone, ...] = ()
) -> tuple[ScannerPlace, ...]:
    """Return where each of several scanners stands, with covariance and U, under a model of all; () of one scanner.

    T_mount_scanner k is T_mount · T_first_scanner(k): the hand-eye of the first scanner, and a part of the model, the
    effect `SCANNER_PLACEMENT`, for where the others stand from it. The covariance follows by J Σ Jᵀ from both.

    Args:
        alone: hand-eyes that single scanners have from their own views alone; the places say how far they are off.
    """
    scanners = measurement.views.scanners
    capture = measurement.capture
    term = next((term for term in model.terms if term.name == SCANNER_PLACEMENT), None)
    if not scanners or term is None:
        return ()
    K = len(scanners.names) - 1
    # The parameters are ordered rotation vectors of all scanners, then translations; here they go scanner by scanner.
    order = np.arange(6 * K).reshape(2, K, 3).transpose(1, 0, 2).reshape(K, 6)
    twists = np.vstack([np.zeros(6), term.values[order]])
    alone_by_name = {own.scanner: own for own in alone}
    places = []
    for k, name in enumerate(scanners.names):
        T_first_scanner = scanners.T_first[k] @ frames.exp(twists[k])
        T_mount = model.T_mount @ T_first_scanner
        # A twist of the first scanner's hand-eye, seen in this scanner's frame, and one of its place from the first.
        J = np.hstack([frames.adjoint(frames.inverse(T_first_scanner)), np.eye(6)])
        # The first scanner's place is the hand-eye: its six parameters are none, and do not vary.
        parameters = [f"{term.name}.{term.parameters[i].name}" for i in order[k - 1]] if k else 6 * [""]
        covariance = J @ model.covariance_with(parameters) @ J.T
        middle = seen_part([capture], k)[0]
        own = alone_by_name.get(name)
        U_alone = apart = float("nan")
        if own is not None:
            U_alone = displacement(own.covariance, middle)
            offset = frames.transform(own.hand_eye, middle) - frames.transform(T_mount, middle)
            apart = float(np.linalg.norm(offset))
        places.append(
            ScannerPlace(
                name=name,
                T_mount=T_mount,
                covariance=covariance,
                U=displacement(covariance, middle),
                alone=own,
                U_alone=U_alone,
                apart=apart,
                unobservable=unobservable([capture], model.T_mount, measurement.robot, scanner=k),
                unknown=unknown_numbers([capture], model.T_mount, k),
            )
        )
    return tuple(places)


def contradictions(places: tuple[ScannerPlace, ...], length_unit: str) -> tuple[str, ...]:
    """Return a warning for each scanner whose own views place it elsewhere than the views of all do, beyond its U."""
    return tuple(
        f"scanner {p.name} contradicts the others: its own views put it {length_text(p.apart, length_unit)} away where "
        f"U (k = {COVERAGE_FACTOR:g}) is {length_text(p.U_alone, length_unit, 2)}; to fix: check that part, arm and "
        "clock of the sessions are the same; `stitch diagnose` asks what a scanner does wrong"
        for p in places
        if p.contradicts
    )
