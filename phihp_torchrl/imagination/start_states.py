"""Start states of imagined episodes, which affect the speed of learning more than all else."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, check_fields, check_not_negative, check_share
from phihp_torchrl.imagination.box_states import BoxStates, StartStates, draw_device
from phihp_torchrl.imagination.growing_states import GrowingStates
from phihp_torchrl.tasks import Task


class TaskStates:
    """Start states of a task whose physical components come from another sampler.

    Behind them stand the registers that the task adds, such as commands under way; references and
    inputs among them are drawn.

    Args:
        task: the task.
        physical: draws the physical components.
        under_way: whether random commands are under way, for states in the middle of an episode;
            otherwise nothing is.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import get_task
        >>> from phihp_torchrl.tasks import Actuator
        >>> task = replace(get_task("pendulum"), actuator=Actuator(delay_steps=2.0))
        >>> TaskStates(task, BoxStates(task.coverage), under_way=True).sample([5]).shape
        torch.Size([5, 4])
    """

    def __init__(self, task: Task, physical: StartStates, *, under_way: bool) -> None:
        self.task = task
        self.physical = physical
        self.under_way = under_way

    def sample(
        self,
        shape: Sequence[int],
        generator: torch.Generator | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        states = self.physical.sample(shape, generator, device)
        if not self.under_way or not self.task.register_count:
            return self.task.at_start(states, generator)
        registers = self.task.random_registers(shape, generator)
        return torch.cat([states, registers.to(states)], -1)


class DataStates:
    """Start states drawn with replacement from the states of real data.

    Args:
        states: states ``[N, n]``; :meth:`update` replaces them when the data grow.

    Raises:
        ValueError: if there are no states, or some are not finite.

    Examples:
        >>> data = DataStates(torch.zeros(1, 2))
        >>> data.update(torch.ones(100, 2))
        >>> data.sample([2, 3]).unique()
        tensor([1.])
    """

    def __init__(self, states: Tensor) -> None:
        self.update(states)

    def update(self, states: Tensor) -> None:
        """Draw from ``states`` ``[N, n]`` from now on."""
        if states.ndim != 2 or not len(states):
            raise ValueError(
                f"states: expected at least one state, [N, n], got shape {list(states.shape)}."
            )
        if not states.isfinite().all():
            raise ValueError("states: expected finite states, got some that are not.")
        self.states = states.detach().to(torch.float32)

    def sample(
        self,
        shape: Sequence[int],
        generator: torch.Generator | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        rows = torch.randint(
            len(self.states), [*shape], generator=generator, device=draw_device(generator)
        )
        return self.states[rows.to(self.states.device)].to(device)


class MixtureStates:
    """Start states drawn from several samplers, one of which is chosen at random for each state.

    Args:
        weights: samplers and their weights; the weights are divided by their sum.

    Raises:
        ConfigError: for a weight that is negative or not finite, or if none is positive.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> task = get_task("cartpole-swingup")
        >>> mixture = MixtureStates({BoxStates(task.reset): 1.0, BoxStates(task.goal): 3.0})
        >>> mixture.sample([64]).shape
        torch.Size([64, 4])
    """

    def __init__(self, weights: Mapping[StartStates, float]) -> None:
        for sampler, weight in weights.items():
            _check_weight(type(sampler).__name__, weight)
        positive = {sampler: weight for sampler, weight in weights.items() if weight > 0}
        if not positive:
            raise ConfigError("weights", f"expected some above 0, got {list(weights.values())}.")
        total = sum(positive.values())
        self.samplers = tuple(positive)
        self.weights = tuple(weight / total for weight in positive.values())

    def grow(self, progress: float) -> None:
        """Tell samplers that change with training how far it is, in [0, 1]."""
        for sampler in self.samplers:
            box = getattr(sampler, "physical", sampler)
            if isinstance(box, GrowingStates):
                box.grow(progress)

    def sample(
        self,
        shape: Sequence[int],
        generator: torch.Generator | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        # Every sampler draws every row: that is cheaper than to group the rows by sampler, and a
        # row then does not depend on the choices of other rows.
        draws = torch.stack([s.sample(shape, generator, device) for s in self.samplers])
        uniform = torch.rand([*shape, 1], generator=generator, device=draw_device(generator))
        edges = torch.tensor(self.weights[:-1], device=uniform.device).cumsum(0)
        choice = torch.bucketize(uniform, edges, right=True).to(draws.device)
        return draws.gather(0, choice.expand(draws.shape[1:]).unsqueeze(0)).squeeze(0)


@dataclass(frozen=True)
class StartConfig:
    """Where imagined episodes start: the shares of five kinds of start states.

    The shares are divided by their sum.

    Args:
        reset: share that starts in the task's reset box, as real episodes do.
        data: share that starts in states of the real data.
        coverage: share that starts anywhere in the task's coverage box.
        goal: share that starts in the box around the task's goal, if it has one.
        rewarding: share that starts in the states of the coverage box that earn most at once, or
            around them.
        growth: share of the updates after which the box around the goal has grown to the coverage
            box; 0 leaves it as it is.

    Raises:
        ConfigError: for a share that is negative or not finite, and for a growth beyond 1.

    Examples:
        >>> StartConfig(goal=-0.5)
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: goal: expected a number >= 0, got -0.5.
    """

    reset: float = 0.2
    data: float = 0.0
    coverage: float = 0.6
    goal: float = 0.2
    rewarding: float = 0.0
    growth: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        check_not_negative(self, "reset", "data", "coverage", "goal", "rewarding")
        check_share(self, "growth")


def make_start_states(
    task: Task,
    shares: StartConfig | None = None,
    states: Tensor | DataStates | None = None,
    rewarding: Tensor | None = None,
) -> MixtureStates:
    """Make the start states of a task by shares; a box that the task lacks gets no share.

    Args:
        task: the task, with its boxes.
        shares: the share of each kind of start states. Defaults to ``StartConfig()``.
        states: states of real data, ``[N, n]``, or a :class:`DataStates` that is updated elsewhere.
        rewarding: states of high reward, ``[N, n]``, as ``rewarding_states`` finds them.

    Raises:
        ConfigError: if no share is positive, and for ``data`` > 0 without ``states``.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> start_states = make_start_states(get_task("pendulum"), StartConfig(reset=0.6))
        >>> start_states.weights  # this task has no goal box
        (0.5, 0.5)
    """
    shares = shares or StartConfig()
    if shares.data > 0 and states is None:
        raise ConfigError(
            "data", f"expected states to draw from with data={shares.data}, got none."
        )
    boxes = {"reset": task.reset, "coverage": task.coverage, "goal": task.goal}
    drawn = {name: BoxStates(box) for name, box in boxes.items() if box is not None}
    if shares.growth and task.goal is not None and task.coverage is not None:
        drawn["goal"] = GrowingStates(task.goal, task.coverage, shares.growth)
    samplers: dict[str, StartStates] = {
        name: TaskStates(task, box, under_way=name != "reset") for name, box in drawn.items()
    }
    if states is not None:
        samplers["data"] = states if isinstance(states, DataStates) else DataStates(states)
    if rewarding is not None:
        samplers["rewarding"] = DataStates(rewarding)
    present = {name: getattr(shares, name) for name in samplers}
    if not any(present.values()):
        raise ConfigError(
            "start",
            f"expected a share above 0 for one of {sorted(present)}, which is all that task "
            f"{task.name!r} has; got {shares}.",
        )
    return MixtureStates({samplers[name]: share for name, share in present.items()})


def _check_weight(name: str, weight: float) -> None:
    if not (math.isfinite(weight) and weight >= 0):
        raise ConfigError(name, f"expected a finite weight of at least 0, got {weight}.")
