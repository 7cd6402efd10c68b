"""Hybrid planning by CEM as a TorchRL module, from observation to action."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from phihp_torchrl.planners.candidates import Plan
from phihp_torchrl.planners.cem import CEMConfig, cem_plan
from phihp_torchrl.planners.colored_noise import colored
from phihp_torchrl.planners.receding_horizon import RecedingHorizon
from phihp_torchrl.planners.sampling_planner import SamplingPlanner


class CEMPlanner(SamplingPlanner):
    """Plan by the cross-entropy method, guided by a policy (PhIHP, section 4.3).

    At each call the candidates are action sequences of the actor, rolled out in the model, and
    random ones. Their scores are the rewards in the model plus Q beyond the horizon. A Gaussian is
    refitted to the elites and sampled for the next iteration; the planner acts with its last mean.
    Without an actor and Q this is plain CEM. A candidate whose score is not finite is never chosen,
    and if no score is finite the planner takes the actor's action.

    It has the same first arguments as :class:`torchrl.modules.CEMPlanner` and can replace it. The
    differences: the Gaussian starts with the half-range of the action as its scale, rewards are
    discounted, and only ``"terminated"`` ends a sequence, not a limit of steps (see ``done_keys``).

    It plans on any stateless environment. If the environment has a ``tensor_model``, as
    :class:`~phihp_torchrl.WorldModelEnv` has, the planner calls its pure tensor functions, which is
    faster and can be compiled; otherwise it steps the environment. Both give the same action for
    the same noise.

    References: the cross-entropy method, https://doi.org/10.1007/s10479-005-5724-z; PhIHP,
    https://arxiv.org/abs/2407.02217.

    Args:
        env: the environment to plan on, of batch size ``[]``.
        planning_horizon: actions in a sequence, ``H``.
        optim_steps: iterations of sampling, scoring and refitting, ``I``.
        num_candidates: sequences scored in each iteration, the actor's included (paper: 220).
        top_k: number of elites, to which the Gaussian is refitted.
        reward_key: key of the reward after a step.
        action_key: key of the action.
        actor: a module that writes ``action_key``, in physical units.
        qvalue: a module that reads observation and action and writes ``value_key``,
            ``[*batch, 1]``; of several values, ``[*batch, critics]`` or stacked
            ``[critics, *batch, 1]``, the smallest is used. Needs an actor, which chooses the action
            beyond the horizon.
        options: any other field of :class:`~phihp_torchrl.planners.CEMConfig` by its name
            (``num_policy_candidates``, ``alpha``, ``gamma``, ``init_std``, ``select``,
            ``replan_every``, ``warm_start`` and so on), and any other argument of
            :class:`~phihp_torchrl.planners.SamplingPlanner` (keys, ``backend``, ``compile``,
            ``generator``). ``num_policy_candidates`` defaults to 0 without an actor, and to 20 with
            one, but no more than ``num_candidates``.

    Raises:
        ValueError: for an argument out of range or an unknown key; when planning, for an
            observation that is missing, not finite, or of the wrong shape, dtype or device.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import CEMPlanner, HybridDynamics, WorldModelEnv, get_task
        >>> from phihp_torchrl.dynamics import TaskWorldModel
        >>> task = get_task("pendulum")
        >>> env = WorldModelEnv(TaskWorldModel(task, HybridDynamics.hybrid(task)))
        >>> planner = CEMPlanner(
        ...     env, planning_horizon=15, optim_steps=3, num_candidates=100, top_k=10, gamma=1.0
        ... )
        >>> observation = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 1.0]])
        >>> planner(TensorDict(observation=observation, batch_size=[2]))["action"].shape
        torch.Size([2, 1])
    """

    settings: CEMConfig
    settings_class = CEMConfig

    def __init__(
        self,
        env: EnvBase,
        planning_horizon: int,
        optim_steps: int,
        num_candidates: int,
        top_k: int,
        reward_key: NestedKey = ("next", "reward"),
        action_key: NestedKey = "action",
        *,
        actor: TensorDictModuleBase | None = None,
        qvalue: TensorDictModuleBase | None = None,
        **options: Any,
    ) -> None:
        numbers = {f.name for f in fields(CEMConfig)}
        settings = {name: options.pop(name) for name in list(options) if name in numbers}
        # The default number of candidates of the actor.
        most = 0 if actor is None else min(CEMConfig.num_policy_candidates, num_candidates)
        config = CEMConfig(
            planning_horizon=planning_horizon,
            optim_steps=optim_steps,
            num_candidates=num_candidates,
            top_k=top_k,
            **{"num_policy_candidates": most, **settings},
        )
        options.update(actor=actor, qvalue=qvalue)
        super().__init__(env, config, cem_plan, None, reward_key, action_key, **options)

    def _arrange(self) -> None:
        s: Any = self.settings  # which may be wrong still
        now = self.receding
        if not isinstance(s, CEMConfig):
            pass  # the base class says so
        elif not (s.replan_every > 1 or s.warm_start or s.change_cost > 0):
            self.receding = None
        elif now is None or (now.replan_every, now.warm_start) != (s.replan_every, s.warm_start):
            self.receding = RecedingHorizon(s.replan_every, s.warm_start)
        super()._arrange()

    @classmethod
    def from_config(cls, env: EnvBase, config: CEMConfig, **options: Any) -> CEMPlanner:
        """Make the planner that ``config`` describes; ``options`` are all other arguments."""
        return cls(env, **{f.name: getattr(config, f.name) for f in fields(config)}, **options)

    @torch.no_grad()
    def planning(self, tensordict: TensorDictBase, noise: Tensor | None = None) -> Tensor:
        """Plan from the observations in ``tensordict``, and remember the plan where that is needed.

        Args:
            tensordict: observations, of any batch size.
            noise: standard normal noise of :meth:`CEMConfig.noise_shape`. Drawn by default.

        Returns:
            The action ``[*batch, *action_shape]``.
        """
        batch = tensordict.batch_size
        if self.receding is None:
            actions = self.plan(tensordict, noise).actions
            return actions[..., 0, :].reshape((*batch, *self.action_spec.shape))
        starts, center = self._starts(tensordict), self.bounds.center
        last = None
        if self._asks_for_last:
            last = self.receding.last_action(starts, center.expand(*batch, -1))
        action = self.receding.act(
            lambda mean: self.plan(tensordict, noise, mean, last).actions,
            batch,
            starts,
            center.expand(self.settings.planning_horizon, -1),
        )
        self.receding.record(action)
        return action.reshape((*batch, *self.action_spec.shape))

    @torch.no_grad()
    def plan(
        self,
        tensordict: TensorDictBase,
        noise: Tensor | None = None,
        mean: Tensor | None = None,
        last: Tensor | None = None,
    ) -> Plan:
        """Plan without remembering the plan; returns the whole sequence and its score.

        Args:
            tensordict: observations, of any batch size.
            noise: standard normal noise of :meth:`CEMConfig.noise_shape`. Drawn by default.
            mean: center of the first random candidates, ``[*batch, H, m]``. Defaults to the middle
                of the bounds.
            last: the action before, ``[*batch, m]``, for ``change_cost`` and ``keep_incumbent``;
                NaN where an episode starts.

        Returns:
            Actions ``[*batch, H, m]``, in bounds, and score ``[*batch]``.
        """
        self.check(tensordict)
        batch = tensordict.batch_size
        shape = self.settings.noise_shape(tuple(batch), self._action_low.numel())
        if noise is None:
            noise = self._draw(*shape)
        elif noise.shape != shape:
            raise ValueError(f"noise: expected shape {list(shape)}, got {list(noise.shape)}.")
        noise = colored(noise, self.settings.noise_beta, dim=1)
        return self._call_plan(tensordict, noise, mean, last if self._asks_for_last else None)

    @property
    def _asks_for_last(self) -> bool:
        """Whether plans depend on the action before."""
        return self.settings.change_cost > 0 or self.settings.keep_incumbent
