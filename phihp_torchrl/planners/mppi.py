"""Planning by path integral control as a TorchRL module: observation in, action out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, exploration_type

from phihp_torchrl.planners.base import SamplingPlanner
from phihp_torchrl.planners.memory import PlanMemory
from phihp_torchrl.planners.mppi_core import MPPINoise, MPPIPlan, mppi_plan
from phihp_torchrl.planners.settings import MPPISettings


class MPPIPlanner(SamplingPlanner):
    """Plan with model-predictive path integral control and a policy as a prior, as TD-MPC does.

    At each call sequences of the actor and Gaussian ones compete by imagined rewards and by Q
    beyond the horizon, and the Gaussian is refitted to the elites, each weighted by the exponential
    of its score. It starts from the previous plan's mean, shifted by a step. Under
    ``set_exploration_type(ExplorationType.RANDOM)`` the action gets noise of the std that the
    Gaussian has left; else it gets none.

    It plans on whatever :class:`~phihp_torchrl.CEMPlanner` plans on, with the same keys and
    backends, latent models included. :class:`torchrl.modules.MPPIPlanner` is another algorithm: it
    weighs by a learned advantage, and knows neither an actor nor momentum nor elites by return.

    References: https://arxiv.org/abs/2203.04955.

    Args:
        env: the model to plan on, an environment of batch size ``[]``.
        settings: the numbers; :attr:`settings` may be assigned anew, as schedules do.
        options: ``actor``, ``qvalue``, keys, ``backend``, ``compile`` and ``generator`` of
            :class:`~phihp_torchrl.planners.base.SamplingPlanner`. Each horizon compiles anew.

    Raises:
        ValueError: for an argument out of range or a key that is not there; when planning, for an
            observation that is missing, not finite, or of the wrong shape, dtype or device.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import HybridDynamics, WorldModelEnv, get_task
        >>> from phihp_torchrl.dynamics import TaskWorldModel
        >>> task = get_task("pendulum")
        >>> env = WorldModelEnv(TaskWorldModel(task, HybridDynamics.oracle(task)))
        >>> settings = MPPISettings(num_candidates=64, top_k=8, num_policy_candidates=0)
        >>> planner = MPPIPlanner(env, settings)
        >>> observation = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 1.0]])
        >>> planner(TensorDict(observation=observation, batch_size=[2]))["action"].shape
        torch.Size([2, 1])
    """

    settings: MPPISettings
    memory: PlanMemory

    def __init__(self, env: EnvBase, settings: MPPISettings, **options: Any) -> None:
        memory = PlanMemory(replan_every=1, warm_start=True)
        super().__init__(env, settings, mppi_plan, memory, **options)
        self._built_in: MPPISettings | None = None

    def draw_noise(self, batch: Sequence[int]) -> MPPINoise:
        """The randomness of one plan for observations of this batch size."""
        s, action_dim = self.settings, self._action_low.numel()
        guided = s.num_policy_candidates
        low = self._action_low
        return MPPINoise(
            samples=self._draw(
                s.optim_steps, s.planning_horizon, s.num_candidates - guided, *batch, action_dim
            ),
            policy=self._draw(s.planning_horizon, guided, *batch, action_dim),
            choice=torch.rand(
                (s.top_k, *batch), generator=self.generator, dtype=low.dtype, device=low.device
            ),
        )

    @torch.no_grad()
    def planning(self, tensordict: TensorDictBase, noise: MPPINoise | None = None) -> Tensor:
        """Plan from ``tensordict`` and remember the plan's mean.

        Args:
            tensordict: the observations, of any batch size.
            noise: the randomness of the plan. Drawn if absent.

        Returns:
            The action ``[*batch, *action_shape]``.
        """
        batch = tensordict.batch_size
        cold = self.bounds.center.expand(*batch, self.settings.planning_horizon, -1)
        mean = self.memory.recall(self._starts(tensordict), cold)
        found = self.plan(tensordict, noise, mean)
        self.memory.remember(found.mean)
        action = found.actions[..., 0, :]
        if exploration_type() is ExplorationType.RANDOM:
            std = found.std[..., 0, :]
            action = self.bounds.clip(action + std * self._draw(*std.shape))
        return action.reshape(*batch, *self.action_spec.shape)

    @torch.no_grad()
    def plan(
        self,
        tensordict: TensorDictBase,
        noise: MPPINoise | None = None,
        mean: Tensor | None = None,
    ) -> MPPIPlan:
        """The whole plan; remembers nothing.

        Args:
            tensordict: the observations, of any batch size.
            noise: the randomness. Drawn if absent.
            mean: center of the first random candidates, ``[*batch, H, m]``. Defaults to the middle
                of the bounds.
        """
        self._check_observation(tensordict)
        # The horizon and the floor of the std are arguments of the plan; the rest is built in.
        fixed = replace(self.settings, planning_horizon=1, min_std=0.0)
        if fixed != self._built_in:
            self._built_in, self._planning_functions = fixed, {}
        if noise is None:
            noise = self.draw_noise(tensordict.batch_size)
        # A tensor, and not the setting itself: a schedule would compile at every step.
        min_std = torch.tensor(
            self.settings.min_std, dtype=self._action_low.dtype, device=self._action_low.device
        )
        return self._call_plan(tensordict, noise, mean, min_std)
