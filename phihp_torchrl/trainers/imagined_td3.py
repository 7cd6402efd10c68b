"""TD3 in imagination (paper, section 4.2): when to imagine, and when to learn."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from phihp_torchrl.imagination import Rollouts
from phihp_torchrl.trainers.learners import Imagination, register_learner
from phihp_torchrl.trainers.planned_acts import SEARCH, PlannedActs, planned_share
from phihp_torchrl.trainers.td3_base import TD3Trainer

DOING = "training in imagination"
"""What a run says that it is doing while this is on its stack."""


class ImaginedTD3(TD3Trainer):
    """Steps imagined worlds into a replay, and learns from it by TD3.

    Args:
        imagination: model, rollouts, start states and settings.
    """

    def __init__(self, imagination: Imagination) -> None:
        config = self.config = imagination.config
        self.schedule = imagination.schedule
        self.rollouts, self.start_states = imagination.rollouts, imagination.start_states
        super().__init__(
            imagination.world_model, config.td3, seed=imagination.seed, compile=imagination.compile
        )
        self.acts = PlannedActs(
            imagination.planning_model,
            self.update.networks,
            replace(SEARCH, gamma=config.td3.gamma),
            worlds=0,
            generator=self.generator,
        )
        self.planned = Rollouts(imagination.world_model, self.acts, self.rollouts.max_age)
        self.replay = imagination.new_replay()
        self.enter(imagination.new_worlds(self.generator))

    @property
    def imagined_steps(self) -> int:
        """Imagined transitions so far."""
        return self.replay.written

    def learn(self, until: int) -> dict[str, Tensor]:
        """Learn until there are ``until`` critic updates; returns the losses of the last one."""
        config = self.config
        losses: dict[str, Tensor] = {}
        while self.updates < until:
            round_end = config.chunk_steps * config.updates_per_step
            if self.updates % round_end == 0:
                self._imagine_chunk()
            for _ in range(min(round_end - self.updates % round_end, until - self.updates)):
                if self.updates % config.td3.policy_delay == 0:
                    scale = self.schedule.scale(self.updates)
                    losses = self._learn(config.batch_size, scale)
                self.updates += 1
        return losses

    def visited(self, count: int) -> tuple[Tensor, Tensor]:
        """Draw states ``[count, n]`` and actions ``[count, m]`` from the replay."""
        batch = self.replay.sample(count, self.generator)
        return batch.state, batch.action

    def _planned_worlds(self) -> int:
        """The number of worlds in which plans act now."""
        config = self.config
        left = planned_share(self.updates / config.updates)
        return round(left * config.planned * config.num_worlds)

    def _imagine_chunk(self) -> None:
        config = self.config
        while True:
            warm = len(self.replay) >= config.random_steps
            self.acts.worlds = self._planned_worlds() if warm else 0
            self._act(
                self.planned if self.acts.worlds else self.rollouts,
                self.start_states.sample([config.chunk_steps, config.num_worlds], self.generator),
                noise=config.exploration_noise,
                random_fraction=config.random_fraction if warm else 1.0,
            )
            if warm:
                return


register_learner("td3", ImaginedTD3, about="TD3 on imagined transitions, as in the paper")
