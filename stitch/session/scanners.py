"""Sessions of several scanners in one cell as one session: every view knows whose it is.

One arm, its axes and one part are common; each scanner has a hand-eye of its own. That of the first is the model's.
Another stands a rigid motion right of it, `T_first`, in its own views; where it truly stands is fitted from there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.kernels import same_stop
from stitch.session.session import SessionData


@dataclass(frozen=True)
class Scanners:
    """The K scanners of V views of a joined session; empty, and false, for a session of one scanner."""

    names: tuple[str, ...] = ()
    of_view: Indices = field(default_factory=partial(np.arange, 0))  # (V,) index of each view's scanner
    T_first: Array = field(default_factory=partial(np.zeros, (0, 4, 4)))  # (K, 4, 4) T_scanner1_scanner, to begin with
    standoff: tuple[float | None, ...] = ()  # length_unit; None: not stated

    def __bool__(self) -> bool:
        return bool(self.names)

    @property
    def behind(self) -> Array | None:
        """(V, 4, 4) transforms multiplied to the right of the first scanner's hand-eye; None for one scanner."""
        return self.T_first[self.of_view] if self else None

    def only(self, keep: Sequence[int]) -> "Scanners":
        """Return the scanners of some of the views."""
        return replace(self, of_view=self.of_view[list(keep)]) if self else self

    def masks(self, count: int) -> list[Mask]:
        """Return (V,) bool, the views of each scanner; one scanner has all `count`."""
        return [self.of_view == k for k in range(len(self.names))] if self else [np.ones(count, bool)]


def scanners_of(session: SessionData) -> Scanners:
    """Return the scanners of a session joined from several; an empty one of any other.

    A hand-eye that is not stated counts as the identity: `T_first` is only where the fit begins.
    """
    if not session.parts:
        return Scanners()
    mounts = [part.scanner.T_mount for part in session.parts]
    known = [np.eye(4) if T is None else T for T in mounts]
    return Scanners(
        tuple(part.scanner.name for part in session.parts),
        np.array([view.scanner for view in session.views], np.int64),
        np.array([frames.inverse(known[0]) @ T for T in known]),
        tuple(part.scanner.standoff for part in session.parts),
    )


def stops_of(session: SessionData) -> Indices:
    """Return the index (V,) of the stop of each view of a joined session, numbered in the order of their first view.

    Views of one stop have the same flange pose, and each comes from another scanner. Where all views state their time,
    they follow each other: a pose that the arm returns to is another stop.
    """
    views = session.views
    same = same_stop(np.array([view.T_base_flange for view in views]))
    is_in_order = all(view.time_s is not None for view in views)
    stops = list[list[int]]()  # the views of each stop
    for v, view in enumerate(views):
        candidates = stops[-1:] if is_in_order else stops
        shared = [s for s in candidates if same[v, s[0]] and all(views[w].scanner != view.scanner for w in s)]
        if shared:
            shared[0].append(v)
        else:
            stops.append([v])
    stop_of_view = np.empty(len(views), np.int64)
    for number, stop in enumerate(stops):
        stop_of_view[stop] = number
    return stop_of_view


def have_own_hand_eyes(sessions: Sequence[SessionData]) -> bool:
    """Return True if sessions of scans are from different scanners in one cell, by their names: they are joined.

    Raises:
        InputError: a scanner without a name beside others, or two sessions of one scanner beside another's.
    """
    names = [session.scanner.name for session in sessions]
    if len(set(names)) < 2 or not all(session.has_clouds for session in sessions):
        return False
    odd = next((s for s in sessions if not s.scanner.name or names.count(s.scanner.name) > 1), None)
    if odd is not None:
        raise InputError(
            f"{odd.path}: scanner.name is {odd.scanner.name!r} beside {', '.join(map(repr, names))}; to fix: name "
            "every scanner, and give one session a scanner"
        )
    return True


def join_sessions(sessions: Sequence[SessionData]) -> SessionData:
    """Return one session with the views of all, each named VIEW@SCANNER, sorted by time where all views state it.

    All else is the first session's: arm, axes, and the hand-eye `scanner.T_mount`, which the others are counted from.
    Noise and kind of the sensor stay only where all sessions agree.
    """
    first = sessions[0]
    views = [
        replace(view, name=f"{view.name}@{session.scanner.name}", scanner=k)
        for k, session in enumerate(sessions)
        for view in session.views
    ]
    times = [view.time_s for view in views if view.time_s is not None]
    if len(times) == len(views):
        views = [views[i] for i in np.argsort(times, kind="stable")]
    noise = {session.scanner.noise for session in sessions}
    kinds = {session.scanner.kind for session in sessions}
    scanner = replace(
        first.scanner,
        name="",
        noise=noise.pop() if len(noise) == 1 else None,
        kind=kinds.pop() if len(kinds) == 1 else None,
        standoff=None,
    )
    return replace(
        first,
        name="+".join(session.name for session in sessions),
        scanner=scanner,
        views=tuple(views),
        warnings=tuple(warning for session in sessions for warning in session.warnings),
        parts=tuple(sessions),
        # What was guessed when the sessions were made, by key: of one key the last session's counts.
        usual=dict(guess for session in sessions for guess in session.usual.items()),
    )
