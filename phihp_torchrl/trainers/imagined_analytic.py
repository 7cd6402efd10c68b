"""Policy gradients through the model: when worlds start anew, what is counted and warned of."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from phihp_torchrl.agents import AnalyticUpdate, Draws, make_td3_loss
from phihp_torchrl.imagination import Worlds
from phihp_torchrl.trainers.learners import Imagination, register_learner
from phihp_torchrl.trainers.replay_base import ReplayTrainer

DOING = "training in imagination"
"""What a run says that it is doing while this is on its stack."""

_log = logging.getLogger(__name__)

# Where more steps than this had to be limited, gradients are no guide any more.
_MOST_LIMITED = 0.5


class ImaginedAnalytic(ReplayTrainer):
    """Learns by the gradients of imagined returns through the model.

    All worlds go on from one update to the next; those that have reached the largest age start
    anew between two of them. References and inputs are drawn for each world and go on through all
    its lives, as in TD3's. The transitions are kept for the fit of the critics to returns.

    Args:
        imagination: model, rollouts, start states and settings.
    """

    update: AnalyticUpdate

    def __init__(self, imagination: Imagination) -> None:
        model, config = imagination.world_model, imagination.config
        super().__init__(model.task, imagination.seed)
        self.config, self.max_age = config, imagination.rollouts.max_age
        self.schedule = imagination.schedule
        self.start_states = imagination.start_states
        loss = make_td3_loss(model, config.td3)
        self.update = AnalyticUpdate(
            loss, model, config.analytic, config.td3.gamma, compile=imagination.compile
        )
        self.replay = imagination.new_replay()
        self.enter(imagination.new_worlds(self.generator))

    @property
    def imagined_steps(self) -> int:
        """Imagined transitions so far."""
        return self.replay.written

    def learn(self, until: int) -> dict[str, Tensor]:
        """Learn until there are ``until`` critic updates; returns averages of what is logged."""
        found: list[dict[str, Tensor]] = []
        while self.updates < until:
            scale = self.schedule.scale(self.updates)
            draws = self._draw(scale)
            batch, state, metrics = self.update(self.worlds.state, draws, scale)
            self.replay.extend(batch)
            self._go_on(state, batch.terminated)
            self.updates += self.config.analytic.critic_updates
            found.append(metrics)
        means = {name: torch.stack([each[name] for each in found]).mean() for name in found[0]}
        if means["limited_share"] > _MOST_LIMITED:
            _log.warning(
                "%.0f %% of the gradients through the model had to be limited: over "
                "policy.analytic.horizon=%d steps the model is chaotic here, and they say little "
                "about returns. Take a shorter horizon, or policy.method=td3.",
                100.0 * means["limited_share"].item(),
                self.config.analytic.horizon,
            )
        return means

    def visited(self, count: int) -> tuple[Tensor, Tensor]:
        """Draw states ``[count, n]`` from the replay, and uniform actions ``[count, m]``.

        The actions of the replay are all near the actor's, with which the fit of the critics begins
        anyway.
        """
        state = self.replay.sample(count, self.generator).state
        unit = 2.0 * torch.rand([count, self.task.action_dim], generator=self.generator) - 1.0
        bounds = self.update.bounds
        return state, bounds.from_unit(unit.to(bounds.low))

    def _draw(self, scale: float) -> Draws:
        steps, worlds = self.config.analytic.horizon, self.config.num_worlds
        noise = torch.randn([steps, worlds, self.task.action_dim], generator=self.generator)
        starts = self.start_states.sample([steps, worlds], self.generator)
        if self.stream is not None:
            starts = self.task.with_signals(starts, self.stream.advance(steps))
        return Draws(
            starts,
            scale * self.config.analytic.noise * noise,
            torch.randperm(steps * worlds, generator=self.generator),
        )

    def _go_on(self, state: Tensor, terminated: Tensor) -> None:
        """Go on from ``state``; worlds whose episode has reached the largest age start anew."""
        age = self.worlds.age
        for ended in terminated.view(-1, len(age)):
            age = torch.where(ended, 0, age + 1)
        old = age >= self.max_age
        start = self.start_states.sample([len(age)], self.generator)
        if self.stream is not None:
            start = self.task.with_signals(start, self.stream.present())
        self.worlds = Worlds(torch.where(old.unsqueeze(-1), start, state), torch.where(old, 0, age))


register_learner("analytic", ImaginedAnalytic, about="policy gradients through the model")
