"""Licences of all that every installation brings: python bench/licences.py, as `make lint` does.

Walks from the plain dependencies of this package through those of each, as the installed metadata names them. One of
GPL or AGPL is refused: whoever ships a cell could not ship it. Those of LGPL are listed; they are used as they come.
"""

import re
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from stitch.system.packages import DISTRIBUTION

_STRONG = re.compile(r"\bA?GPL|(?<!Lesser )General Public License|Affero", re.IGNORECASE)
_WEAK = re.compile(r"\bLGPL|Lesser General Public", re.IGNORECASE)


def licence(metadata: Distribution) -> str:
    """Return what a distribution says of its licence, the most exact of it; "" where it says nothing."""
    fields = metadata.metadata
    if stated := fields.get("License-Expression"):
        return stated
    classifiers = [line for line in fields.get_all("Classifier") or () if line.startswith("License ::")]
    names = [line.rpartition(" :: ")[2] for line in classifiers if not line.endswith(":: OSI Approved")]
    # Some put the whole text there: its first line names it.
    return "; ".join(names) or next(iter((fields.get("License") or "").strip().splitlines()), "")


def brought(root: str = DISTRIBUTION) -> dict[str, Distribution]:
    """Return all that an installation of a distribution without extras brings here, by name, without itself."""
    seen: dict[str, Distribution] = {}
    waiting = [(root, "")]
    asked = set()
    while waiting:
        name, extra = waiting.pop()
        if (name, extra) in asked:
            continue
        asked.add((name, extra))
        try:
            found = seen[name] = distribution(name)
        except PackageNotFoundError:  # another platform's, or one that was taken away here
            continue
        for text in found.requires or ():
            needed = Requirement(text)
            if needed.marker is None or needed.marker.evaluate({"extra": extra}):
                waiting += [(canonicalize_name(needed.name), e) for e in ("", *needed.extras)]
    del seen[root]
    return dict(sorted(seen.items()))


def kind(stated: str) -> str:
    """Return "GPL", "LGPL", or "" for a licence that asks for less; of a choice ("MIT OR GPL") the least counts."""
    kinds = []
    for choice in re.split(r"\bOR\b", stated):
        weak = bool(_WEAK.search(choice))
        strong = bool(_STRONG.search(_WEAK.sub("", choice)))
        kinds.append("GPL" if strong else "LGPL" if weak else "")
    return min(kinds, key=("", "LGPL", "GPL").index)


def complaints(licences: dict[str, str]) -> list[str]:
    """Return a sentence for each package of GPL or AGPL, and for each that states no licence."""
    refused = [
        f"{name}: {stated}; an extra may bring it, the base may not"
        for name, stated in licences.items()
        if kind(stated) == "GPL"
    ]
    silent = [
        f"{name}: states no licence; look it up before it comes with the base"
        for name, stated in licences.items()
        if not stated
    ]
    return refused + silent


if __name__ == "__main__":
    found = {name: licence(metadata) for name, metadata in brought().items()}
    weak = [f"{name} ({stated})" for name, stated in found.items() if kind(stated) == "LGPL"]
    print(f"{len(found)} packages of the base; of LGPL, used as they come: {', '.join(weak) or 'none'}")
    sys.exit("\n".join(complaints(found)) or 0)
