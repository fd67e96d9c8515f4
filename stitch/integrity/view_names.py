"""Names of views in a message: the first few, and those that follow each other in the session as a range."""

from collections.abc import Sequence

# Names or ranges that a message lists, and how many views in a row make a range.
_LISTED, _RANGE = 6, 3


def list_views(names: Sequence[str], order: Sequence[str]) -> str:
    """Some views in words: "v000–v102, v105 … and 97 more".

    Args:
        order: names of all views as they follow each other in the session.
    """
    place = {name: at for at, name in enumerate(order)}
    rows = list[list[str]]()
    for name in names:
        follows = rows and name in place and place.get(rows[-1][-1]) == place[name] - 1
        rows[-1].append(name) if follows else rows.append([name])
    said = [part for row in rows for part in ([row] if len(row) >= _RANGE else [[name] for name in row])]
    shown = ", ".join(f"{part[0]}–{part[-1]}" if len(part) > 1 else part[0] for part in said[:_LISTED])
    rest = sum(map(len, said[_LISTED:]))
    return shown + (f" … and {rest} more" if rest else "")
