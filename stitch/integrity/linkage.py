"""Which views hold each other: the graph of overlaps, its components and its weak places.

Two views are linked if most of their correspondences close within the robust gate. A pair that only lies near,
with surfaces that cross, has correspondences too, but they do not close: it links nothing, and the robust weights
of the fit ignore it without a word. That is how a displaced view used to end at an rms of zero.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stitch.frames import Indices, Mask
from stitch.observations.surfaces.overlaps import Overlaps

# Share of a pair's correspondences within four robust sigmas. Pairs of good sessions have 0.7 to 1, simulated and
# real; pairs with a view displaced by more than the gate 0 to 0.3.
LINKED_SHARE = 0.5
# Correspondences that determine six numbers with some to spare.
HOLDING = 20


@dataclass(frozen=True)
class Link:
    """How two views meet."""

    v: int
    w: int
    count: int  # correspondences within the robust gate
    share: float  # of all correspondences of the pair, 0 … 1

    @property
    def holds(self) -> bool:
        """True if the pair says something about its two poses."""
        return self.share >= LINKED_SHARE and self.count >= HOLDING


@dataclass(frozen=True)
class Linkage:
    """The graph of overlaps of V views; components are sorted, largest first."""

    views: int
    links: tuple[Link, ...]
    components: tuple[tuple[int, ...], ...]
    single: tuple[tuple[int, int], ...]  # (view, partner): held by this one pair alone

    @property
    def core(self) -> tuple[int, ...]:
        """The largest component."""
        return self.components[0]

    @property
    def unlinked(self) -> tuple[int, ...]:
        """Views outside the largest component."""
        return tuple(sorted(v for part in self.components[1:] for v in part))

    def share(self, view: int) -> float:
        """Share of the correspondences of a view that close, over all its pairs; 0 without any."""
        own = [link for link in self.links if view in (link.v, link.w)]
        total = sum(link.count / link.share for link in own if link.share > 0)
        return sum(link.count for link in own) / total if total else 0.0


def linkage(overlaps: Overlaps, holding_nothing: Collection[int] = ()) -> Linkage:
    """Components, and views held by a single pair, from the correspondences at the poses of `overlaps`.

    Args:
        holding_nothing: views whose scans hold no pose, however well they lie on the others.
    """
    views = overlaps.gram.views
    found = {(m.v, m.w): len(m.residual) for m in overlaps.matches}
    links = []
    for i, (v, w) in enumerate(overlaps.gram.pairs):
        if overlaps.gram.labelled[i]:
            # Common targets have names: they always belong together.
            links.append(Link(int(v), int(w), HOLDING, 1.0))
        elif v in holding_nothing or w in holding_nothing:
            continue
        elif found.get((int(v), int(w))):
            count = int(overlaps.gram.count[i])
            links.append(Link(int(v), int(w), count, count / found[int(v), int(w)]))
    return linkage_of_links(views, links)


def linkage_of_links(views: int, links: Sequence[Link]) -> Linkage:
    """The linkage of V views from their links."""
    near = np.zeros((views, views), bool)
    for link in links:
        near[link.v, link.w] = near[link.w, link.v] = link.holds
    single = [(v, int(np.argmax(near[v]))) for v in range(views) if near[v].sum() == 1]
    return Linkage(views, tuple(links), _connected_components(near), tuple(single))


def _connected_components(near: Mask) -> tuple[tuple[int, ...], ...]:
    """Connected components of an adjacency (V, V), largest first."""
    count, label = connected_components(coo_array(near), directed=False)
    parts = [tuple(int(v) for v in np.flatnonzero(label == k)) for k in range(count)]
    return tuple(sorted(parts, key=lambda part: (-len(part), part)))


def names_of_views(indices: Indices | Sequence[int], names: Sequence[str]) -> list[str]:
    """Names of some views."""
    return [names[int(v)] for v in indices]
