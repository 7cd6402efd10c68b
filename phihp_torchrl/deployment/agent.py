"""A trained agent: model, actor, critics and planner in one module."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Bounded, Composite

from phihp_torchrl.agents import Actor, TwinQ
from phihp_torchrl.baselines import CATCHES, Controller, Settle, TakeOver
from phihp_torchrl.config import ConfigError, kind_mapping, read_kind, resolve_seconds
from phihp_torchrl.deployment.under_way import UnderWay
from phihp_torchrl.deployment.warm_up import WarmUp
from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.planners import (
    PLANNERS,
    SamplingPlanner,
    SearchConfig,
    is_finite,
    make_planner,
)
from phihp_torchrl.tasks import Task


class Agent(TensorDictModuleBase):
    """A trained agent, which acts by planning (paper, section 4.3) or by its actor.

    It reads ``"observation"`` ``[*batch, o]`` and writes ``"action"`` ``[*batch, m]`` in physical
    units. Model, actor and critics are attributes and may be ``None``. They are shared and not
    copied, so an agent that is made during training changes with it.

    Another sort of agent is a subclass with another :attr:`kind` that overrides
    :meth:`modules_by_name`, :attr:`config`, :meth:`build_modules` and :meth:`from_config`; it can
    then be registered, saved, loaded and evaluated like this one
    (:func:`~phihp_torchrl.deployment.register_agent`).

    Args:
        task: the task that it was trained for.
        dynamics: the model, which the planner needs.
        actor: the policy. One that keeps something from step to step is told by :meth:`reset` that
            an episode starts, if it is a baseline (:mod:`phihp_torchrl.baselines`) or a class with
            a method ``reset()`` that has ``"is_init"`` among its ``in_keys``. The ``reset`` of
            another, and of a network in a ``TensorDictModule``, is not called.
        qvalue: the critics, for the value beyond the planner's horizon.
        catch: a regulator that acts near the task's goal, or on a reference that stands still, in
            the place of a plan, which is then not sought (:class:`~phihp_torchrl.baselines.Catch`,
            :class:`~phihp_torchrl.baselines.Settle`), or ``None``.
        planner_config: settings of the planner; ``None`` for an agent without a planner.
        use_planner: whether to plan; ``False`` is the actor alone. See also :meth:`actor_alone`.
        compile: whether to compile the plan (10 to 40 s the first time, from the cache afterwards).
        metadata: further information for people (seed, commit, returns …), as JSON values.

    Raises:
        ConfigError: if there is neither a planner with a model nor an actor.
        ValueError: when called, for an observation that is missing, not finite, or of the wrong
            shape, dtype or device.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import get_task
        >>> from phihp_torchrl.planners import CEMConfig
        >>> task = get_task("pendulum")
        >>> agent = Agent(
        ...     task,
        ...     dynamics=HybridDynamics.hybrid(task),
        ...     actor=Actor(task),
        ...     qvalue=TwinQ(task),
        ...     planner_config=CEMConfig(),
        ... )
        >>> observation = task.observe(task.reset.sample([4]))
        >>> agent(TensorDict(observation=observation, batch_size=[4]))["action"].shape
        torch.Size([4, 1])
    """

    kind: ClassVar[str] = "phihp"
    """The name of this sort of agent in files."""

    planner: SamplingPlanner | None

    def __init__(
        self,
        task: Task,
        *,
        dynamics: HybridDynamics | None = None,
        actor: Actor | TensorDictModuleBase | None = None,
        qvalue: TwinQ | TensorDictModuleBase | None = None,
        catch: TakeOver | None = None,
        planner_config: SearchConfig | None = None,
        use_planner: bool = True,
        compile: bool | dict[str, Any] = False,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.in_keys = ["observation"]
        self.out_keys = ["action"]
        if isinstance(actor, Actor):
            actor = TensorDictModule(actor, ["observation"], ["action"])
        if isinstance(qvalue, TwinQ):
            qvalue = TensorDictModule(qvalue, ["observation", "action"], ["state_action_value"])
        self.task = task
        self.dynamics = dynamics
        self.actor = actor
        self.qvalue = qvalue
        self.catch = catch
        if planner_config is not None:
            planner_config = resolve_seconds(planner_config, task.time_step)
        self.planner_config = planner_config
        self.metadata = dict(metadata or {})
        self._memory = UnderWay(task, dynamics) if task.register_count else None
        self.planner = None
        self._warm_up: WarmUp | None = None
        if use_planner and planner_config is not None:
            self.planner = self._make_planner(planner_config, compile)
        elif actor is None:
            raise ConfigError("actor", "expected one for an agent that does not plan, got None.")
        remembers = self.planner is not None and self.planner.receding is not None
        remembers |= isinstance(catch, Settle)
        if remembers or self._memory is not None:
            self.in_keys.append("is_init")

    @property
    def spec(self) -> Composite:
        """The spec of the action, ``"action"`` ``[m]`` in physical units."""
        parameter = next(self.parameters(), torch.zeros(()))
        low, high = (limit.to(parameter) for limit in self.task.bounds[:2])
        return Composite(action=Bounded(low=low, high=high, dtype=low.dtype))

    def _make_planner(
        self, config: SearchConfig, compile: bool | dict[str, Any]
    ) -> SamplingPlanner:
        if self.dynamics is None:
            raise ConfigError("dynamics", "expected a model for the planner, got None.")
        world_model = TaskWorldModel(self.task, self.dynamics)
        return make_planner(world_model, self.actor, self.qvalue, config, compile=compile)

    def forward(
        self, tensordict: TensorDictBase, tensordict_out: TensorDictBase | None = None
    ) -> TensorDictBase:
        """Write ``"action"`` ``[*batch, m]`` for ``"observation"`` ``[*batch, o]``; no gradients.

        Where the planner replans every few steps or starts warm, ``"is_init"`` tells it that an
        episode starts (:class:`torchrl.envs.InitTracker`); without it, call :meth:`reset`. The same
        holds for a task with registers (an actuator, a limit or a price of the action's rate), if
        the observation is the system's alone: the agent then remembers its own commands. Where the
        task limits the rate, the action written is within it.

        A task's reference and inputs are read from ``"reference"`` and ``"inputs"``, unless they
        are in the observation: ``[*batch, k]``, or with their preview ``[*batch, rows, k]``. They
        are needed where an episode starts; later steps keep the last value if the key is missing.

        With a key ``"is_complete"`` the observation is taken as it is, with the estimate of a
        disturbance in it: somebody else keeps that, as a
        :class:`~phihp_torchrl.deployment.Controller` does.

        Args:
            tensordict: the observations.
            tensordict_out: where the action is written. Defaults to ``tensordict``.
        """
        if tensordict_out is not None:
            return tensordict_out.set("action", self.forward(tensordict.copy())["action"])
        with torch.no_grad():
            if self._memory is not None and self._memory.is_asked(tensordict):
                seen = self._memory.extend(tensordict)
                action = self._memory.record(self._act(seen)["action"])
                return tensordict.set("action", action)
            acted, task = self._act(tensordict), self.task
            if task.action_rate_limit is None:
                return acted
            _, registers = task.split(task.locate(acted["observation"]))
            return acted.set("action", task.command(registers, acted["action"]))

    def follow(self, sent: Tensor, missed: int = 0) -> None:
        """Go on from what was sent since this agent last acted.

        Args:
            sent: the command ``[*batch, m]`` that was sent last, in the place of its own action.
            missed: steps since then in which it was not asked.
        """
        if self.planner is not None and self.planner.receding is not None:
            self.planner.receding.follow(sent, missed)
        if self.catch is not None:
            self.catch.follow(sent)

    def _act(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.planner is not None:
            return self._plan(tensordict) if self.catch is None else self._hold(tensordict)
        observation = self._check(tensordict.get("observation", None), tensordict.batch_size)
        network, action = getattr(self.actor, "module", None), None
        if isinstance(network, Actor) and not _is_followed(self.actor):
            action = network.evaluate(observation)
        if action is None:
            return self.actor(tensordict)  # type: ignore[misc]  # one of the two is there
        return tensordict.set("action", action)

    def _plan(self, tensordict: TensorDictBase) -> TensorDictBase:
        assert self.planner is not None
        return self.planner(tensordict)

    def _hold(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Plan, but where the regulator acts; where it does in all rows, no plan is sought."""
        assert self.catch is not None
        assert self.planner is not None
        self.planner.check(tensordict)
        starts = tensordict.get("is_init", None)
        if starts is not None:
            starts = starts.reshape(tensordict.batch_size)
        near, held = self.catch.take(self.task.locate(tensordict["observation"]), starts)
        missed = 1
        if not near.all() or (starts is not None and starts.any()):
            planned, missed = self._plan(tensordict)["action"], 0
            held = torch.where(near.unsqueeze(-1), held, planned)
        self.follow(held, missed)
        return tensordict.set("action", held)

    def _planner_input(self, tensordict: TensorDictBase) -> TensorDictBase:
        """What the planner is given for an observation."""
        return tensordict

    def example(self) -> TensorDictBase:
        """What the planner is given for one observation where an episode starts."""
        tensor = next(self.parameters())
        state = self.task.sample_start([], torch.Generator().manual_seed(0))
        observation = self.task.observe(state).to(tensor)
        starts = torch.ones(1, dtype=torch.bool, device=tensor.device)
        with torch.no_grad():
            return self._planner_input(TensorDict(observation=observation, is_init=starts))

    def warm_up(self, *, background: bool = False) -> WarmUp:
        """Compile the plan for one observation at a time, before an episode needs it.

        In the foreground that takes 10 to 60 s the first time, and seconds from the compiler's
        cache. In the background another process compiles it (an AOTInductor package, with the
        weights as they are now); the agent plans eagerly meanwhile, and takes the compiled plan at
        the first :meth:`reset` after it is ready, so that no step of an episode waits for it.

        Args:
            background: whether to return at once.

        Returns:
            What is under way: ``ready``, and ``wait(seconds)``, which takes the plan as well.

        Examples:
            >>> from phihp_torchrl import load_agent
            >>> agent = load_agent("results/agents/pendulum")  # doctest: +SKIP
            >>> agent.warm_up().ready  # doctest: +SKIP
            True
        """
        self._warm_up = WarmUp(self, background=background)
        return self._warm_up

    def reset(self) -> None:
        """Drop the previous plan, what is under way and the actor's memory, as an episode starts.

        Which actors have a memory is said where an agent is given one.
        """
        if self._warm_up is not None and self._warm_up.take():
            self._warm_up = None
        for part in (self.planner, self._memory, self.catch):
            if part is not None:
                part.reset()
        actor: Any = self.actor
        if _has_memory(actor):
            actor.reset()

    def __getstate__(self) -> dict[str, Any]:
        # A copy, or another process, does not wait for what is compiled for this one.
        return {**super().__getstate__(), "_warm_up": None}

    def actor_alone(self) -> Agent:
        """Return the same agent without planning, with the same modules."""
        return self.with_planner(None)

    def with_planner(self, config: SearchConfig | None, **options: Any) -> Agent:
        """Return an agent with the same modules and other planner settings, or without planning.

        Args:
            config: settings of the planner; ``None`` for the actor alone.
            options: ``compile``.
        """
        parts = {name: getattr(self, name) for name in ("dynamics", "actor", "qvalue", "catch")}
        return Agent(
            self.task,
            **parts,
            planner_config=config or self.planner_config,
            use_planner=config is not None,
            metadata=self.metadata,
            **options,
        )

    # Description, from which the agent is built again.

    def modules_by_name(self) -> dict[str, nn.Module]:
        """Return the modules that have weights, without their TensorDict modules."""
        parts = {
            "dynamics": self.dynamics,
            "actor": getattr(self.actor, "module", self.actor),
            "qvalue": getattr(self.qvalue, "module", self.qvalue),
            "catch": self.catch,
        }
        return {name: part for name, part in parts.items() if part is not None}

    @property
    def config(self) -> dict[str, Any]:
        """Plain values from which the agent can be built again, without the weights.

        Raises:
            ConfigError: for a module without an attribute ``config`` of that sort.
        """
        described: dict[str, Any] = {}
        for name, part in self.modules_by_name().items():
            config = getattr(part, "config", None)
            if not isinstance(config, dict):
                raise ConfigError(
                    name,
                    "expected a part that says how it is built (`config`, `from_config`), "
                    f"got a {type(part).__name__}.",
                )
            described[name] = config
        planner = self.planner_config
        described["planner"] = None if planner is None else kind_mapping(planner)
        return described

    @classmethod
    def build_modules(cls, task: Task, config: Mapping[str, Any]) -> dict[str, Any]:
        """Build the modules that :attr:`config` describes, untrained."""
        classes: dict[str, Any] = {"dynamics": HybridDynamics, "actor": Actor, "qvalue": TwinQ}
        if config.get("catch") is not None:
            kind = config["catch"]["kind"]
            if kind not in CATCHES:
                raise ConfigError("catch.kind", f"expected one of {list(CATCHES)}, got {kind!r}.")
            classes["catch"] = CATCHES[kind]
        return {
            name: classes[name].from_config(task, config[name])
            for name in classes
            if config.get(name) is not None
        }

    @classmethod
    def from_config(
        cls, task: Task, config: Mapping[str, Any], modules: Mapping[str, Any], **options: Any
    ) -> Agent:
        """Build the agent that :attr:`config` describes, from these modules.

        Args:
            task: the task that it was trained for.
            config: its description.
            modules: the modules of :meth:`build_modules`, with their weights.
            options: ``use_planner``, ``compile`` and ``metadata``.
        """
        planner = config.get("planner")
        if planner is not None:
            planner = read_kind(PLANNERS, planner, "planner")
        return cls(task, **modules, planner_config=planner, **options)

    def _check(self, observation: Tensor | None, batch: torch.Size) -> Tensor:
        shape = [*batch, self.task.observation_dim]
        if observation is None:
            raise ValueError(f"observation: expected a tensor of shape {shape}, got none.")
        network = getattr(self.actor, "module", None)
        if isinstance(network, Actor):
            parameter = network.center  # found faster than a parameter
        else:
            parameter = next(self.actor.parameters(), observation)  # type: ignore[union-attr]
        expected = (torch.Size(shape), parameter.dtype, parameter.device)
        if (observation.shape, observation.dtype, observation.device) != expected:
            raise ValueError(
                f"observation: expected {parameter.dtype} of shape {shape} on {parameter.device}, "
                f"got {observation.dtype} of shape {list(observation.shape)} "
                f"on {observation.device}."
            )
        if observation.device.type == "cpu" and not is_finite(observation):
            raise ValueError("observation: expected finite observations, got some that are not.")
        return observation


def _has_memory(actor: Any) -> bool:
    """Whether an actor's own class has a ``reset()`` for where an episode starts.

    A TensorDictModule has the attributes of its network too, whose ``reset`` may be anything.
    """
    reads_starts = "is_init" in getattr(actor, "in_keys", ())
    return isinstance(actor, Controller) or (reads_starts and hasattr(type(actor), "reset"))


def _is_followed(module: Any) -> bool:
    """Whether somebody follows the calls of a module, but not those of its parts."""
    return bool(module._forward_hooks or module._forward_pre_hooks)
