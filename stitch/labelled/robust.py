"""The fit with gross errors taken out, one round after another."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from stitch.effects.chain import Chain, Term
from stitch.effects.undo import corrected
from stitch.errors import NoResultError
from stitch.frames import Array
from stitch.labelled.fit import LabelledFit, fit
from stitch.labelled.gross import Outlier, gross, outside
from stitch.labelled.landmarks import Drawing, settled


def robust_fit(
    chain: Chain, terms: Sequence[Term], T_mount: Array, drawing: Drawing | None
) -> tuple[LabelledFit, Chain, list[Outlier]]:
    """The fit with gross errors taken out; the chain that is left, and what was taken.

    Raises:
        NoResultError: more than a third of what was seen would have to go.
    """
    found: LabelledFit | None = None

    def examine(chain: Chain) -> LabelledFit:
        nonlocal found
        begin, T = (terms, T_mount) if found is None else (found.terms, found.T_mount)
        found = fit(chain, begin, T, settled(corrected(chain, begin, T), T, drawing))
        return found

    return without_gross(chain, examine)


def without_gross(chain: Chain, examine: Callable[[Chain], LabelledFit]) -> tuple[LabelledFit, Chain, list[Outlier]]:
    """Examine a chain, take out what is off, and again, until nothing is.

    Raises:
        NoResultError: more than a third of what was seen would have to go.
    """
    assert chain.capture.sightings is not None
    chain = replace(chain, capture=replace(chain.capture, sightings=chain.capture.sightings.everything))
    taken = list[Outlier]()
    while True:
        found = examine(chain)
        worse = gross(found.rows, found.variances)
        if not worse:
            return found, chain, taken
        taken += worse
        chain = taken_out(chain, worse)


def taken_out(chain: Chain, worse: Sequence[Outlier]) -> Chain:
    """The chain without some of its labelled points.

    Raises:
        NoResultError: more than a third of what was seen would be gone.
    """
    sightings = chain.capture.sightings
    assert sightings is not None
    used = outside(sightings.used, worse, sightings.targets, sightings.target)
    if used.sum() < 2 * sightings.everything.used.sum() / 3:
        raise NoResultError(
            f"{chain.capture.name}: more than a third of the labelled points contradict the rest; check the names "
            "of the targets, the order of the views, mount and pose convention"
        )
    return replace(chain, capture=replace(chain.capture, sightings=replace(sightings, used=used)))
