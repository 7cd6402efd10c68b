"""What an agent is made of, as data: enough to build it again before its weights are read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import nn

from phihp_torchrl.agents.networks import Actor, TwinQ
from phihp_torchrl.deployment.agent import Agent
from phihp_torchrl.dynamics import HybridDynamics, PhysicsPrior, ResidualMLP, WorldPhysics
from phihp_torchrl.integrators import Integrator, make_integrator
from phihp_torchrl.planners.factory import PlannerConfig
from phihp_torchrl.tasks import Task

_INTEGRATORS = ("semi_implicit_euler", "rk4", "dopri5")
_ACTIVATIONS: dict[str, type[nn.Module]] = {
    kind.__name__: kind for kind in (nn.ReLU, nn.Tanh, nn.SiLU, nn.ELU, nn.GELU, nn.Softplus)
}
_MAX_WIDTH = 65_536
_MAX_LAYERS = 32


@dataclass(frozen=True)
class TaskSignature:
    """The task that an agent was trained for, as far as its weights depend on it.

    Args:
        name: by which :func:`~phihp_torchrl.get_task` knows it.
        state_names: components of the state.
        action_names: components of the action.
        constants: names of the prior's constants.
        action_high: bounds of the action.
        time_step: seconds.
    """

    name: str
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    constants: tuple[str, ...]
    action_high: tuple[float, ...]
    time_step: float

    @classmethod
    def of(cls, task: Task) -> TaskSignature:
        """The signature of a task."""
        return cls(
            name=task.name,
            state_names=tuple(task.system.state_names),
            action_names=tuple(task.system.action_names),
            constants=tuple(task.system.constants),
            action_high=tuple(task.action_high),
            time_step=task.time_step,
        )


@dataclass(frozen=True)
class ResidualBlueprint:
    """A :class:`~phihp_torchrl.dynamics.ResidualMLP`.

    Args:
        hidden_sizes: widths of the hidden layers.
        outputs: the components of ds/dt that it changes.
        activation: name of the activation's class.
    """

    hidden_sizes: tuple[int, ...]
    outputs: tuple[int, ...]
    activation: str

    def __post_init__(self) -> None:
        check_sizes("residual.hidden_sizes", self.hidden_sizes)
        if self.activation not in _ACTIVATIONS:
            raise ValueError(
                f"residual.activation: expected one of {sorted(_ACTIVATIONS)}, "
                f"got {self.activation!r}."
            )

    @classmethod
    def of(cls, residual: ResidualMLP) -> ResidualBlueprint:
        """The blueprint of a residual."""
        return cls(
            hidden_sizes=hidden_sizes(residual.network),
            outputs=residual.outputs,
            activation=type(residual.network[1]).__name__,
        )

    def build(self, task: Task) -> ResidualMLP:
        """A new residual, untrained."""
        indices = range(task.system.state_dim)
        known = sorted(set(self.outputs) & set(indices))
        if not known or list(self.outputs) != known:
            raise ValueError(
                f"residual.outputs: expected some of {list(indices)}, got {self.outputs!r}."
            )
        activation = _ACTIVATIONS[self.activation]
        return ResidualMLP(task.system, self.hidden_sizes, self.outputs, activation)


@dataclass(frozen=True)
class DynamicsBlueprint:
    """A :class:`~phihp_torchrl.HybridDynamics`.

    Args:
        prior: ``"learned"`` constants, the ``"world"`` itself (an oracle), or ``None``.
        residual: its residual, or ``None``.
        integrator: name of the solver.
    """

    prior: str | None
    residual: ResidualBlueprint | None
    integrator: str

    def __post_init__(self) -> None:
        if self.prior not in ("learned", "world", None):
            raise ValueError(f"prior: expected 'learned', 'world' or null, got {self.prior!r}.")
        if self.integrator not in _INTEGRATORS:
            raise ValueError(
                f"integrator: expected one of {list(_INTEGRATORS)}, got {self.integrator!r}."
            )

    @classmethod
    def of(cls, dynamics: HybridDynamics) -> DynamicsBlueprint:
        """The blueprint of a transition; ``ValueError`` if some part is none of ours."""
        prior, residual = dynamics.prior, dynamics.residual
        kinds = {type(None): None, PhysicsPrior: "learned", WorldPhysics: "world"}
        if type(prior) not in kinds:
            raise ValueError(
                f"dynamics.prior: expected a PhysicsPrior or None, got {type(prior).__name__}."
            )
        if residual is not None and type(residual) is not ResidualMLP:
            raise ValueError(
                f"dynamics.residual: expected a ResidualMLP or None, got {type(residual).__name__}."
            )
        return cls(
            prior=kinds[type(prior)],
            residual=None if residual is None else ResidualBlueprint.of(residual),
            integrator=_integrator_name(dynamics.integrator),
        )

    def build(self, task: Task) -> HybridDynamics:
        """A new transition, untrained."""
        priors = {"learned": PhysicsPrior, "world": WorldPhysics}
        return HybridDynamics(
            task,
            prior=None if self.prior is None else priors[self.prior](task.system),
            residual=None if self.residual is None else self.residual.build(task),
            integrator=self.integrator,
        )


@dataclass(frozen=True)
class Blueprint:
    """An :class:`~phihp_torchrl.deployment.Agent`; absent parts are ``None``.

    Args:
        task: the task's signature.
        dynamics: the model.
        actor_hidden_sizes: widths of the actor's hidden layers.
        critic_hidden_sizes: widths of each critic's hidden layers.
        planner: the planner's settings.
    """

    task: TaskSignature
    dynamics: DynamicsBlueprint | None
    actor_hidden_sizes: tuple[int, ...] | None
    critic_hidden_sizes: tuple[int, ...] | None
    planner: PlannerConfig | None

    def __post_init__(self) -> None:
        for name in ("actor_hidden_sizes", "critic_hidden_sizes"):
            if getattr(self, name) is not None:
                check_sizes(name, getattr(self, name))

    @classmethod
    def of(cls, agent: Agent) -> Blueprint:
        """The blueprint of an agent; ``ValueError`` if some part is none of ours."""
        parts = modules(agent)
        expected = {"dynamics": HybridDynamics, "actor": Actor, "qvalue": TwinQ}
        for name, part in parts.items():
            if type(part) is not expected[name]:
                raise ValueError(
                    f"{name}: expected a module of class {expected[name].__name__}, "
                    f"got {type(part).__name__}."
                )
        dynamics, actor, qvalue = (parts.get(name) for name in expected)
        critic_sizes = None
        if qvalue is not None:
            critic_sizes = tuple(weight.shape[1] for weight in list(qvalue.layers)[:-2:2])
        return cls(
            task=TaskSignature.of(agent.task),
            dynamics=None if dynamics is None else DynamicsBlueprint.of(dynamics),
            actor_hidden_sizes=None if actor is None else hidden_sizes(actor.mlp),
            critic_hidden_sizes=critic_sizes,
            planner=agent.planner_config,
        )

    def assemble(self, task: Task, parts: Mapping[str, Any], **options: Any) -> Agent:
        """The agent of these parts; ``options`` go to :class:`~phihp_torchrl.deployment.Agent`."""
        return Agent(task, **parts, planner_config=self.planner, **options)

    def build_modules(self, task: Task) -> dict[str, Any]:
        """New modules by name, untrained."""
        parts: dict[str, Any] = {}
        if self.dynamics is not None:
            parts["dynamics"] = self.dynamics.build(task)
        if self.actor_hidden_sizes is not None:
            parts["actor"] = Actor(task, self.actor_hidden_sizes)
        if self.critic_hidden_sizes is not None:
            parts["qvalue"] = TwinQ(task, self.critic_hidden_sizes)
        return parts


def modules(agent: Agent) -> dict[str, Any]:
    """The modules of an agent that carry weights, by name, out of their TensorDict shells."""
    parts = {
        "dynamics": agent.dynamics,
        "actor": getattr(agent.actor, "module", agent.actor),
        "qvalue": getattr(agent.qvalue, "module", agent.qvalue),
    }
    return {name: part for name, part in parts.items() if part is not None}


def hidden_sizes(mlp: nn.Module) -> tuple[int, ...]:
    """Widths of an MLP's hidden layers."""
    linear = [layer for layer in mlp.modules() if isinstance(layer, nn.Linear)]
    return tuple(layer.out_features for layer in linear[:-1])


def _integrator_name(integrator: Integrator) -> str:
    for name in _INTEGRATORS:
        known = make_integrator(name)
        if type(known) is type(integrator) and vars(known) == vars(integrator):
            return name
    raise ValueError(
        f"dynamics.integrator: expected one of {list(_INTEGRATORS)} with its default tolerances, "
        f"got {type(integrator).__name__} with {vars(integrator)}."
    )


def check_sizes(name: str, sizes: Sequence[Any]) -> None:
    """Refuse widths that no network of ours has, before memory is taken for it."""
    fits = len(sizes) <= _MAX_LAYERS and all(
        isinstance(size, int) and not isinstance(size, bool) and 1 <= size <= _MAX_WIDTH
        for size in sizes
    )
    if not fits:
        raise ValueError(
            f"{name}: expected at most {_MAX_LAYERS} widths of 1 to {_MAX_WIDTH}, got {sizes!r}."
        )
