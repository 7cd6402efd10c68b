"""Rollouts of a policy in many worlds at once: transitions and returns, each as one graph."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.dynamics import PreparedModel, TaskWorldModel
from phihp_torchrl.imagination.transitions import Batch, finite_transition
from phihp_torchrl.tasks import ActionBounds

_logger = logging.getLogger(__name__)

Policy = Callable[[Sequence[Tensor], Tensor, ActionBounds], Tensor]
"""A policy as a function: weights, observations ``[N, o]`` and bounds to actions ``[N, m]``."""


class Worlds(NamedTuple):
    """The states and ages of many worlds."""

    state: Tensor
    """Current states, ``[worlds, n]``."""
    age: Tensor
    """Steps since the last reset, int64 ``[worlds]``."""

    def to(self, device: torch.device | str) -> Worlds:
        """Return them on another device."""
        return Worlds(self.state.to(device), self.age.to(device))


class ChunkNoise(NamedTuple):
    """All random numbers of a chunk, drawn outside the compiled graph so that seeds reproduce."""

    start_states: Tensor
    """The state from which a world continues if its episode ends there, ``[steps, worlds, n]``."""
    exploration: Tensor
    """Noise on the policy's action, in units of the action's half-range, ``[steps, worlds, m]``."""
    random_actions: Tensor
    """Uniform actions in physical units, ``[steps, worlds, m]``."""
    use_random: Tensor
    """Whether the random action replaces the policy's, bool ``[steps, worlds]``."""
    signals: Tensor | None = None
    """References and inputs after each step, registers ``[steps, worlds, size]``; ``None`` for a
    task without, and where they go on as the model expects."""

    def to(self, device: torch.device | str) -> ChunkNoise:
        """Return it on another device."""
        return ChunkNoise(
            self.start_states.to(device),
            self.exploration.to(device),
            self.random_actions.to(device),
            self.use_random.to(device),
            None if self.signals is None else self.signals.to(device),
        )


def draw_noise(
    start_states: Tensor,
    bounds: ActionBounds,
    *,
    std: float,
    random_fraction: float,
    generator: torch.Generator | None = None,
    signals: Tensor | None = None,
) -> ChunkNoise:
    """Draw the noise of a chunk of ``start_states`` ``[steps, worlds, n]``.

    Args:
        start_states: reset states, one for each step and world.
        bounds: bounds of the action.
        std: standard deviation of the noise, in units of the action's half-range.
        random_fraction: share of uniformly random actions, in [0, 1].
        generator: source of randomness.
        signals: references and inputs after each step, registers ``[steps, worlds, size]``.
    """
    shape = start_states.shape[:-1]
    options: dict[str, Any] = {"generator": generator, "device": start_states.device}
    exploration = std * torch.randn([*shape, bounds.scale.shape[0]], **options)
    uniform = 2.0 * torch.rand([*shape, bounds.scale.shape[0]], **options) - 1.0
    use_random = torch.rand(shape, **options) < random_fraction
    return ChunkNoise(start_states, exploration, bounds.from_unit(uniform), use_random, signals)


def step_worlds(
    world_model: TaskWorldModel | PreparedModel,
    policy: Policy,
    weights: Sequence[Tensor],
    worlds: Worlds,
    noise: ChunkNoise,
    bounds: ActionBounds,
    max_age: int,
) -> tuple[Batch, Worlds]:
    """Step all worlds through a chunk under the policy with exploration noise.

    A world whose episode terminates, becomes non-finite or reaches ``max_age`` steps continues from
    a new start state. Reaching ``max_age`` is a truncation and is not recorded as ``terminated``. A
    transition to a non-finite state is recorded as a termination without a change of the state.

    Args:
        world_model: the model in which the worlds move.
        policy: the policy.
        weights: weights of the policy.
        worlds: states and ages of the worlds.
        noise: random numbers of the chunk.
        bounds: bounds of the action.
        max_age: largest number of steps in an episode.

    Returns:
        The transitions, ``[steps * worlds]`` rows, and the new states and ages of the worlds.
    """
    state, age = worlds
    rows: list[Batch] = []
    for t in range(noise.use_random.shape[0]):
        action = policy(weights, world_model.observe(state), bounds)
        action = bounds.clip(action + noise.exploration[t] * bounds.scale)
        action = torch.where(noise.use_random[t].unsqueeze(-1), noise.random_actions[t], action)
        next_state, reward, terminated = finite_transition(world_model.transition, state, action)
        start = noise.start_states[t]
        if noise.signals is not None:  # they are the world's, and go on when a life ends
            next_state, start = (
                world_model.task.with_signals(s, noise.signals[t]) for s in (next_state, start)
            )
        rows.append(Batch(state, action, reward, next_state, terminated))
        age = age + 1
        ended = terminated | (age >= max_age)
        state = torch.where(ended.unsqueeze(-1), start, next_state)
        age = torch.where(ended, torch.zeros_like(age), age)
    batch = Batch(*(torch.cat(column) for column in zip(*rows, strict=True)))
    return batch, Worlds(state, age)


