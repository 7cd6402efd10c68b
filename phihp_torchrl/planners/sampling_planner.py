"""The base of planners that sample action sequences: keys, modules, backends, receding horizon."""

from __future__ import annotations

import copy
import logging
import math
from abc import abstractmethod
from collections.abc import Callable, Collection, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.modules import MPCPlannerBase

from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.config import refuse_seconds
from phihp_torchrl.planners.deterministic import deterministic, reads_exploration_type
from phihp_torchrl.planners.env_model import (
    EnvModel,
    find_action,
    find_done,
    find_limits,
    find_reward,
    find_situation,
)
from phihp_torchrl.planners.module_functions import actor_function, value_function
from phihp_torchrl.planners.problem import Problem, TensorModel
from phihp_torchrl.planners.receding_horizon import RecedingHorizon
from phihp_torchrl.planners.search import SearchConfig
from phihp_torchrl.tasks import ActionBounds

_logger = logging.getLogger(__name__)


class SamplingPlanner(MPCPlannerBase):
    """The base of planners that score sampled action sequences in a model.

    :class:`~phihp_torchrl.CEMPlanner` and :class:`~phihp_torchrl.MPPIPlanner` extend it with their
    plan functions. A planner of your own does the same, implements :meth:`planning`, and is
    registered by :func:`~phihp_torchrl.register_planner`.

    Args:
        env: the environment to plan on, of batch size ``[]``.
        settings: settings of the search.
        plan: the plan as a pure function, with ``problem`` and ``settings`` among its keywords.
        receding: the receding horizon, which keeps plans between steps, or ``None``.
        reward_key: key of the reward after a step.
        action_key: key of the action.
        actor: a module that writes ``action_key``, in physical units, or ``None``.
        qvalue: a module that reads observation and action and writes ``value_key``; of several
            values the smallest is used. Needs an actor.
        observation_key: the observation that the tensor model reads. Defaults to
            ``"observation"``, or to the only observation.
        done_keys: keys of the flags after which rewards no longer count. Defaults to all keys of
            the environment that end in ``"terminated"``.
        value_key: the key that ``qvalue`` writes.
        is_init_key: key of a bool that is true where an episode starts (see
            :class:`torchrl.envs.InitTracker`); without it, call :meth:`reset`.
        backend: ``"tensor"`` calls the environment's ``tensor_model``, ``"env"`` steps the
            environment, and ``"auto"`` uses the tensor model if possible.
        compile: whether to compile the plan as one full graph; a dict is passed to
            :func:`torch.compile`. A plan that steps the environment, or whose model does not
            compile, is not compiled, and a warning is logged.
        generator: source of the noise, on the environment's device. Defaults to torch's global
            generator.

    Raises:
        ValueError: for an argument out of range or an unknown key; when planning, for an
            observation that is missing, not finite, or of the wrong shape, dtype or device.

    Examples:
        >>> from phihp_torchrl import CEMPlanner, HybridDynamics, WorldModelEnv, get_task
        >>> from phihp_torchrl.dynamics import TaskWorldModel
        >>> task = get_task("pendulum")
        >>> env = WorldModelEnv(TaskWorldModel(task, HybridDynamics.hybrid(task)))
        >>> planner = CEMPlanner(env, 5, optim_steps=2, num_candidates=16, top_k=4)
        >>> isinstance(planner, SamplingPlanner), planner.uses_tensors, planner.in_keys
        (True, True, ['observation'])
    """

    def __init__(
        self,
        env: EnvBase,
        settings: SearchConfig,
        plan: Callable[..., Any],
        receding: RecedingHorizon | None,
        reward_key: NestedKey = ("next", "reward"),
        action_key: NestedKey = "action",
        *,
        actor: TensorDictModuleBase | None = None,
        qvalue: TensorDictModuleBase | None = None,
        observation_key: NestedKey | None = None,
        done_keys: NestedKey | Sequence[NestedKey] | None = None,
        value_key: NestedKey = "state_action_value",
        is_init_key: NestedKey = "is_init",
        backend: str = "auto",
        compile: bool | dict[str, Any] = False,
        generator: torch.Generator | None = None,
    ) -> None:
        refuse_seconds(settings)
        refuse_seconds(settings)  # an environment does not say how long its step is
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
        self._bounds: ActionBounds | None = None  # computed once from these, not for each action
        self.receding = receding
        self._choose_backend(backend, done_keys is None, bool(compile))
        # With either backend, a tensor model computes the state from one observation.
        self.in_keys = list(situation)
        if self._has_tensor_model() and self.observation_key is not None:
            self.in_keys = list(dict.fromkeys([self.observation_key, *self._module_keys()]))
        self._expected = {key: situation[key] for key in self.in_keys}
        self._compile = compile
        self._plan = plan
        # One for each set of shapes, because each is compiled to a separate graph.
        self._planning_functions: dict[Any, Callable[..., Any]] = {}

    # Construction: checks that the arguments fit together.

    def _has_tensor_model(self) -> bool:
        # TransformedEnv forwards attributes of its base env, whose model lacks the transforms.
        return (
            not isinstance(self.env, TransformedEnv)
            and getattr(self.env, "tensor_model", None) is not None
        )

    def _module_keys(self) -> list[NestedKey]:
        """Return the keys that actor and critics read besides the action."""
        modules = [module for module in (self.actor, self.qvalue) if module is not None]
        keys = [unravel_key(key) for module in modules for key in module.in_keys]
        return [key for key in keys if key != self.action_key]

    def _why_not_tensors(self, default_done_keys: bool) -> str | None:
        """Return the reason why the tensor model cannot be used, or ``None``."""
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
                "%s steps the environment%s: %s.",
                type(self).__name__,
                ", which is not compiled" if compile else "",
                reason or "backend='env'",
            )
        elif compile and not getattr(self.env.tensor_model, "compiles", True):
            _logger.warning(
                "%s is not compiled: the model's integrator does not compile.", type(self).__name__
            )
            compile = False
        self._compiles = compile and self.uses_tensors

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

    def problem(self, *, prepared: bool = False) -> Problem:
        """Return model, bounds, actor and value as functions.

        Args:
            prepared: whether they are for one eager plan, which they make faster, and read the
                weights as they are now. Results are equal up to rounding.
        """
        action_shape = self.action_spec.shape
        if self.uses_tensors:
            model: TensorModel = self.env.tensor_model
            if prepared and hasattr(model, "prepared"):
                model = model.prepared()
        else:
            model = EnvModel(
                self.env, self.action_key, action_shape, self.reward_key, self.done_keys
            )
        actor = value = None
        if self.actor is not None:
            numel = action_shape.numel()
            actor = actor_function(self.actor, self.action_key, numel, prepared=prepared)
        if self.qvalue is not None:
            keys = (self.value_key, self.action_key)
            value = value_function(self.qvalue, *keys, action_shape, prepared=prepared)
        return Problem(model=model, bounds=self.bounds, actor=actor, value=value)

    def why_not_compiled(self) -> str | None:
        """Return the reason why the plan cannot be compiled, or ``None``."""
        if not self.uses_tensors:
            return "it steps the environment"
        if not getattr(self.env.tensor_model, "compiles", True):
            return "the model's integrator does not compile"
        return None

    def example_call(self, tensordict: TensorDictBase) -> tuple[Any, tuple[Any, ...], Any]:
        """Plan eagerly once, leaving the planner and torch's generators as they were.

        Returns:
            The key of the plan's function, the arguments it was called with, and what it returned.
        """
        twin, calls = copy.copy(self), list[tuple[Any, Any]]()
        twin.receding = copy.copy(self.receding)
        twin._compiles = False
        device = self._action_low.device
        twin.generator = torch.Generator(device).manual_seed(0)

        def plan(*args: Any, **fixed: Any) -> Any:
            calls.append((args, self._plan(*args, **fixed)))
            return calls[-1][1]

        twin._plan = plan
        with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            twin.planning(tensordict)
        ((key, _),) = twin._planning_functions.items()
        ((args, result),) = calls
        return key, args, result

    def replace_plan(self, key: Any, function: Callable[..., Any]) -> None:
        """Plan by another function of the same arguments, for the key of :meth:`example_call`."""
        self._planning_functions[key] = function

    def compile_plan(self, tensordict: TensorDictBase) -> None:
        """Compile the plan for observations of this batch size, and plan by that from now on."""
        key, args, _ = self.example_call(tensordict)
        function = self._build(compiled=True)
        with torch.no_grad(), deterministic():
            function(*args)
        self.replace_plan(key, function)

    def _build(self, *, compiled: bool | None = None) -> Callable[..., Any]:
        """Make the plan as a function of observation and noise, compiled if wanted."""
        if not (self._compiles if compiled is None else compiled):
            plan, settings = self._plan, self.settings
            return lambda *args: plan(*args, problem=self.problem(prepared=True), settings=settings)
        problem = self.problem()
        function = partial(self._plan, problem=problem, settings=self.settings)
        options = dict(self._compile) if isinstance(self._compile, dict) else {}
        return compile_graph(
            function,
            cpp_wrapper=self._action_low.device.type == "cpu",
            **options,
        )

    def __getstate__(self) -> dict[str, Any]:
        # The functions refer to the modules of this planner, so a copy has to build its own.
        return {**super().__getstate__(), "_planning_functions": {}}

    def _apply(self, *args: Any, **kwargs: Any) -> SamplingPlanner:
        self._bounds = None
        self._planning_functions = {}  # they refer to the old bounds
        return super()._apply(*args, **kwargs)

    # Planning.

    def forward(
        self, tensordict: TensorDictBase, tensordict_out: TensorDictBase | None = None
    ) -> TensorDictBase:
        """Plan from the observations in ``tensordict``, and write the action."""
        # The base class checks the disk for pandas at every write, and projects actions to bounds
        # in which they already are.
        out = tensordict if tensordict_out is None else tensordict_out
        return out.set(self.action_key, self.planning(tensordict))

    @abstractmethod
    def planning(self, tensordict: TensorDictBase) -> Tensor:
        """Return the action ``[*batch, *action_shape]`` for the observations in ``tensordict``."""

    def reset(self) -> None:
        """Drop the previous plan, at the start of an episode."""
        if self.receding is not None:
            self.receding.clear()

    @property
    def bounds(self) -> ActionBounds:
        """The bounds of the action."""
        if self._bounds is None:
            self._bounds = ActionBounds.from_limits(self._action_low, self._action_high)
        return self._bounds

    def _call_plan(self, tensordict: TensorDictBase, *args: Any) -> Any:
        """Call the plan with the observation and further arguments."""
        shapes = _shapes((tensordict.batch_size, args))
        if shapes not in self._planning_functions:
            self._planning_functions[shapes] = self._build()
        if self.uses_tensors:
            observation = tensordict.get(self.observation_key)
        else:
            observation = tensordict.select(*self.in_keys)
        # Our own modules do not read the exploration type, which belongs to the whole process.
        plain = self.uses_tensors and not reads_exploration_type(self)
        with nullcontext() if plain else deterministic():
            return self._planning_functions[shapes](observation, *args)

    def _starts(self, tensordict: TensorDictBase) -> Tensor | None:
        """Return whether an episode starts, bool ``[*batch]``, or ``None`` if it is unknown."""
        is_init = tensordict.get(self.is_init_key, None)
        return None if is_init is None else is_init.reshape(tensordict.batch_size)

    def _draw(self, *shape: int) -> Tensor:
        """Draw standard normal noise."""
        low = self._action_low
        return torch.randn(shape, generator=self.generator, dtype=low.dtype, device=low.device)

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
            # On other devices this would synchronize; the plan then uses the actor's action.
            if device.type == "cpu" and not is_finite(value):
                raise ValueError(f"{key}: expected finite observations, got some that are not.")


def is_finite(values: Tensor) -> bool:
    """Whether all values are finite; their sum says so first, in a third of the time."""
    return math.isfinite(values.sum().item()) or bool(values.isfinite().all())


def _shapes(arguments: Any) -> Any:
    """Replace the tensors in nested tuples by their shapes."""
    if isinstance(arguments, tuple) and not isinstance(arguments, torch.Size):
        return tuple(map(_shapes, arguments))
    return arguments.shape if isinstance(arguments, Tensor) else arguments


def _choose(situation: Collection[NestedKey], key: NestedKey | None) -> NestedKey | None:
    """Return the key of the observation for a tensor model, or ``None`` if it is ambiguous."""
    if key is not None:
        if unravel_key(key) not in situation:
            raise ValueError(f"observation_key: expected one of {list(situation)}, got {key!r}.")
        return unravel_key(key)
    if "observation" in situation:
        return "observation"
    return next(iter(situation)) if len(situation) == 1 else None
