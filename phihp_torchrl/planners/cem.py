"""Hybrid planning as a TorchRL module: observation in, action out."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MPCPlannerBase

from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.planners.core import Plan, plan
from phihp_torchrl.planners.env_model import (
    EnvModel,
    find_action,
    find_done,
    find_limits,
    find_reward,
    find_situation,
)
from phihp_torchrl.planners.functions import actor_function, value_function
from phihp_torchrl.planners.memory import PlanMemory
from phihp_torchrl.planners.scoring import ActionBounds, Problem, TensorModel
from phihp_torchrl.planners.settings import PlanSettings

_logger = logging.getLogger(__name__)


class CEMPlanner(MPCPlannerBase):
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
            and is left out otherwise. Each batch size is a graph of its own.
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
        )
        action_key, reward_key = unravel_key(action_key), unravel_key(reward_key)
        action_spec = find_action(env, action_key)
        super().__init__(env, action_key=action_key)
        self.action_spec = action_spec
        self.settings = settings
        self.action_key, self.reward_key = action_key, find_reward(env, reward_key)
        self.value_key, self.is_init_key = unravel_key(value_key), unravel_key(is_init_key)
        self.done_keys = find_done(env, done_keys)
        situation = find_situation(env)
        self.observation_key = _choose(situation, observation_key)
        self.actor, self.qvalue = actor, qvalue
        self.generator = generator
        self._check_modules(situation)
        low, high = find_limits(action_spec)
        self.register_buffer("_action_low", low, persistent=False)
        self.register_buffer("_action_high", high, persistent=False)
        self.memory = self._make_memory(replan_every, warm_start)
        self._choose_backend(backend, done_keys is None, bool(compile))
        # A tensor model finds the state from one observation, on either path.
        self.in_keys = list(situation)
        if self._has_tensor_model() and self.observation_key is not None:
            self.in_keys = list(dict.fromkeys([self.observation_key, *self._module_keys()]))
        self._expected = {key: situation[key] for key in self.in_keys}
        self._compile = compile
        # One for each batch size, and one with and one without a mean: compiled, each is a graph.
        self._planning_functions: dict[tuple[torch.Size, bool], Callable[..., Plan]] = {}

    # Construction: what fits together.

    def _has_tensor_model(self) -> bool:
        # A transformed environment lends its base's attributes, and its transforms would be lost.
        return (
            not isinstance(self.env, TransformedEnv)
            and getattr(self.env, "tensor_model", None) is not None
        )

    def _module_keys(self) -> list[NestedKey]:
        """What actor and critics read besides the action."""
        modules = [module for module in (self.actor, self.qvalue) if module is not None]
        keys = [unravel_key(key) for module in modules for key in module.in_keys]
        return [key for key in keys if key != self.action_key]

    def _why_not_tensors(self, default_done_keys: bool) -> str | None:
        """Why the environment must be stepped, if so."""
        if not self._has_tensor_model():
            return f"{type(self.env).__name__} has no tensor_model of its own"
        if self.observation_key is None:
            return "it has several observations and observation_key does not say which to take"
        if self.reward_key != ("next", "reward") or not default_done_keys:
            return "reward_key or done_keys are not those of its tensor_model"
        if others := set(self._module_keys()) - {self.observation_key}:
            return f"actor or qvalue read {sorted(others, key=str)}, not {self.observation_key!r}"
        return None

    def _choose_backend(self, backend: str, default_done_keys: bool, compile: bool) -> None:
        if backend not in ("auto", "tensor", "env"):
            raise ValueError(f"backend: expected 'auto', 'tensor' or 'env', got {backend!r}.")
        reason = self._why_not_tensors(default_done_keys)
        if backend == "tensor" and reason:
            raise ValueError(f"backend: expected 'env' or 'auto', got 'tensor', but {reason}.")
        if self.env.batch_size and not self._has_tensor_model():
            raise ValueError(f"env: expected batch size [], got {list(self.env.batch_size)}.")
        self.uses_tensors = backend != "env" and not reason
        if not self.uses_tensors:
            _logger.log(
                logging.WARNING if compile else logging.INFO,
                "CEMPlanner steps the environment%s: %s.",
                ", which is not compiled" if compile else "",
                reason or "backend='env'",
            )
        elif compile and not getattr(self.env.tensor_model, "compiles", True):
            _logger.warning("CEMPlanner is not compiled: the model's integrator does not compile.")
            compile = False
        self._compiles = compile and self.uses_tensors

    def _make_memory(self, replan_every: int, warm_start: bool) -> PlanMemory | None:
        s = self.settings
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

    def _check_modules(self, situation: Collection[NestedKey]) -> None:
        actor, qvalue = self.actor, self.qvalue
        if actor is None and self.settings.num_policy_candidates:
            raise ValueError(
                "actor: expected a module to propose num_policy_candidates="
                f"{self.settings.num_policy_candidates} sequences, got None."
            )
        if actor is None and qvalue is not None:
            raise ValueError(
                "actor: expected a module to act beyond the horizon, for qvalue, got None."
            )
        for name, module, key in (
            ("actor", actor, self.action_key),
            ("qvalue", qvalue, self.value_key),
        ):
            if module is None:
                continue
            if key not in (keys := getattr(module, "out_keys", [])):
                raise ValueError(
                    f"{name}: expected a TensorDict module that writes {key!r}, "
                    f"got {type(module).__name__} that writes {list(keys)}."
                )
            allowed = [*situation, *([self.action_key] if module is qvalue else [])]
            if unknown := [k for k in module.in_keys if unravel_key(k) not in allowed]:
                raise ValueError(f"{name}: expected in_keys among {allowed}, got {unknown}.")

    def _build(self) -> Callable[..., Plan]:
        """The plan as a function of observation, noise and mean."""
        action_shape = self.action_spec.shape
        if self.uses_tensors:
            model: TensorModel = self.env.tensor_model
        else:
            model = EnvModel(
                self.env, self.action_key, action_shape, self.reward_key, self.done_keys
            )
        actor = value = None
        if self.actor is not None:
            actor = actor_function(self.actor, self.action_key, action_shape.numel())
        if self.qvalue is not None:
            value = value_function(self.qvalue, self.value_key, self.action_key, action_shape)
        bounds = ActionBounds.from_limits(self._action_low, self._action_high)
        problem = Problem(model=model, bounds=bounds, actor=actor, value=value)
        function = partial(plan, problem=problem, settings=self.settings)
        options = dict(self._compile) if isinstance(self._compile, dict) else {}
        return compile_graph(function, enabled=self._compiles, **options)

    def __getstate__(self) -> dict[str, Any]:
        # The functions hold on to these very modules, so a copy builds its own.
        return {**super().__getstate__(), "_planning_functions": {}}

    def _apply(self, *args: Any, **kwargs: Any) -> CEMPlanner:
        self._planning_functions = {}  # they hold the bounds as they were
        return super()._apply(*args, **kwargs)

    # Planning.

    def reset(self) -> None:
        """Forget the previous plan: a new episode starts."""
        if self.memory is not None:
            self.memory.clear()

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
        is_init = tensordict.get(self.is_init_key, None)
        if is_init is not None:
            is_init = is_init.reshape(batch)
        center = ActionBounds.from_limits(self._action_low, self._action_high).center
        action = self.memory.act(
            lambda mean: self.plan(tensordict, noise, mean).actions,
            batch,
            is_init,
            center.expand(self.settings.planning_horizon, -1),
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
        low = self._action_low
        shape = self.settings.noise_shape(tuple(batch), low.numel())
        if noise is None:
            noise = torch.randn(shape, generator=self.generator, dtype=low.dtype, device=low.device)
        elif noise.shape != shape:
            raise ValueError(f"noise: expected shape {list(shape)}, got {list(noise.shape)}.")
        shapes = (batch, mean is None)
        if shapes not in self._planning_functions:
            self._planning_functions[shapes] = self._build()
        if self.uses_tensors:
            observation = tensordict.get(self.observation_key)
        else:
            observation = tensordict.select(*self.in_keys)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return self._planning_functions[shapes](observation, noise, mean)

    def _check_observation(self, tensordict: TensorDictBase) -> None:
        batch, device = tensordict.batch_size, self._action_low.device
        for key, spec in self._expected.items():
            value = tensordict.get(key, None)
            shape = torch.Size([*batch, *spec.shape])
            if value is None:
                raise ValueError(f"{key}: expected a tensor of shape {list(shape)}, got none.")
            if value.shape != shape or value.dtype != spec.dtype or value.device != device:
                raise ValueError(
                    f"{key}: expected {spec.dtype} of shape {list(shape)} on {device}, "
                    f"got {value.dtype} of shape {list(value.shape)} on {value.device}."
                )
            # Elsewhere this would wait for the device; the plan falls back to the actor's action.
            if device.type == "cpu" and not value.isfinite().all():
                raise ValueError(f"{key}: expected finite observations, got some that are not.")


def _choose(situation: Collection[NestedKey], key: NestedKey | None) -> NestedKey | None:
    """The observation that a tensor model is given, if it is clear which."""
    if key is not None:
        if unravel_key(key) not in situation:
            raise ValueError(f"observation_key: expected one of {list(situation)}, got {key!r}.")
        return unravel_key(key)
    if "observation" in situation:
        return "observation"
    return next(iter(situation)) if len(situation) == 1 else None
