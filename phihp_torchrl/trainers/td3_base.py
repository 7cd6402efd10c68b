"""The base of TD3 in imagination and on real steps: acting, and learning from replay."""

from __future__ import annotations

from torch import Tensor

from phihp_torchrl.agents import TD3Config, TD3Update, make_td3_loss
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Rollouts, draw_noise
from phihp_torchrl.trainers.replay_base import ReplayTrainer


class TD3Trainer(ReplayTrainer):
    """The base of trainers by TD3; subclasses decide when to act and when to learn.

    Args:
        world_model: the world to act in, a model or a simulated world.
        td3: hyper-parameters of TD3.
        seed: seed of all random numbers but the initial weights of the networks, which come from
            torch's global generator.
        compile: whether to compile the update.
    """

    update: TD3Update

    def __init__(
        self, world_model: TaskWorldModel, td3: TD3Config, *, seed: int, compile: bool
    ) -> None:
        super().__init__(world_model.task, seed)
        self.loss = make_td3_loss(world_model, td3)
        self.update = TD3Update(self.loss, world_model, td3, compile=compile)

    def _act(
        self, world: Rollouts, starts: Tensor, *, noise: float, random_fraction: float
    ) -> None:
        """Step the worlds with noise on the actor's actions.

        Args:
            world: the rollouts that step the worlds.
            starts: start states of the episodes that begin meanwhile, ``[steps, worlds, n]``.
            noise: std of the noise, in units of the action's half-range.
            random_fraction: share of actions that are uniformly random.
        """
        drawn = draw_noise(
            starts,
            world.bounds,
            std=noise,
            random_fraction=random_fraction,
            generator=self.generator,
            signals=None if self.stream is None else self.stream.advance(len(starts)),
        )
        batch, self.worlds = world.chunk(self.update.networks.actor, self.worlds, drawn)
        self.replay.extend(batch)

    def _learn(self, batch_size: int, learning_rate_scale: float) -> dict[str, Tensor]:
        """A round of updates, the critics' on ``batch_size`` transitions each."""
        rows = batch_size * self.update.config.policy_delay
        return self.update(
            self.replay.sample(rows, self.generator), learning_rate_scale, self.generator
        )