class Returns(NamedTuple):
    """Episodes and the sums of their rewards so far."""

    state: Tensor
    """Current states, ``[N, n]``."""
    total: Tensor
    """Discounted rewards so far, ``[N]``."""
    weight: Tensor
    """Weight of the next reward: gamma^k after k steps, 0 after a termination; ``[N]``."""
    action: Tensor
    """Actions of the last step, ``[N, m]``; NaN before the first."""
    change: Tensor
    """Changes of the action from step to step so far, in half-ranges, ``[N]``."""

    @classmethod
    def from_state(cls, state: Tensor, bounds: ActionBounds) -> Returns:
        """Make episodes that start in ``state`` ``[N, n]``."""
        none = torch.zeros_like(state[..., 0])
        action = torch.full_like(bounds.center.expand(*none.shape, -1), math.nan)
        return cls(state, none, none + 1.0, action.contiguous(), none.clone())


def sum_rewards(
    world_model: TaskWorldModel | PreparedModel,
    policy: Policy,
    weights: Sequence[Tensor],
    returns: Returns,
    bounds: ActionBounds,
    steps: int,
    gamma: float = 1.0,
    signals: Tensor | None = None,
) -> Returns:
    """Continue episodes for ``steps`` steps of the noise-free policy, and add their rewards.

    References and inputs after each step are ``signals`` ``[steps, N, size]``, or else as the model
    expects them. An episode whose state leaves the finite numbers before it has ended earns NaN.
    """
    state, total, weight, last, change = returns
    for k in range(steps):
        action = policy(weights, world_model.observe(state), bounds)
        moved = ((action - last).abs() / bounds.scale).mean(-1)
        change = torch.where((weight != 0) & moved.isfinite(), change + moved, change)
        last = action
        state, reward, terminated = world_model.transition(state, action)
        if signals is not None:
            state = world_model.task.with_signals(state, signals[k])
        total = total + weight * reward
        # A limit that no comparison with NaN exceeds would else be kept for ever.
        lost = ~state.isfinite().all(-1) & (weight != 0)
        total = torch.where(lost, math.nan, total)
        weight = gamma * weight * (1.0 - terminated.to(weight.dtype))
    return Returns(state, total, weight, last, change)


def sum_rewards_at_once(
    world_model: PreparedModel,
    policy: Policy,
    weights: Sequence[Tensor],
    returns: Returns,
    bounds: ActionBounds,
    steps: int,
    gamma: float = 1.0,
) -> Returns:
    """As :func:`sum_rewards`, up to rounding, with the rewards and ends of all steps together.

    An actor's evaluation, 64 rows for hundreds of steps, then takes less than half of the time
    (``results/benchmarks``).
    """
    state, total, weight, last, change = returns
    states, actions, commands = [state], [last], []
    for _ in range(steps):
        action = policy(weights, world_model.observe(state), bounds)
        command, state = world_model.advance(state, action)
        states.append(state)
        actions.append(action)
        commands.append(command)
    path, taken = torch.stack(states), torch.stack(actions)
    reward, gone = world_model.judge_path(path, torch.cat(commands))
    running = (weight != 0).expand(steps, -1)
    after = weight * gamma**steps
    if gone is not None:
        running = running & ~torch.cat([torch.zeros_like(gone[:1]), gone[:-1]])
        after = after.masked_fill(gone[-1], 0.0)
    discounts = gamma ** torch.arange(steps, device=state.device).unsqueeze(-1)
    earned = (weight * discounts * reward).masked_fill(~running, 0.0)
    # A limit that no comparison with NaN exceeds would else be kept for ever.
    lost = (running & ~path[1:].isfinite().all(-1)).any(0)
    moved = (taken.diff(dim=0).abs() / bounds.scale).mean(-1)
    moved = moved.masked_fill(~(running & moved.isfinite()), 0.0)
    return Returns(
        state,
        (total + earned.sum(0)).masked_fill(lost, math.nan),
        after,
        action,
        change + moved.sum(0),
    )


