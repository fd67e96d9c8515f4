"""Blocks of several sessions as those of one: numbers that the smaller blocks lack are absent."""

from collections.abc import Sequence

import numpy as np

from stitch.frames import Array
from stitch.statistics.restricted_likelihood import MixedModel


def block_columns(columns: Sequence[Array]) -> Array:
    """(ΣB, m, Σa) columns (B, m, a) of unknowns that every session has for itself."""
    if len(columns) == 1:
        return columns[0]
    widths = np.cumsum([0, *(c.shape[2] for c in columns)])
    every = []
    for c, at in zip(columns, widths[:-1], strict=True):
        wide = np.zeros((*c.shape[:2], widths[-1]))
        wide[..., at : at + c.shape[2]] = c
        every.append(wide)
    return stack_blocks(every)


def stack_blocks(blocks: Sequence[Array]) -> Array:
    """(ΣB, m, …) blocks (B, m, …) of several sessions."""
    if len(blocks) == 1:
        return blocks[0]
    m = max(b.shape[1] for b in blocks)
    return np.concatenate([np.pad(b, [(0, 0), (0, m - b.shape[1]), *[(0, 0)] * (b.ndim - 2)]) for b in blocks])


def stack_mixed_models(mixed: Sequence[MixedModel], A: Array) -> MixedModel:
    """Mixed models of sessions that scatter alike, with columns A (ΣB, m, a) of the free mean of all."""
    if len(mixed) == 1:
        return mixed[0]
    m = max(own.z.shape[1] for own in mixed)

    def wide(matrices: Array, absent: float = 0.0) -> Array:
        lacking = m - matrices.shape[-1]
        out = np.pad(matrices, [*[(0, 0)] * (matrices.ndim - 2), (0, lacking), (0, lacking)])
        more = np.arange(m - lacking, m)
        out[..., more, more] = absent
        return out

    fixed = [np.zeros((*own.z.shape, own.z.shape[1])) if own.fixed is None else own.fixed for own in mixed]
    return MixedModel(
        z=stack_blocks([own.z for own in mixed]),
        A=A,
        components=np.concatenate([wide(own.components) for own in mixed], axis=1),
        fixed=np.concatenate([wide(own, absent=1.0) for own in fixed]),
        independent=sum(own.size for own in mixed),
    )
