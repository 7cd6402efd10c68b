"""Imagined transitions in chunks: many worlds at once, a few steps at a time, as one graph."""

from __future__ import annotations

import logging
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.agents.functional import Batch, Layers, finite_transition, policy
from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.dynamics import TaskWorldModel

_logger = logging.getLogger(__name__)


class Worlds(NamedTuple):
    """Where the imagined worlds are."""

    state: Tensor
    """``[worlds, n]``."""
    age: Tensor
    """Steps since the last reset, int64 ``[worlds]``."""


class ChunkNoise(NamedTuple):
    """All randomness of a chunk, drawn outside the graph so that seeds reproduce."""

    start_states: Tensor
    """Where a world goes on that ended at that step, ``[steps, worlds, n]``."""
    exploration: Tensor
    """Added to the policy's action, in units of the action bounds, ``[steps, worlds, m]``."""
    random_actions: Tensor
    """Uniform actions in physical units, ``[steps, worlds, m]``."""
    use_random: Tensor
    """Which actions are the random ones, bool ``[steps, worlds]``."""


def draw_noise(
    start_states: Tensor,
    action_high: Tensor,
    *,
    std: float,
    random_fraction: float,
    generator: torch.Generator | None = None,
) -> ChunkNoise:
    """Draw the noise of a chunk of ``start_states`` ``[steps, worlds, n]``.

    Args:
        start_states: reset states, one a step and world.
        action_high: action bounds ``[m]``.
        std: exploration noise, in units of the action bounds.
        random_fraction: share of uniformly random actions, in [0, 1].
        generator: source of randomness.
    """
    shape = start_states.shape[:-1]
    options: dict[str, Any] = {"generator": generator, "device": start_states.device}
    exploration = std * torch.randn([*shape, action_high.shape[0]], **options)
    uniform = 2.0 * torch.rand([*shape, action_high.shape[0]], **options) - 1.0
    use_random = torch.rand(shape, **options) < random_fraction
    return ChunkNoise(start_states, exploration, uniform * action_high, use_random)


def imagine(
    world_model: TaskWorldModel,
    actor: Layers,
    worlds: Worlds,
    noise: ChunkNoise,
    action_high: Tensor,
    max_age: int,
) -> tuple[Batch, Worlds]:
    """Step all worlds through a chunk under the noisy policy.

    A world that terminates, leaves the finite numbers or reaches ``max_age`` steps goes on from a
    new start state. Reaching ``max_age`` is truncation: it is not recorded as ``terminated``. A
    transition into non-finite numbers is recorded as staying put with termination, and harms
    nothing.

    Args:
        world_model: the model.
        actor: layers of the actor.
        worlds: where the worlds are.
        noise: randomness of the chunk.
        action_high: action bounds ``[m]``.
        max_age: steps a world lives at most.

    Returns:
        Transitions, ``[steps * worlds]`` rows, and where the worlds are now.
    """
    state, age = worlds
    rows: list[Batch] = []
    for t in range(noise.use_random.shape[0]):
        action = policy(actor, world_model.observe(state), action_high)
        action = action + noise.exploration[t] * action_high
        action = torch.minimum(torch.maximum(action, -action_high), action_high)
        action = torch.where(noise.use_random[t].unsqueeze(-1), noise.random_actions[t], action)
        next_state, reward, terminated = finite_transition(world_model.transition, state, action)
        rows.append(Batch(state, action, reward, next_state, terminated))
        age = age + 1
        ended = terminated | (age >= max_age)
        state = torch.where(ended.unsqueeze(-1), noise.start_states[t], next_state)
        age = torch.where(ended, torch.zeros_like(age), age)
    batch = Batch(*(torch.cat(column) for column in zip(*rows, strict=True)))
    return batch, Worlds(state, age)


class Returns(NamedTuple):
    """Episodes of which the returns are being summed."""

    state: Tensor
    """Where they are, ``[N, n]``."""
    total: Tensor
    """Discounted rewards so far, ``[N]``."""
    weight: Tensor
    """What the next reward counts: gamma^k after k steps, 0 after a termination; ``[N]``."""

    @classmethod
    def from_state(cls, state: Tensor) -> Returns:
        """Episodes that start in ``state``."""
        return cls(state, torch.zeros_like(state[..., 0]), torch.ones_like(state[..., 0]))


def sum_rewards(
    world_model: TaskWorldModel,
    actor: Layers,
    returns: Returns,
    action_high: Tensor,
    steps: int,
    gamma: float = 1.0,
) -> Returns:
    """Go on for ``steps`` steps of the noise-free policy."""
    state, total, weight = returns
    for _ in range(steps):
        action = policy(actor, world_model.observe(state), action_high)
        state, reward, terminated = world_model.transition(state, action)
        total = total + weight * reward
        weight = gamma * weight * (1.0 - terminated.to(weight.dtype))
    return Returns(state, total, weight)


def imagined_return(
    world_model: TaskWorldModel, actor: Layers, state: Tensor, action_high: Tensor, steps: int
) -> Tensor:
    """Undiscounted return of the noise-free policy from each state ``[N, n]``, ``[N]``."""
    return sum_rewards(world_model, actor, Returns.from_state(state), action_high, steps).total


class Imagination:
    """A world model for one task's policy to act in: chunks of transitions, and returns.

    Args:
        world_model: the model; later changes of its parameters are seen at once.
        action_high: action bounds ``[m]``.
        max_age: steps a world lives at most.
        compile: whether to compile, chunk by chunk (10 to 40 s at first, from the cache
            afterwards). Where the model does not compile, it is left out with a warning.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents import Actor
        >>> task = get_task("pendulum")
        >>> imagination = Imagination(
        ...     TaskWorldModel(task, HybridDynamics.oracle(task)), torch.tensor([2.0]), max_age=200
        ... )
        >>> layers = [layer.detach() for layer in Actor(task).mlp.parameters()]
        >>> imagination.returns(layers, task.reset.sample([3]), steps=200).total.shape
        torch.Size([3])
    """

    # A compiled chunk of returns: long enough to make its call cheap, short to compile.
    _RETURN_STEPS = 5

    def __init__(
        self,
        world_model: TaskWorldModel,
        action_high: Tensor,
        max_age: int,
        *,
        compile: bool = False,
    ) -> None:
        if compile and not world_model.compiles:
            _logger.warning("Imagination is not compiled: the model's integrator does not compile.")
            compile = False
        self.action_high = action_high
        self.max_age = max_age
        self._imagine = compile_graph(partial(imagine, world_model), enabled=compile)
        self._sum_rewards = partial(sum_rewards, world_model)
        self._sum_rewards_chunk = compile_graph(self._sum_rewards, enabled=compile)

    def chunk(self, actor: Layers, worlds: Worlds, noise: ChunkNoise) -> tuple[Batch, Worlds]:
        """Step all worlds through a chunk: :func:`imagine`."""
        return self._imagine(actor, worlds, noise, self.action_high, self.max_age)

    def returns(self, actor: Layers, state: Tensor, steps: int, gamma: float = 1.0) -> Returns:
        """Returns of ``steps`` steps of the noise-free policy from each state ``[N, n]``."""
        returns, size = Returns.from_state(state), self._RETURN_STEPS
        for _ in range(steps // size):
            returns = self._sum_rewards_chunk(actor, returns, self.action_high, size, gamma)
        return self._sum_rewards(actor, returns, self.action_high, steps % size, gamma)
