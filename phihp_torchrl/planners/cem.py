"""Hybrid planning as a TorchRL module: observation in, action out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from phihp_torchrl.planners.base import SamplingPlanner
from phihp_torchrl.planners.core import plan
from phihp_torchrl.planners.memory import PlanMemory
from phihp_torchrl.planners.pool import Plan
from phihp_torchrl.planners.settings import PlanSettings


class CEMPlanner(SamplingPlanner):
    """Plan with the cross-entropy method and a policy as a prior (PhIHP, section 4.3).

    At each call it proposes action sequences, some by the actor rolled out in the model and the
    others at random, scores them by imagined rewards and by Q beyond the horizon, refits a Gaussian
    to the elites, samples from it and so on, and acts with its mean. Without an actor and Q it is
    plain CEM. A score that is not finite never wins, and where all are bad the actor acts.

    It takes the place of :class:`torchrl.modules.CEMPlanner` and its first arguments, except that
    the Gaussian starts with the action bounds as its scale, rewards are discounted, and of what a
    step leaves only ``"terminated"`` ends a sequence (running out of steps does not; see
    ``done_keys``).

    It plans on any stateless environment. One that offers a ``tensor_model``, as
    :class:`~phihp_torchrl.WorldModelEnv` does, is planned on with pure tensor functions, faster and
    compiled if you like; others are stepped. Both give the same action for the same noise.

    References: the cross-entropy method, https://doi.org/10.1007/s10479-005-5724-z; PhIHP,
    https://arxiv.org/abs/2407.02217.

    Args:
        env: the model to plan on, an environment of batch size ``[]``.
        planning_horizon: actions in a sequence, ``H``.
        optim_steps: iterations of sampling, scoring and refitting, ``I``.
        num_candidates: sequences scored in each iteration, the actor's included (paper: 220).
        top_k: elites that the Gaussian is refitted to.
        reward_key: where a step leaves the reward.
        action_key: the action.
        actor: a module that writes ``action_key``, in physical units.
        qvalue: a module that reads observation and action and writes ``value_key``,
            ``[*batch, 1]``; of several values, ``[*batch, critics]`` or stacked
            ``[critics, *batch, 1]``, the smallest counts. Needs an actor, which acts beyond the
            horizon.
        num_policy_candidates: how many of the first iteration's ``num_candidates`` come from the
            actor (paper: 20). The first of these is the actor's own sequence, without noise.
        policy_noise: std of the noise on the others, in units of the action's half-range, as are
            all further stds and clips (for an action without bounds, in its own units).
        policy_noise_clip: bound on that noise.
        alpha: weight of Q beyond the horizon; without ``qvalue`` it has no effect.
        gamma: discount, of rewards without Q as well.
        num_kept_elites: elites that compete again in the next iteration, beside its
            ``num_candidates``.
        init_std: std of the first iteration's random candidates.
        min_std: floor of the refitted std.
        select: act with the refitted ``"mean"`` or with the ``"best"`` sequence met.
        compare_with_actor: whether the actor's own sequence competes in every iteration, and is
            what the planner does unless its plan scores higher. ``False`` as published. No effect
            without ``num_policy_candidates``.
        actor_margin: by how much a plan must score higher for that.
        tail_dtype: ``"bfloat16"`` to evaluate actor and Q beyond the horizon under autocast, faster
            and to about three digits; the last layer of our own critics keeps its precision.
        replan_every: steps of one plan to act before the next, ``RH``.
        warm_start: start from the previous plan, shifted, where an episode goes on.
        observation_key: what the tensor model is given. Defaults to ``"observation"``, or the only
            observation there is.
        done_keys: after which flags of a step nothing counts any more. Defaults to all of the
            environment's that end in ``"terminated"``.
        value_key: what ``qvalue`` writes.
        is_init_key: bool that is true where an episode starts (see
            :class:`torchrl.envs.InitTracker`); with ``replan_every`` and ``warm_start`` it makes
            the planner forget. Without it, call :meth:`reset`.
        backend: ``"tensor"``, ``"env"``, or ``"auto"`` for the first where it can be.
        compile: whether to compile the plan as one full graph; a dict is passed to
            :func:`torch.compile`. Needs the tensor backend and a model whose integrator compiles,
            and is left out otherwise.
        generator: source of the noise, on the environment's device. Defaults to torch's global one.

    Raises:
        ValueError: for an argument out of range or a key that is not there; when planning, for an
            observation that is missing, not finite, or of the wrong shape, dtype or device.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import CEMPlanner, HybridDynamics, WorldModelEnv, get_task
        >>> from phihp_torchrl.dynamics import TaskWorldModel
        >>> task = get_task("pendulum")
        >>> env = WorldModelEnv(TaskWorldModel(task, HybridDynamics.oracle(task)))
        >>> planner = CEMPlanner(
        ...     env, planning_horizon=15, optim_steps=3, num_candidates=100, top_k=10, gamma=1.0
        ... )
        >>> observation = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 1.0]])
        >>> planner(TensorDict(observation=observation, batch_size=[2]))["action"].shape
        torch.Size([2, 1])
    """

    settings: PlanSettings

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
        num_policy_candidates: int = 0,
        policy_noise: float = 0.05,
        policy_noise_clip: float = 0.3,
        alpha: float = 1.0,
        gamma: float = 0.99,
        num_kept_elites: int = 0,
        init_std: float = 1.0,
        min_std: float = 0.0,
        select: str = "mean",
        compare_with_actor: bool = True,
        actor_margin: float = 0.0,
        tail_dtype: str = "float32",
        replan_every: int = 1,
        warm_start: bool = False,
        observation_key: NestedKey | None = None,
        done_keys: NestedKey | Sequence[NestedKey] | None = None,
        value_key: NestedKey = "state_action_value",
        is_init_key: NestedKey = "is_init",
        backend: str = "auto",
        compile: bool | dict[str, Any] = False,
        generator: torch.Generator | None = None,
    ) -> None:
        settings = PlanSettings(
            planning_horizon=planning_horizon,
            optim_steps=optim_steps,
            num_candidates=num_candidates,
            top_k=top_k,
            num_policy_candidates=num_policy_candidates,
            policy_noise=policy_noise,
            policy_noise_clip=policy_noise_clip,
            alpha=alpha,
            gamma=gamma,
            num_kept_elites=num_kept_elites,
            init_std=init_std,
            min_std=min_std,
            select=select,
            compare_with_actor=compare_with_actor,
            actor_margin=actor_margin,
            tail_dtype=tail_dtype,
        )
        super().__init__(
            env,
            settings,
            plan,
            _make_memory(settings, replan_every, warm_start),
            reward_key,
            action_key,
            actor=actor,
            qvalue=qvalue,
            observation_key=observation_key,
            done_keys=done_keys,
            value_key=value_key,
            is_init_key=is_init_key,
            backend=backend,
            compile=compile,
            generator=generator,
        )

    @torch.no_grad()
    def planning(self, tensordict: TensorDictBase, noise: Tensor | None = None) -> Tensor:
        """Plan from ``tensordict``.

        Args:
            tensordict: the observations, of any batch size.
            noise: standard normal, :meth:`PlanSettings.noise_shape`. Drawn if absent.

        Returns:
            The action ``[*batch, *action_shape]``.
        """
        batch = tensordict.batch_size
        if self.memory is None:
            actions = self.plan(tensordict, noise).actions
            return actions[..., 0, :].reshape(*batch, *self.action_spec.shape)
        action = self.memory.act(
            lambda mean: self.plan(tensordict, noise, mean).actions,
            batch,
            self._starts(tensordict),
            self.bounds.center.expand(self.settings.planning_horizon, -1),
        )
        return action.reshape(*batch, *self.action_spec.shape)

    @torch.no_grad()
    def plan(
        self,
        tensordict: TensorDictBase,
        noise: Tensor | None = None,
        mean: Tensor | None = None,
    ) -> Plan:
        """The whole sequence and its score; remembers nothing.

        Args:
            tensordict: the observations, of any batch size.
            noise: standard normal, :meth:`PlanSettings.noise_shape`. Drawn if absent.
            mean: center of the first random candidates, ``[*batch, H, m]``. Defaults to the middle
                of the bounds.

        Returns:
            Actions ``[*batch, H, m]``, in bounds, and score ``[*batch]``.
        """
        self._check_observation(tensordict)
        batch = tensordict.batch_size
        shape = self.settings.noise_shape(tuple(batch), self._action_low.numel())
        if noise is None:
            noise = self._draw(*shape)
        elif noise.shape != shape:
            raise ValueError(f"noise: expected shape {list(shape)}, got {list(noise.shape)}.")
        return self._call_plan(tensordict, noise, mean)


def _make_memory(s: PlanSettings, replan_every: int, warm_start: bool) -> PlanMemory | None:
    if isinstance(replan_every, bool) or not isinstance(replan_every, int):
        raise ValueError(f"replan_every: expected an integer, got {replan_every!r}.")
    if not 1 <= replan_every <= s.planning_horizon:
        raise ValueError(
            f"replan_every: expected 1 to planning_horizon={s.planning_horizon}, "
            f"got {replan_every}."
        )
    if warm_start and s.num_policy_candidates == s.num_candidates:
        raise ValueError(
            "warm_start: expected random candidates to start from the previous plan, got "
            f"num_policy_candidates=num_candidates={s.num_candidates}."
        )
    needed = replan_every > 1 or warm_start
    return PlanMemory(replan_every, warm_start) if needed else None
