"""Which samples take no part in the fit: blocks of them, from every region of the states."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from phihp_torchrl.identification.windows import Samples, cut

BINS = 3
"""Parts into which the range of each state, and of its change within a block, is divided."""
_SHARE = 5
"""One block in so many is held out."""

Span = tuple[int, int]


def hold_out(
    samples: Samples, spans: Sequence[Span], length: int, past: int, ahead: int
) -> tuple[list[Span], list[Span]]:
    """Divide spans of samples into what is fitted and what is held out.

    The spans are cut into blocks. Blocks of a kind (the same third of the range of every state, and
    of how much it changes within the block) stand together, and every fifth of that order is held
    out, so that each region is covered by its share; a region of which all blocks are fitted gives
    one if it has two.

    Args:
        samples: the recordings.
        spans: usable samples, each within one recording.
        length: samples in a block.
        past: samples that a prediction needs before it; they may lie before the block.
        ahead: samples that are predicted, all in the block; other blocks are never held out.

    Returns:
        Spans to fit, and held-out spans, both in the order of time.
    """
    blocks = cut(spans, length, 1)
    begin = {a: begun for begun, end in spans for a, b in blocks if begun <= a and b <= end}
    able = [i for i, (a, b) in enumerate(blocks) if max(a, begin[a] + past) + ahead <= b]
    if len(able) < 2:
        return list(spans), []
    kinds = _kinds(samples, [blocks[i] for i in able])
    order = sorted(range(len(able)), key=lambda i: (kinds[i].tolist(), able[i]))
    held = set(order[_SHARE // 2 :: _SHARE] or order[:1])
    for column in range(kinds.shape[1]):
        for value in range(BINS):
            rows = (kinds[:, column] == value).nonzero().flatten().tolist()
            if len(rows) > 1 and not held.intersection(rows) and len(held) < len(able) // 3:
                held.add(rows[len(rows) // 2])
    chosen = {able[i] for i in held}
    out = [blocks[i] for i in sorted(chosen)]
    kept: list[Span] = []
    for i, (a, b) in enumerate(blocks):
        if i in chosen:
            continue
        joins = bool(kept) and kept[-1][1] == a and (i - 1) not in chosen
        if joins and samples.stretch[kept[-1][0]] == samples.stretch[a]:
            kept[-1] = (kept[-1][0], b)
        else:
            kept.append((a, b))
    return kept, out


def region(values: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """The number of the part of a range in which values lie, 0 to ``BINS - 1``."""
    share = (values - low) / (high - low).clamp_min(1e-12)
    return (share.nan_to_num(0.5) * BINS).long().clamp(0, BINS - 1)


def _kinds(samples: Samples, blocks: Sequence[Span]) -> Tensor:
    """Regions of mean and range of each measured state in each block, ``[blocks, 2 k]``."""
    columns = []
    for column in samples.state.unbind(-1):
        if not column.isfinite().any():
            continue
        parts = [column[a:b][column[a:b].isfinite()] for a, b in blocks]
        parts = [part if len(part) else column.new_tensor([torch.nan]) for part in parts]
        for feature in (
            torch.stack([part.mean() for part in parts]),
            torch.stack([part.max() - part.min() for part in parts]),
        ):
            known = feature[feature.isfinite()]
            columns.append(region(feature, known.min(), known.max()))
    return torch.stack(columns, -1)
