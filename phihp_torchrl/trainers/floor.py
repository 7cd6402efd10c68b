"""The floor of a task's returns: what doing nothing and doing anything earn in the model."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Rollouts
from phihp_torchrl.tasks import ActionBounds

# A start counts as left at the floor if the actor gains less there than this share of what it
# gains at its best start.
_LITTLE = 0.1
# Or less than this share of what it would gain if all steps had the reward of the best states.
_PASSING = 0.1
# Steps are called the best whose reward only this share of steps from anywhere exceeds.
_BEST = 1e-3


class Floor:
    """Tells from how many starts an actor earns no more than without any skill.

    The floor of a start is the larger return of two policies: one that does nothing (the action 0,
    clipped to its bounds) and one whose actions are uniformly random. How much the larger exceeds
    either of them varies from start to start; the lesser of these deviations is the noise that an
    actor has to exceed, so that a policy under which the system runs away adds none. A sparse
    reward leaves an actor at the floor from most starts,
    while its mean may already be above the floor because a few starts lie near the goal. It also
    leaves one at the floor that only passes the goal, again and again, or from starts that all are
    alike. So an actor that gains a tenth of what the best states give for as long as an episode
    lasts is at the floor too. A reward that ends the episode is no state to stay in, and does not
    count there. From a start that already lies in the best states nobody can gain anything, so such
    starts tell nothing and are left out, as long as others are left.

    Args:
        world_model: the model, in the units of the trained networks.
        states: the starts, ``[N, n]``.
        steps: steps in a return.
        seed: seed of the random actions, which move no other random numbers.
        wide: states from anywhere, ``[M, n]``, among which are those of high reward; ``None`` where
            nobody knows any.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("cartpole-swingup")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> floor = Floor(model, task.reset.sample([4]), steps=5, seed=0)
        >>> floor.share(floor.returns), floor.share(floor.returns + 100.0)
        (1.0, 0.0)
    """

    @torch.no_grad()
    def __init__(
        self,
        world_model: TaskWorldModel,
        states: Tensor,
        steps: int,
        *,
        seed: int,
        wide: Tensor | None = None,
    ) -> None:
        task = world_model.task
        generator = torch.Generator(device=states.device).manual_seed(seed)

        def nothing(weights: Sequence[Tensor], observation: Tensor, bounds: ActionBounds) -> Tensor:
            return bounds.clip(observation.new_zeros(len(observation), task.action_dim))

        def anything(
            weights: Sequence[Tensor], observation: Tensor, bounds: ActionBounds
        ) -> Tensor:
            shape = [len(observation), task.action_dim]
            unit = torch.rand(
                shape, generator=generator, dtype=observation.dtype, device=observation.device
            )
            return bounds.clip(bounds.from_unit(2.0 * unit - 1.0))

        totals = [
            _finite(Rollouts(world_model, policy, steps).returns([], states, steps).total)
            for policy in (nothing, anything)
        ]
        self.returns = torch.maximum(*totals)
        self.noise = min(float((self.returns - each).std(correction=0)) for each in totals)
        self.most = torch.full_like(self.returns, -torch.inf)
        """Gains of an actor that could stay in the best states, ``[N]``."""
        if wide is not None:
            action = anything([], wide, task.bounds.to(wide.device))
            _, reward, ended = world_model.transition(wide, action)
            kept = reward[reward.isfinite() & ~ended]
            if len(kept):
                self.most = steps * kept.quantile(1.0 - _BEST) - self.returns

    def share(self, returns: Tensor) -> float:
        """The share of telling starts at the floor, for returns ``[N]`` from the same starts."""
        # What left the finite numbers has gained nothing.
        gain = torch.where(returns.isfinite(), returns, -torch.inf) - self.returns
        least = max(self.noise, _LITTLE * float(gain.max()), 0.0)
        stays = (gain <= least) | (gain <= _PASSING * self.most)
        telling = self.most > least
        return float((stays[telling] if telling.any() else stays).double().mean())


def _finite(returns: Tensor) -> Tensor:
    """Returns in which what left the finite numbers is the lowest one."""
    finite = returns.isfinite()
    lowest = returns[finite].min() if finite.any() else returns.new_zeros(())
    return torch.where(finite, returns, lowest)
