"""Phase 1: collect, fit, plan and collect (paper, section 4.1 and appendix C)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import (
    AUTO,
    SOLVERS,
    DynamicsLoss,
    FitConfig,
    FitReport,
    HybridDynamics,
    constants_covariance,
    fit,
    split,
)
from phihp_torchrl.imagination import Batch
from phihp_torchrl.tasks import Actuator, Task
from phihp_torchrl.trainers.collect import planning_policy, random_policy
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.exploration import Exploration
from phihp_torchrl.trainers.lateness import Lateness
from phihp_torchrl.trainers.model_config import ModelConfig, make_dynamics
from phihp_torchrl.trainers.model_doubts import Doubts
from phihp_torchrl.trainers.model_fit import (
    chooses_solver,
    fit_again,
    fit_choosing,
    measures,
    solver_number,
)
from phihp_torchrl.trainers.phases import Phase, register_phase
from phihp_torchrl.trainers.real_data import RealData, Taken, collected_return, replay_batch
from phihp_torchrl.worlds import make_world


class ModelTrainer:
    """Phase 1: learns the model from real steps (paper, section 4.1 and appendix C).

    It alternates between collecting real steps, at random in the first iteration and by planning
    in later ones, and fitting the model. In a world that has recordings alone, it fits the model
    once, to all their transitions.

    Steps of which a number is missing are left out, with a warning. A run saves new steps before it
    fits the model to them, so that a fit that fails costs no step; nor does an environment that
    fails in the middle of an iteration, whose other steps are taken when the run is resumed.

    Where the task has no actuator and previous commands explain what the first or the last fit
    leaves over, a dead time and a lag are chosen by held-out error. :attr:`task` and :attr:`world`
    then have them, and later phases of a run go on with these.

    Args:
        task: the task.
        config: settings of phase 1.
        seed: seed of all random numbers of this phase.
        world: the real world, in any form that :func:`~phihp_torchrl.make_world` accepts. Defaults
            to the simulated world of the task.

    Raises:
        ConfigError: for a world that does not fit the task, and for an oracle in a world that is
            not simulated.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> config = ModelConfig(real_steps=100, steps_per_iteration=50, fit=FitConfig(steps=5))
        >>> trainer = ModelTrainer(get_task("pendulum"), config, seed=0)
        >>> while not trainer.done:
        ...     metrics = trainer.advance()
        >>> trainer.real_steps
        100
    """

    def __init__(
        self, task: Task, config: ModelConfig, *, seed: int, world: Any = "simulated"
    ) -> None:
        self.task = task
        self.config = config
        self.world = make_world(task, world)
        self.exploration = Exploration(task, config.collect.exploration)
        self.source = RealData(task, self.world, config.collect.exploration.guards)
        self.crossings = self.source.crossings
        self.lateness = Lateness(task, self.world, config.actuator, config.fit)
        self.generator = torch.Generator().manual_seed(seed)
        self.dynamics = make_dynamics(self.world, config, self.generator)
        self.initial = {k: v.clone() for k, v in self.dynamics.state_dict().items()}
        self.loss = DynamicsLoss(self.dynamics, lambda_0=config.lambda_0, tau_ph=config.tau_ph)
        self.data: TensorDict | None = None
        self.iteration = 0
        self.keep: Callable[[], None] | None = None
        """What saves the run; it is called when there are new real steps."""
        # Steps not yet fitted, those left out, and those that a failure has kept from being taken.
        self._new, self._dropped, self._missing = 0, 0, 0
        self._others: list[dict[str, Tensor]] = []  # parameters that fit the data about as well
        self._doubts = Doubts()
        self._found: Actuator | None = None
        seed_of_env = self._draw_seed()
        if self.env is not None:
            self.env.set_seed(seed_of_env)

    @property
    def env(self) -> EnvBase | None:
        """The environment in which steps are taken; ``None`` in a world of recordings alone."""
        return self.source.env

    @property
    def real_steps(self) -> int:
        """Real steps so far, with those that were left out."""
        return self._dropped + (0 if self.data is None else len(self.data))

    @property
    def progress(self) -> tuple[int, int]:
        """Real steps so far and in all."""
        recorded = self.source.recorded
        total = self.config.real_steps if recorded is None else len(recorded)
        return self.real_steps, total

    @property
    def done(self) -> bool:
        """Whether all real transitions are collected and fitted."""
        return self._has_all and not self._new

    @property
    def _has_all(self) -> bool:
        steps, total = self.progress
        return steps >= total

    def states(self) -> Tensor:
        """Return all states of the real data, ``[N, n]``."""
        return self.transitions().state

    def transitions(self) -> Batch:
        """Return all real transitions, ``[N]``, as replay keeps them: with rewards less prices."""
        return replay_batch(self.task, self.data)

    def trained(self) -> dict[str, Tensor]:
        """The parameters of the model, by name."""
        return dict(self.dynamics.named_parameters())

    def constants_covariance(self) -> Tensor:
        """Covariance of the prior's learned constants after the last fit, ``[learned, learned]``.

        Raises:
            ConfigError: before the first fit, and as
                :func:`~phihp_torchrl.dynamics.constants_covariance`.
        """
        if self.data is None:
            raise ConfigError("real_steps", "expected real steps that were fitted, got none.")
        train, held_out, _ = split(self.data)
        return constants_covariance(self.loss, train, held_out)

    def parts(self) -> dict[str, Any]:
        """Return the model, as an argument of :class:`~phihp_torchrl.Agent`."""
        return {"dynamics": self.dynamics}

    def others(self) -> list[HybridDynamics]:
        """Other models that describe the real data about as well, as far as restarts found any."""
        found = []
        for parameters in self._others:
            other = copy.deepcopy(self.dynamics)
            other.load_state_dict(parameters)
            found.append(other)
        return found

    def advance(self) -> dict[str, float]:
        """Collect once and fit once; returns metrics."""
        if self._missing or not self._new:  # else a fit has failed, and is tried again
            self._take()
        assert self.data is not None
        if self.world.truth is None:
            self._doubts.of_task(self.task, self.data, self.real_steps, last=self._has_all)
        reward = self.data["next", "reward"][-self._new :].mean()
        metrics = {"real_steps": self.real_steps, "collect/reward": reward}
        if self.source.recorded is None:
            metrics["collect/return"] = collected_return(self.task, self.data[-self._new :])
        if self.config.collect.exploration.guards:
            metrics["collect/guard_crossings"] = self.crossings.total()
        if self._dropped:
            metrics["collect/dropped"] = self._dropped
        if self.config.kind != "oracle":
            metrics |= self.fit()
        self._new = 0
        return {name: float(value) for name, value in metrics.items()}

    def _take(self) -> None:
        """Take the real steps of an iteration, and keep them before anything else is done.

        Raises:
            ConfigError: as :meth:`collect`, when the steps that were taken are kept.
        """
        failure, new = None, self.source.recorded
        if new is None:
            left = self.config.real_steps - self.real_steps
            taken = self._collect(min(self._missing or self.config.period, left))
            new, self._missing, failure = taken.data, taken.missing, taken.failure
        self.data = new if self.data is None else torch.cat([self.data, new])
        self._new += len(new)
        if not self._missing:
            self.iteration += 1
        if self.keep is not None:
            self.keep()
        if failure is not None:
            raise failure

    def collect(self, steps: int) -> TensorDict:
        """Take real steps: at random in the first iteration, with the planner in later ones.

        Raises:
            ConfigError: for a world of recordings, if too many steps miss a number, and if the
                environment fails.
        """
        taken = self._collect(steps)
        if taken.failure is not None:
            raise taken.failure
        return taken.data

    def _collect(self, steps: int) -> Taken:
        if self.env is None:
            raise ConfigError("world", f"{self.world} has recordings alone, nobody can act in it.")
        config, generator = self.config, self.generator
        if self.iteration == 0:
            policy = random_policy(self.task, config.collect, generator, self.exploration)
        else:
            fade = max(0.0, 1.0 - (self.iteration - 1) / max(1, config.iterations - 2))
            noise = fade * config.collect.noise
            policy = planning_policy(
                self.task, self.dynamics, config.collect, generator, noise, self.exploration
            )
        # Each iteration has its seed, so that a resumed run has the same resets.
        seed, counts = self._draw_seed(), self.lateness.open
        taken = self.source.take(steps, policy, seed, counts=counts)
        self._dropped += taken.dropped
        return taken

    def fit(self) -> dict[str, Tensor | float]:
        """Fit the model to all data and measure it."""
        config = self.config.fit
        if not self.config.warm_start:
            self._begin_again()
        elif self.iteration > 1 and not self._has_all:
            config = self.config.refit
        assert self.data is not None
        train, held_out, blocks = split(self.data)
        report = self._fit(train, held_out, config)
        if self._finds_actuator(report):
            train, held_out, blocks = split(self.data)
            report = self._fit(train, held_out, self.config.fit)
        if self._has_all:
            report, self._others = fit_again(
                self.loss, report, self.initial, train, held_out, self.config, self.generator
            )
        if config.method != "multiple_shooting" and report.held_out_error > 1e-4:
            self._doubts.of_noise(self.loss, train)
        return measures(self.loss, report, train, blocks)

    def _finds_actuator(self, report: FitReport) -> bool:
        """Whether a fit shows that commands act late, and how; their path is then the task's."""
        assert self.data is not None
        if not self.lateness.suspected(self.loss, self.data, report.held_out_error):
            return False
        found = self.lateness.find(self.loss, self.data, self.generator, self._begin_again)
        if found is None:
            return False
        self._dropped += len(self.data) - len(found.data)
        self.data = found.data
        self._take_actuator(found.actuator)
        return True

    def _begin_again(self) -> None:
        self.dynamics.load_state_dict(self.initial)
        self.loss.lambda_.fill_(self.config.lambda_0)

    def _take_actuator(self, actuator: Actuator) -> None:
        """Go on with a task that has an actuator, in a world that shows what is under way."""
        self.lateness.open, self._found = False, actuator
        self.task = task = replace(self.task, actuator=actuator)
        self.world = copy.copy(self.world)  # not the user's own
        self.world.task = self.dynamics.task = self.exploration.task = task
        self.source.use(task, self.world)

    def _fit(self, train: TensorDict, held_out: TensorDict, config: FitConfig) -> FitReport:
        """Fit; the first and the last time choose the integrator too, if the settings say so."""
        first_or_last = self.iteration == 1 or self._has_all
        fits = fit_choosing if first_or_last and chooses_solver(self.config) else fit
        return fits(self.loss, train, held_out, config, self.generator)

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a resumed run needs, as tensors and numbers."""
        return {
            "dynamics": self.dynamics.state_dict(),
            "initial": self.initial,
            "loss": {name: buffer for name, buffer in self.loss.named_buffers(recurse=False)},
            "others": list(self._others),
            "data": None if self.data is None else self.data.to_dict(),
            "solver": solver_number(self.loss) if self.config.integrator == AUTO else None,
            "actuator": None if self._found is None else self._found.config,
            "iteration": self.iteration,
            "new": self._new,
            "dropped": self._dropped,
            "missing": self._missing,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        if (actuator := state.get("actuator")) is not None:
            self._take_actuator(Actuator(**actuator))
        self.dynamics.load_state_dict(state["dynamics"])
        self.initial = dict(state["initial"])
        for name, value in state["loss"].items():
            self.loss.get_buffer(name).copy_(value)
        self._others = [dict(parameters) for parameters in state.get("others", ())]
        data = state["data"]
        self.data = None if data is None else TensorDict(data).auto_batch_size_(1)
        self.lateness.open &= data is None or "step_count" in data
        self.iteration = state["iteration"]
        if (solver := state.get("solver")) is not None:
            self.dynamics.integrator = SOLVERS[solver]
        self._new, self._dropped = state.get("new", 0), state.get("dropped", 0)
        self._missing = state.get("missing", 0)
        self.generator.set_state(state["generator"])

    def _draw_seed(self) -> int:
        return int(torch.randint(2**31, (), generator=self.generator))


def _build(context: Context) -> Phase:
    config = context.settings
    return ModelTrainer(context.task, config, seed=context.config.seed, world=context.world)


register_phase("model", ModelConfig, _build, unit="steps")
