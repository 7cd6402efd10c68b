"""Random generators in pickles, by their state as bytes."""

from __future__ import annotations

import torch

Packed = tuple[str, bytes]
"""The device of a generator, and its state."""


def pack_generator(generator: torch.Generator | None) -> Packed | None:
    """Return a generator as plain values, from which :func:`unpack_generator` makes an equal one.

    A generator pickles itself by a tensor that nobody keeps. Where tensors are sent to a spawned
    process they go as open files, and the file of such a tensor is closed before the process reads
    it. Plain bytes go along.

    Examples:
        >>> generator = torch.Generator().manual_seed(3)
        >>> again = unpack_generator(pack_generator(generator))
        >>> torch.rand(1, generator=again) == torch.rand(1, generator=generator)
        tensor([True])
    """
    if generator is None:
        return None
    return str(generator.device), bytes(generator.get_state().tolist())


def unpack_generator(packed: Packed | None) -> torch.Generator | None:
    """Return the generator that :func:`pack_generator` was given, as a new one."""
    if packed is None:
        return None
    device, state = packed
    generator = torch.Generator(device)
    return generator.set_state(torch.tensor(list(state), dtype=torch.uint8))
