"""Planning by path integral control as a TorchRL module, from observation to action."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, exploration_type

from phihp_torchrl.config import ConfigError
from phihp_torchrl.planners.advantage import advantage_judge
from phihp_torchrl.planners.colored_noise import colored
from phihp_torchrl.planners.env_model import EnvModel
from phihp_torchrl.planners.mppi import MPPIConfig, MPPINoise, MPPIPlan, mppi_plan
from phihp_torchrl.planners.problem import Problem
from phihp_torchrl.planners.receding_horizon import RecedingHorizon
from phihp_torchrl.planners.sampling_planner import SamplingPlanner
from phihp_torchrl.planners.search import SearchConfig
from phihp_torchrl.planners.stock_attributes import Setting

_STOCK: dict[str, Any] = {
    "num_policy_candidates": 0,
    "init_std": 1.0,
    "min_std": 0.0,
    "momentum": 0.0,
    "select": "mean",
}


class MPPIPlanner(SamplingPlanner):
    """Plan by model-predictive path integral control, guided by a policy, as TD-MPC does.

    At each call the candidates are sequences of the actor and Gaussian ones. Their scores are the
    rewards in the model plus Q beyond the horizon, and the Gaussian is refitted to the elites, each
    weighted by the exponential of its score. It starts from the previous plan's mean, shifted by
    one step. Under ``set_exploration_type(ExplorationType.RANDOM)`` noise with the std of the last
    Gaussian is added to the action.

    It plans on the same environments as :class:`~phihp_torchrl.CEMPlanner`, with the same keys and
    backends, and on latent models.

    It also takes the arguments of :class:`torchrl.modules.MPPIPlanner`:
    ``MPPIPlanner(env, advantage_module, temperature, planning_horizon, ...)``. A sequence's score
    is then the advantage of its first step, or with ``None`` for the module its return, and there
    are no candidates of an actor, no momentum and no draw of an elite. What differs from there: the
    Gaussian starts with the half-range of the action as its scale and around the previous plan, and
    a candidate whose score is not finite never counts.

    References: https://arxiv.org/abs/2203.04955.

    Args:
        env: the environment to plan on, of batch size ``[]``.
        settings: settings of the search; the attribute :attr:`settings` may be assigned, for
            schedules. In their place an ``advantage_module``, which writes ``"advantage"``, and the
            numbers that follow.
        temperature: as in :class:`~phihp_torchrl.planners.MPPIConfig`, and so are the four numbers
            after it, and any other field of it among the ``options``.
        planning_horizon: actions in a sequence.
        optim_steps: iterations of sampling, scoring and refitting.
        num_candidates: sequences scored in each iteration.
        top_k: number of elites.
        reward_key: key of the reward after a step.
        action_key: key of the action.
        advantage_module: the same as the second argument, by its name.
        options: ``actor``, ``qvalue``, keys, ``backend``, ``compile`` and ``generator`` of
            :class:`~phihp_torchrl.planners.SamplingPlanner`. Each horizon is compiled separately.

    Raises:
        ValueError: for an argument out of range or an unknown key; when planning, for an
            observation that is missing, not finite, or of the wrong shape, dtype or device.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import HybridDynamics, WorldModelEnv, get_task
        >>> from phihp_torchrl.dynamics import TaskWorldModel
        >>> task = get_task("pendulum")
        >>> env = WorldModelEnv(TaskWorldModel(task, HybridDynamics.hybrid(task)))
        >>> settings = MPPIConfig(num_candidates=64, top_k=8, num_policy_candidates=0)
        >>> planner = MPPIPlanner(env, settings)
        >>> observation = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 1.0]])
        >>> planner(TensorDict(observation=observation, batch_size=[2]))["action"].shape
        torch.Size([2, 1])
    """

    settings: MPPIConfig
    settings_class = MPPIConfig
    _parts = (*SamplingPlanner._parts, "advantage_module")
    temperature = Setting()
    receding: RecedingHorizon

    def __init__(
        self,
        env: EnvBase,
        settings: MPPIConfig | nn.Module | None = None,
        temperature: float | None = None,
        planning_horizon: int | None = None,
        optim_steps: int | None = None,
        num_candidates: int | None = None,
        top_k: int | None = None,
        reward_key: NestedKey = ("next", "reward"),
        action_key: NestedKey = "action",
        *,
        advantage_module: nn.Module | None = None,
        **options: Any,
    ) -> None:
        numbers = {
            "temperature": temperature,
            "planning_horizon": planning_horizon,
            "optim_steps": optim_steps,
            "num_candidates": num_candidates,
            "top_k": top_k,
        }
        given = {name: value for name, value in numbers.items() if value is not None}
        own = {f.name for f in fields(MPPIConfig)}
        given |= {name: options.pop(name) for name in list(options) if name in own}
        if isinstance(settings, SearchConfig):
            config = settings
            if given or advantage_module is not None:
                named = [*given, *(["advantage_module"] if advantage_module is not None else [])]
                raise ConfigError(
                    "settings", f"expected these alone or {named} alone, got both of them."
                )
        else:
            advantage_module = settings if advantage_module is None else advantage_module
            config = MPPIConfig(**{**_STOCK, **given})
        if advantage_module is not None:
            options = self._with_advantage(options, config)
        receding = RecedingHorizon(replan_every=1, warm_start=True)
        super().__init__(env, config, mppi_plan, receding, reward_key, action_key, **options)
        self.advantage_module = advantage_module

    def _with_advantage(self, options: dict[str, Any], config: SearchConfig) -> dict[str, Any]:
        """Check and complete the options of a planner that scores by an advantage module."""
        for name in ("actor", "qvalue"):
            if options.get(name) is not None:
                raise ConfigError(name, "expected none beside an advantage_module, got one.")
        if config.change_cost:
            raise ConfigError("change_cost", "expected 0 beside an advantage_module.")
        if options.setdefault("backend", "env") == "tensor":
            raise ConfigError("backend", "expected 'env' for an advantage_module, got 'tensor'.")
        return {**options, "backend": "env"}

    def problem(self, *, prepared: bool = False, compiled: bool = False) -> Problem:
        """Return model, bounds, actor and value as functions, and the advantage if there is one."""
        problem = super().problem(prepared=prepared, compiled=compiled)
        if self.advantage_module is None:
            return problem
        assert isinstance(problem.model, EnvModel)
        judge = advantage_judge(problem.model, self.advantage_module)
        return replace(problem, judge=judge)

    def built_in(self, settings: SearchConfig) -> Any:
        """Return the settings without the horizon and the lower limit of the std.

        These two are arguments of the plan, so that a schedule does not build it anew.
        """
        return replace(settings, planning_horizon=1, min_std=0.0)

    @classmethod
    def from_config(cls, env: EnvBase, config: MPPIConfig, **options: Any) -> MPPIPlanner:
        """Make the planner that ``config`` describes; ``options`` are those of the class."""
        return cls(env, config, **options)

    def draw_noise(self, batch: Sequence[int]) -> MPPINoise:
        """Draw the random numbers of one plan for observations of this batch size."""
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
            tensordict: observations, of any batch size.
            noise: random numbers of the plan. Drawn by default.

        Returns:
            The action ``[*batch, *action_shape]``.
        """
        batch = tensordict.batch_size
        cold = self.bounds.center.expand(*batch, self.settings.planning_horizon, -1)
        starts = self._starts(tensordict)
        mean = self.receding.recall(starts, cold)
        last = self.receding.last_action(starts, cold[..., 0, :])
        found = self.plan(tensordict, noise, mean, last)
        self.receding.remember(found.mean)
        action = found.actions[..., 0, :]
        if exploration_type() is ExplorationType.RANDOM:
            std = found.std[..., 0, :]
            action = self.bounds.clip(action + std * self._draw(*std.shape))
        self.receding.record(action)
        return action.reshape((*batch, *self.action_spec.shape))

    @torch.no_grad()
    def plan(
        self,
        tensordict: TensorDictBase,
        noise: MPPINoise | None = None,
        mean: Tensor | None = None,
        last: Tensor | None = None,
    ) -> MPPIPlan:
        """Plan without remembering the plan; returns the whole plan.

        Args:
            tensordict: observations, of any batch size.
            noise: random numbers of the plan. Drawn by default.
            mean: center of the first random candidates, ``[*batch, H, m]``. Defaults to the middle
                of the bounds.
            last: the action before, ``[*batch, m]``, for ``change_cost``; NaN where there is none.
        """
        self.check(tensordict)
        if noise is None:
            noise = self.draw_noise(tensordict.batch_size)
        beta = self.settings.noise_beta
        noise = noise._replace(
            samples=colored(noise.samples, beta, dim=1), policy=colored(noise.policy, beta, dim=0)
        )
        # As a tensor, because a schedule of numbers would compile at every step.
        min_std = torch.tensor(
            self.settings.min_std, dtype=self._action_low.dtype, device=self._action_low.device
        )
        last = last if self.settings.change_cost else None
        return self._call_plan(tensordict, noise, mean, min_std, last)
