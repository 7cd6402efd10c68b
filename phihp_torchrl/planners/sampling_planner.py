"""The base of planners that sample action sequences: keys, modules, backends, receding horizon."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import MPCPlannerBase

from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.config import ConfigError, refuse_seconds
from phihp_torchrl.imagination import pack_generator, unpack_generator
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
from phihp_torchrl.planners.plan_functions import PlanFunctions
from phihp_torchrl.planners.planner_checks import (
    check_modules,
    check_observation,
    choose_observation,
    finite_keys,
    log_backend,
    module_keys,
    needed_keys,
)
from phihp_torchrl.planners.problem import Problem, TensorModel
from phihp_torchrl.planners.receding_horizon import RecedingHorizon
from phihp_torchrl.planners.roll_out import LONG_PLAN
from phihp_torchrl.planners.search import SearchConfig
from phihp_torchrl.planners.stock_attributes import StockAttributes
from phihp_torchrl.planners.transformed import find_tensor_model, why_no_tensor_model
from phihp_torchrl.tasks import ActionBounds


class SamplingPlanner(StockAttributes, MPCPlannerBase):
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
            the environment that end in ``"terminated"``; with ``"done"`` a limit of steps ends a
            sequence too, as in TorchRL's planners.
        value_key: the key that ``qvalue`` writes.
        is_init_key: key of a bool that is true where an episode starts (see
            :class:`torchrl.envs.InitTracker`); without it, call :meth:`reset`.
        backend: ``"tensor"`` calls the environment's ``tensor_model``, ``"env"`` steps the
            environment, and ``"auto"`` uses the tensor model if possible. An environment behind
            transforms has one if these change rewards alone or count steps.
        compile: whether to compile the plan as one full graph; a dict is passed to
            :func:`torch.compile`. A plan that steps the environment, or whose model does not
            compile, is not compiled, and a warning is logged.
        generator: source of the noise, on the environment's device. Defaults to torch's global
            generator.
        in_keys: the keys from which to plan. Defaults to the observation for a tensor model, and
            else to all that the environment is stepped from.
        check_finite: whether observations must be finite. Keys that an environment shows but is not
            stepped from are not checked, unless actor or critics read them.

    ``actor``, ``qvalue`` and :attr:`settings` may be assigned anew, and so may the attributes that
    TorchRL's planners have: ``planning_horizon``, ``optim_steps``, ``num_candidates`` and
    ``top_k``. What has been remembered of earlier plans then stays, where it fits.

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

    settings_class: ClassVar[type[SearchConfig]] = SearchConfig
    """What :attr:`settings` must be."""
    _parts: ClassVar[tuple[str, ...]] = ("actor", "qvalue", "settings")

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
        in_keys: Sequence[NestedKey] | None = None,
        check_finite: bool = True,
    ) -> None:
        action_key, reward_key = unravel_key(action_key), unravel_key(reward_key)
        action_spec = find_action(env, action_key)
        super().__init__(env, action_key=action_key)
        self.settings, self.receding = settings, receding
        self.action_spec, self.action_key = action_spec, action_key
        self.reward_key = find_reward(env, reward_key)
        self.value_key, self.is_init_key = unravel_key(value_key), unravel_key(is_init_key)
        self.done_keys, self._own_done_keys = find_done(env, done_keys), done_keys is not None
        self.observation_key = choose_observation(find_situation(env), observation_key)
        self.actor, self.qvalue = actor, qvalue
        self.generator, self.check_finite = generator, check_finite
        low, high = find_limits(action_spec)
        self.register_buffer("_action_low", low, persistent=False)
        self.register_buffer("_action_high", high, persistent=False)
        self._bounds: ActionBounds | None = None  # computed once from these, not for each action
        self._backend, self._compile, self._given_keys = backend, compile, in_keys
        self._plan = plan
        self._spec = env.full_action_spec_unbatched.clone()
        self._arrange()
        log_backend(self, self._no_tensors, bool(compile))
        self._functions = PlanFunctions()  # from here on, what is assigned anew takes effect

    # Construction, and what is assigned anew: checks that the parts fit together.

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; another actor, critic or settings are checked and take effect."""
        if name not in (*self._parts, "env") or "_functions" not in self.__dict__:
            super().__setattr__(name, value)
            return
        if name == "env":
            raise ConfigError(
                "env", "expected the one that the planner was made with; make another planner."
            )
        old: Any = getattr(self, name, None)
        super().__setattr__(name, value)
        if name == "settings" and self.built_in(value) == self.built_in(old):
            return
        try:
            self._arrange()
        except ValueError:
            super().__setattr__(name, old)
            self._arrange()
            raise
        self._functions.clear()

    def built_in(self, settings: SearchConfig) -> Any:
        """Return what of the settings is a constant of the plan as a function.

        Args:
            settings: settings of the search.
        """
        return settings

    def _arrange(self) -> None:
        """Check actor, critics and settings, and choose keys and backend for them."""
        if not isinstance(self.settings, self.settings_class):
            raise ConfigError(
                "settings",
                f"expected {self.settings_class.__name__}, got {type(self.settings).__name__}.",
            )
        refuse_seconds(self.settings)  # an environment does not say how long its step is
        situation = find_situation(self.env)
        check_modules(self, situation)
        self._no_tensors = self._why_not_tensors()
        if self._backend not in ("auto", "tensor", "env"):
            raise ConfigError(
                "backend", f"expected 'auto', 'tensor' or 'env', got {self._backend!r}."
            )
        if self._backend == "tensor" and self._no_tensors:
            raise ConfigError(
                "backend", f"expected 'env' or 'auto', got 'tensor', but {self._no_tensors}."
            )
        if self.env.batch_size and why_no_tensor_model(self.env, self.reward_key):
            raise ConfigError("env", f"expected batch size [], got {list(self.env.batch_size)}.")
        self.uses_tensors = self._backend != "env" and not self._no_tensors
        self._compiles = bool(self._compile) and self.uses_tensors and self._tensors_compile()
        needed = needed_keys(self, situation, self._given_keys)
        self._expected = {key: situation[key] for key in needed}
        self._finite = finite_keys(self, self._expected)
        self.in_keys = [*needed, *([] if self.receding is None else [self.is_init_key])]

    def _why_not_tensors(self) -> str | None:
        """Return the reason why the tensor model cannot be used, or ``None``."""
        if reason := why_no_tensor_model(self.env, self.reward_key):
            return reason
        if self.observation_key is None:
            return "it has several observations and observation_key does not say which to take"
        base: Any = getattr(self.env, "base_env", self.env)
        if self.reward_key[1:] != ("reward",) or self._own_done_keys or len(base.reward_keys) > 1:
            return "reward_key or done_keys are not those of its tensor_model"
        if others := set(module_keys(self)) - {self.observation_key}:
            return f"actor or qvalue read {sorted(others, key=str)}, not {self.observation_key!r}"
        return None

    def _tensors_compile(self) -> bool:
        return getattr(find_tensor_model(self.env), "compiles", True)

    def problem(self, *, prepared: bool = False, compiled: bool = False) -> Problem:
        """Return model, bounds, actor and value as functions.

        Args:
            prepared: whether they are for one eager plan, which they make faster, and read the
                weights as they are now. Results are equal up to rounding.
            compiled: whether they are for a graph that is compiled, in which the steps of a long
                plan are a loop.
        """
        shape = self.action_spec.shape
        if self.uses_tensors:
            model: TensorModel = find_tensor_model(self.env)
            if prepared and hasattr(model, "prepared"):
                model = model.prepared()
        else:
            model = EnvModel(self.env, self.action_key, shape, self.reward_key, self.done_keys)
        actor = value = None
        if self.actor is not None:
            actor = actor_function(self.actor, self.action_key, shape, prepared=prepared)
        if self.qvalue is not None:
            keys = (self.value_key, self.action_key)
            value = value_function(self.qvalue, *keys, shape, prepared=prepared)
        if not compiled:
            return Problem(model=model, bounds=self.bounds, actor=actor, value=value)
        # Computed here, since an export takes what a planner keeps for a constant of another kind.
        bounds = ActionBounds.from_limits(self._action_low, self._action_high)
        long = self.settings.planning_horizon >= LONG_PLAN and self._action_low.device.type == "cpu"
        return Problem(model=model, bounds=bounds, actor=actor, value=value, in_loop=long)

    @property
    def compiles(self) -> bool:
        """Whether plans are compiled at their first call."""
        return self._compiles

    def why_not_compiled(self) -> str | None:
        """Return the reason why the plan cannot be compiled, or ``None``."""
        if not self.uses_tensors:
            return "it steps the environment"
        if not self._tensors_compile():
            return "the model's integrator does not compile"
        return None

    def example_call(self, tensordict: TensorDictBase) -> tuple[tuple[Any, ...], Any]:
        """Plan eagerly once, leaving the planner and torch's generators as they were.

        Returns:
            The arguments that the plan's function was called with, and what it returned.
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
        ((args, result),) = calls
        return args, result

    def replace_plan(self, args: tuple[Any, ...], function: Callable[..., Any]) -> None:
        """Plan by another function where the arguments have the shapes of ``args``."""
        self._functions.replace(function, *args)

    def plans_ahead(self, tensordict: TensorDictBase) -> bool:
        """Whether observations of this batch size meet a plan that was compiled ahead for them."""
        args, _ = self.example_call(tensordict)
        return self._functions.is_replaced(*args)

    def plan_eagerly(self, *args: Any) -> Any:
        """Call the plan's function for these arguments, neither compiled nor replaced."""
        return self._build(compiled=False)(*args)

    def compile_plan(self, tensordict: TensorDictBase) -> None:
        """Compile the plan for observations of this batch size, and plan by that from now on."""
        args, _ = self.example_call(tensordict)
        function = self._build(compiled=True)
        with torch.no_grad(), deterministic():
            function(*args)
        self.replace_plan(args, function)

    def _build(self, *, compiled: bool | None = None) -> Callable[..., Any]:
        """Make the plan as a function of observation and noise, compiled if wanted."""
        if not (self._compiles if compiled is None else compiled):
            plan, settings = self._plan, self.settings
            return lambda *args: plan(*args, problem=self.problem(prepared=True), settings=settings)
        problem = self.problem(compiled=True)
        function = partial(self._plan, problem=problem, settings=self.settings)
        options = dict(self._compile) if isinstance(self._compile, dict) else {}
        return compile_graph(
            function,
            cpp_wrapper=self._action_low.device.type == "cpu",
            **options,
        )

    def __getstate__(self) -> dict[str, Any]:
        # The functions refer to the modules of this planner, so a copy has to build its own.
        packed = pack_generator(self.generator)
        return {**super().__getstate__(), "_functions": PlanFunctions(), "generator": packed}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__({**state, "generator": unpack_generator(state["generator"])})

    def _apply(self, *args: Any, **kwargs: Any) -> SamplingPlanner:
        super()._apply(*args, **kwargs)
        if "_functions" not in self.__dict__:  # the base class moves what it has
            return self
        self._bounds = None
        self._functions.clear()  # they refer to the old bounds
        self.action_spec = find_action(self.env, self.action_key)
        if self.action_spec.dtype != self._action_low.dtype:
            raise ConfigError(
                "dtype",
                f"expected {self.action_spec.dtype}, as actions of {type(self.env).__name__} have, "
                f"got {self._action_low.dtype}; make a planner on an environment of that dtype.",
            )
        self._arrange()
        return self

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
        if self.uses_tensors:
            observation = tensordict.get(self.observation_key)
        else:
            observation = tensordict.select(*self._expected)
        # Our own modules do not read the exploration type, which belongs to the whole process.
        plain = self.uses_tensors and not reads_exploration_type(self)
        with nullcontext() if plain else deterministic():
            return self._functions.call(self._build, self._compiles, observation, *args)

    def _starts(self, tensordict: TensorDictBase) -> Tensor | None:
        """Return whether an episode starts, bool ``[*batch]``, or ``None`` if it is unknown."""
        is_init = tensordict.get(self.is_init_key, None)
        return None if is_init is None else is_init.reshape(tensordict.batch_size)

    def _draw(self, *shape: int) -> Tensor:
        """Draw standard normal noise."""
        low = self._action_low
        return torch.randn(shape, generator=self.generator, dtype=low.dtype, device=low.device)

    def check(self, tensordict: TensorDictBase) -> None:
        """Raise a ValueError for an observation that is missing, not finite, or of another form."""
        device = self._action_low.device
        check_observation(self, tensordict, self._expected, self._finite, device)
