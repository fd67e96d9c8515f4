"""Decompress LZF (Marc Lehmann's LibLZF), the packing of PCD's binary_compressed.

Own code because the packages that bind LibLZF have no wheels, and a bare machine has no compiler.
"""


def decompress(packed: bytes, size: int) -> bytes | None:
    """The `size` bytes behind `packed`; None if the data are corrupt."""
    out = bytearray()
    i, end = 0, len(packed)
    try:
        while i < end:
            control = packed[i]
            i += 1
            if control < 32:  # a run of literals
                out += packed[i : i + control + 1]
                i += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[i]
                i += 1
            start = len(out) - ((control & 31) << 8) - packed[i] - 1
            i += 1
            if start < 0:
                return None
            length += 2
            period = len(out) - start
            if period >= length:
                out += out[start : start + length]
            else:  # the copy reads what it writes: a repeating pattern
                out += (bytes(out[start:]) * (length // period + 1))[:length]
    except IndexError:
        return None
    return bytes(out) if len(out) == size else None
