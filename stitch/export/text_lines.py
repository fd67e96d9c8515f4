"""Numbers and comments as other programs read them."""

from collections.abc import Iterable, Sequence

import numpy as np


def digits(x: float) -> str:
    """Shortest decimals that read back as the same float64, without an exponent that some readers do not take."""
    return np.format_float_positional(x + 0.0, trim="0")


def row(numbers: Iterable[float], separator: str = " ") -> str:
    """Several of them."""
    return separator.join(digits(x) for x in numbers)


def commented(mark: str, lines: Sequence[str], end: str = "") -> str:
    """Lines of comment between a mark and an end."""
    return "".join(f"{mark}{' '.join(line.split())}{end}\n" for line in lines)


def xml_comment(lines: Sequence[str]) -> str:
    """The same in XML, where two hyphens would end a comment."""
    return commented("<!-- ", [line.replace("--", "–") for line in lines], " -->")
