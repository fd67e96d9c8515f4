"""Are all clouds of a session in one unit? A few of another one are wrong by themselves, not by the session's unit."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stitch.errors import InputError

_LISTED_CLOUDS = 4


def is_plausible_size(size_m: float, limits: tuple[float, float]) -> bool:
    """Whether a size, m, can be; 0 says nothing."""
    return limits[0] <= size_m <= limits[1] or size_m == 0


def length_message(size_m: float) -> str:
    """A length for a message."""
    return f"{size_m * 1e3:.3g} mm" if size_m < 1 else f"{size_m:.3g} m"


def require_one_unit(
    toml: Path, sizes: Mapping[str, float], limits: tuple[float, float], does: str, cloud_unit: str
) -> None:
    """Refuse a few clouds whose size only makes sense in another unit than that of the others.

    Args:
        sizes: by view, m.
        does: what a cloud does over that size, with {} in its place.

    Raises:
        InputError: names the views, and how to fix it.
    """
    odd = {name: size for name, size in sizes.items() if not is_plausible_size(size, limits)}
    others = [size for name, size in sizes.items() if name not in odd]
    if not odd or len(odd) > len(others):
        return
    one = len(odd) == 1
    names = ", ".join([*odd][:_LISTED_CLOUDS]) + " …" * (len(odd) > _LISTED_CLOUDS)
    size, usual = (length_message(float(np.median(found))) for found in ([*odd.values()], others))
    raise InputError(
        f"{toml}: the points of view{'' if one else 's'} {names} {does.format(size)}, those of the others (usually) "
        f'{usual}, with cloud_unit = "{cloud_unit}": {"that cloud alone is" if one else "those clouds are"} in another '
        f"unit than the others; to fix: export {'it' if one else 'them'} again in {cloud_unit}"
    )
