"""Where imagined episodes start: the strongest lever on how fast the policy learns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

import torch
from torch import Tensor

from phihp_torchrl.tasks import Box, Task


class StartStates(Protocol):
    """Anything that draws states to start from.

    Draws are made on the generator's own device (the CPU if there is none) and then moved, so a
    seed gives the same states on every device.
    """

    def sample(
        self,
        shape: Sequence[int],
        generator: torch.Generator | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw states ``[*shape, n]``, float32."""


class BoxStates:
    """States drawn uniformly from a box.

    Args:
        box: the box.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> BoxStates(get_task("pendulum").reset).sample([5]).shape
        torch.Size([5, 2])
    """

    def __init__(self, box: Box) -> None:
        self.box = box

    def sample(
        self,
        shape: Sequence[int],
        generator: torch.Generator | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        states = self.box.sample([*shape], generator=generator, device=_draw_device(generator))
        return states.to(device)


class DataStates:
    """States drawn with replacement from those seen in real data.

    Args:
        states: states ``[N, n]``; :meth:`update` replaces them as the data grows.

    Raises:
        ValueError: if there are no states, or some are not finite.

    Examples:
        >>> data = DataStates(torch.zeros(1, 2))
        >>> data.update(torch.ones(100, 2))
        >>> data.sample([2, 3]).unique()
        tensor([1.])
    """

    def __init__(self, states: Tensor) -> None:
        self.update(states)

    def update(self, states: Tensor) -> None:
        """Draw from ``states`` ``[N, n]`` from now on."""
        if states.ndim != 2 or not len(states):
            raise ValueError(
                f"states: expected at least one state, [N, n], got shape {list(states.shape)}."
            )
        if not states.isfinite().all():
            raise ValueError("states: expected finite states, got some that are not.")
        self.states = states.detach().to(torch.float32)

    def sample(
        self,
        shape: Sequence[int],
        generator: torch.Generator | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        rows = torch.randint(
            len(self.states), [*shape], generator=generator, device=_draw_device(generator)
        )
        return self.states[rows.to(self.states.device)].to(device)


class MixtureStates:
    """Each state from one of several samplers, chosen at random by weight.

    Args:
        weights: samplers and their weights, in any unit; they are normalised.

    Raises:
        ValueError: for a weight that is negative or not finite, or if none is positive.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> task = get_task("cartpole-swingup")
        >>> mixture = MixtureStates({BoxStates(task.reset): 1.0, BoxStates(task.goal): 3.0})
        >>> mixture.sample([64]).shape
        torch.Size([64, 4])
    """

    def __init__(self, weights: Mapping[StartStates, float]) -> None:
        for sampler, weight in weights.items():
            _check_weight(type(sampler).__name__, weight)
        positive = {sampler: weight for sampler, weight in weights.items() if weight > 0}
        if not positive:
            raise ValueError(f"weights: expected some above 0, got {list(weights.values())}.")
        total = sum(positive.values())
        self.samplers = tuple(positive)
        self.weights = tuple(weight / total for weight in positive.values())

    def sample(
        self,
        shape: Sequence[int],
        generator: torch.Generator | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        # Every component draws every row: cheaper than sorting the rows out, and what a row
        # receives does not depend on the choices of the others.
        draws = torch.stack([s.sample(shape, generator, device) for s in self.samplers])
        uniform = torch.rand([*shape, 1], generator=generator, device=_draw_device(generator))
        edges = torch.tensor(self.weights[:-1], device=uniform.device).cumsum(0)
        choice = torch.bucketize(uniform, edges, right=True).to(draws.device)
        return draws.gather(0, choice.expand(draws.shape[1:]).unsqueeze(0)).squeeze(0)


def make_start_states(
    task: Task,
    *,
    reset: float = 0.2,
    data: float = 0.0,
    coverage: float = 0.6,
    goal: float = 0.2,
    states: Tensor | DataStates | None = None,
) -> MixtureStates:
    """Mix the places that a task knows; a box that the task lacks leaves its share to the others.

    Args:
        task: the task.
        reset: share of the states from the task's own resets.
        data: share of the states seen in real data.
        coverage: share of the states from the wide box.
        goal: share of the states near the goal.
        states: the real data, ``[N, n]``, or a :class:`DataStates` that its owner keeps up to date.

    Raises:
        ValueError: for a share that is negative or not finite, for shares of which none is left,
            and for ``data`` without ``states``; the message names the key.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> start_states = make_start_states(get_task("pendulum"), reset=0.5, coverage=0.5)
        >>> start_states.weights  # this task has no goal box
        (0.5, 0.5)
    """
    shares = {"reset": reset, "data": data, "coverage": coverage, "goal": goal}
    for name, share in shares.items():
        _check_weight(name, share)
    if data > 0 and states is None:
        raise ValueError(f"data: expected states to draw from with data={data}, got states=None.")
    boxes = {"reset": task.reset, "coverage": task.coverage, "goal": task.goal}
    samplers: dict[str, StartStates] = {
        k: BoxStates(box) for k, box in boxes.items() if box is not None
    }
    if states is not None:
        samplers["data"] = states if isinstance(states, DataStates) else DataStates(states)
    present = {name: shares[name] for name in samplers}
    if not any(present.values()):
        raise ValueError(
            f"{', '.join(shares)}: expected a share above 0 for one of {sorted(present)}, "
            f"which is all that task {task.name!r} has; got {shares}."
        )
    return MixtureStates({samplers[name]: share for name, share in present.items()})


def _check_weight(name: str, weight: float) -> None:
    if not (math.isfinite(weight) and weight >= 0):
        raise ValueError(f"{name}: expected a finite weight of at least 0, got {weight}.")


def _draw_device(generator: torch.Generator | None) -> torch.device:
    return torch.device("cpu") if generator is None else generator.device
