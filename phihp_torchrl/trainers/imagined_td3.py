"""TD3 in imagination (paper, section 4.2): when to imagine, and when to learn."""

from __future__ import annotations

from torch import Tensor

from phihp_torchrl.imagination import Rollouts
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.trainers.learners import Imagination, register_learner
from phihp_torchrl.trainers.planned_acts import PlannedActs
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
        self.planned = self._planned(imagination)
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

    def _planned(self, imagination: Imagination) -> Rollouts:
        """The same rollouts, in some of whose worlds plans act; they are not compiled."""
        worlds, rollouts = self.config.planned_worlds, self.rollouts
        if not worlds:
            return rollouts
        acts = PlannedActs(
            imagination.planning_model,
            self.update.networks,
            CEMConfig(gamma=self.config.td3.gamma),
            worlds=worlds,
            generator=self.generator,
        )
        return Rollouts(imagination.world_model, acts, rollouts.max_age)

    def _imagine_chunk(self) -> None:
        config = self.config
        while True:
            warm = len(self.replay) >= config.random_steps
            self._act(
                self.planned if warm else self.rollouts,
                self.start_states.sample([config.chunk_steps, config.num_worlds], self.generator),
                noise=config.exploration_noise,
                random_fraction=config.random_fraction if warm else 1.0,
            )
            if warm:
                return


register_learner("td3", ImaginedTD3, about="TD3 on imagined transitions, as in the paper")