class Rollouts:
    """Rolls out a policy in a world model, learned or simulated, for transitions and for returns.

    Args:
        world_model: the model in which the policy acts; later changes of its parameters take effect
            at once.
        policy: the policy as a function of its weights, such as
            :func:`phihp_torchrl.agents.act`.
        max_age: largest number of steps in an episode.
        device: device of the states. Defaults to the CPU.
        compile: whether to compile (10 to 40 s the first time, from the cache afterwards). If the
            integrator of the model does not compile, a warning is logged and nothing is compiled.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents import Actor, act
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> rollouts = Rollouts(model, act, max_age=200)
        >>> weights = [layer.detach() for layer in Actor(task).mlp.parameters()]
        >>> rollouts.returns(weights, task.reset.sample([3]), steps=200).total.shape
        torch.Size([3])
    """

    # Steps of a compiled piece of a return: enough that its call is cheap, few enough to compile.
    _RETURN_STEPS = 5
    # Rows of which rewards are computed together, of all steps: a bound of their memory.
    _ROWS_AT_ONCE = 65_536

    def __init__(
        self,
        world_model: TaskWorldModel,
        policy: Policy,
        max_age: int,
        *,
        device: torch.device | str = "cpu",
        compile: bool = False,
    ) -> None:
        if compile and not world_model.compiles:
            _logger.warning("Rollouts are not compiled: the model's integrator does not compile.")
            compile = False
        self.task = world_model.task
        self.world_model, self.policy = world_model, policy
        self.bounds = self.task.bounds.to(device)
        self.max_age = max_age
        self._compiled: tuple[Callable[..., Any], Callable[..., Any]] | None = None
        if compile:
            step, sum_up = (partial(f, world_model, policy) for f in (step_worlds, sum_rewards))
            self._compiled = compile_graph(step), compile_graph(sum_up)

    def chunk(
        self, weights: Sequence[Tensor], worlds: Worlds, noise: ChunkNoise
    ) -> tuple[Batch, Worlds]:
        """Step all worlds through a chunk: :func:`step_worlds`."""
        step, _ = self._compiled or (partial(step_worlds, self._model(), self.policy), None)
        return step(weights, worlds, noise, self.bounds, self.max_age)

    def returns(
        self,
        weights: Sequence[Tensor],
        state: Tensor,
        steps: int,
        gamma: float = 1.0,
        signals: Tensor | None = None,
    ) -> Returns:
        """Sum the rewards of ``steps`` steps of the noise-free policy from each state ``[N, n]``.

        Args:
            weights: weights of the policy.
            state: first states, ``[N, n]``.
            steps: number of steps.
            gamma: discount.
            signals: references and inputs after each step, registers ``[steps, N, size]``. By
                default they go on as the model expects.
        """
        model = self._model()
        returns, size = Returns.from_state(state, self.bounds), self._RETURN_STEPS
        if isinstance(model, PreparedModel) and not self._compiled and signals is None:
            size = max(1, self._ROWS_AT_ONCE // max(1, len(state)))
            for first in range(0, steps, size):
                length = min(size, steps - first)
                returns = sum_rewards_at_once(
                    model, self.policy, weights, returns, self.bounds, length, gamma
                )
            return returns
        eager = partial(sum_rewards, model, self.policy)
        _, piece = self._compiled or (None, eager)
        whole = steps - steps % size
        for first in range(0, whole, size):
            after = None if signals is None else signals[first : first + size]
            returns = piece(weights, returns, self.bounds, size, gamma, after)
        after = None if signals is None else signals[whole:]
        return eager(weights, returns, self.bounds, steps % size, gamma, after)

    def _model(self) -> TaskWorldModel | PreparedModel:
        """The model with the weights that it has now, in as few operations as it can be."""
        return self.world_model if torch.is_grad_enabled() else self.world_model.prepared()
