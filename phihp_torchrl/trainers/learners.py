"""The ways to learn in imagination by name, of which ``policy.method`` chooses one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from phihp_torchrl.agents import ActorCriticUpdate, FlatReplay
from phihp_torchrl.config import Registry
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Rollouts, StartStates, Worlds
from phihp_torchrl.trainers.plateau import Schedule


class Learner(Protocol):
    """The interface of a way to learn in imagination: it changes actor and critics, and counts.

    Start states, units, evaluation, the choice of the actor to keep and the fit of its critics are
    :class:`~phihp_torchrl.trainers.PolicyTrainer`'s, the same for all of them.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.trainers import PolicyConfig, PolicyTrainer
        >>> task = get_task("pendulum")
        >>> trainer = PolicyTrainer(task, HybridDynamics.hybrid(task), PolicyConfig(), seed=0)
        >>> learner: Learner = trainer.learner
        >>> learner.updates, learner.imagined_steps
        (0, 0)
    """

    updates: int
    """Critic updates so far."""
    generator: torch.Generator
    """Source of all random numbers but the initial weights."""

    @property
    def update(self) -> ActorCriticUpdate:
        """Actor and critics, which the learner changes in place."""

    @property
    def imagined_steps(self) -> int:
        """Imagined transitions so far."""

    def learn(self, until: int) -> dict[str, Tensor]:
        """Learn until there are ``until`` critic updates; returns scalars to log."""

    def visited(self, count: int) -> tuple[Tensor, Tensor]:
        """Draw imagined states ``[count, n]`` and first actions ``[count, m]`` to evaluate there.

        The fit of the critics to returns begins with these.
        """

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs, tensors and numbers only."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""


@dataclass(frozen=True)
class Imagination:
    """What a learner is built from.

    Args:
        world_model: the model, in the units of the networks.
        rollouts: rollouts of an actor in that model.
        start_states: where imagined episodes start.
        config: settings of the phase, a :class:`~phihp_torchrl.trainers.PolicyConfig`.
        seed: seed of all random numbers but the initial weights of the networks.
        compile: whether to compile updates.
        schedule: the factor on learning rates, by the updates so far; it may fall early.
        planning_model: the model by which plans are made, in the same units: the mean one where
            every imagined world has a model of its own.
    """

    world_model: TaskWorldModel
    rollouts: Rollouts
    start_states: StartStates
    config: Any
    seed: int
    compile: bool
    schedule: Schedule
    planning_model: TaskWorldModel

    def new_replay(self) -> FlatReplay:
        """An empty replay of the size that the settings say."""
        task = self.world_model.task
        return FlatReplay(self.config.replay_capacity, task.state_dim, task.action_dim)

    def new_worlds(self, generator: torch.Generator) -> Worlds:
        """Worlds at ages of all sizes, so that they do not start anew all at once."""
        count = self.config.num_worlds
        age = torch.randint(self.rollouts.max_age, (count,), generator=generator)
        return Worlds(self.start_states.sample([count], generator), age)


@dataclass(frozen=True)
class LearnerKind:
    """A registered way to learn in imagination.

    Args:
        build: a function that makes the learner from an :class:`Imagination`.
        about: description in one line.
    """

    build: Callable[[Imagination], Learner]
    about: str = ""


LEARNERS: Registry[LearnerKind] = Registry("method")
"""Registered ways to learn in imagination by name, the choices of ``policy.method``."""


def register_learner(
    name: str,
    build: Callable[[Imagination], Learner],
    *,
    about: str = "",
    replace: bool = False,
) -> LearnerKind:
    """Register a way to learn in imagination, for ``policy.method=name`` in settings.

    Args:
        name: the name.
        build: a function that makes the learner from an :class:`Imagination`.
        about: description in one line.
        replace: whether one of that name may be replaced.

    Returns:
        The registered kind.

    Raises:
        ConfigError: if the name is taken and ``replace`` is false.

    Examples:
        >>> from phihp_torchrl.trainers import PolicyConfig
        >>> known = LEARNERS["td3"]
        >>> kind = register_learner("my-way", known.build, about="TD3 once more", replace=True)
        >>> PolicyConfig(method="my-way").method
        'my-way'
    """
    return LEARNERS.register(name, LearnerKind(build, about), replace=replace)
