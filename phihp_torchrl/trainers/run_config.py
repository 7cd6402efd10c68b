"""The settings of a run as a dataclass, and the task that they name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from phihp_torchrl.config import (
    ConfigError,
    Method,
    check_count,
    check_fields,
    check_not_negative,
    get_method,
    to_mapping,
)
from phihp_torchrl.evaluation import check_training_seed
from phihp_torchrl.planners import PLANNERS, CEMConfig, SearchConfig
from phihp_torchrl.tasks import Task, find_task
from phihp_torchrl.trainers.loggers import LoggerConfig
from phihp_torchrl.trainers.phases import PHASES, unknown_phases
from phihp_torchrl.worlds import WORLDS, SimulatedConfig

FREE_KEYS = ("checkpoint_interval", "keep_checkpoints", "progress", "logger")
"""Settings that a resumed run may change, because they do not affect its results."""


_MOST_THREADS = 1024


@dataclass(frozen=True)
class RunConfig:
    """The settings of a run, which ``config/settings/defaults.yaml`` mirrors.

    The settings of the phases are in :attr:`sections`; in YAML each of these sections is at the top
    level, under the name of its phase. Sections that the method does not use are dropped, and
    missing ones have their defaults.

    Args:
        task: name of a registered task.
        method: name of the method (phihp list prints them).
        preset: name of the set of hyper-parameters; only recorded here.
        seed: seed of all random numbers.
        phases: the phases to run, consecutive ones of the method; null for all of them. Those with
            a switch (enabled) need not be named between others.
        start_from: directory of a run that has done the earlier phases; needed if phases does not
            begin with the first one.
        plugins: Python files or modules to import, which register tasks, worlds and so on.
        checkpoint_interval: seconds between two checkpoints; 0 for one after every unit of work.
        keep_checkpoints: number of checkpoints that are kept; if the last one is damaged, the one
            before is used.
        threads: intra-op threads of torch; more than one is slower on these small networks.
        compile: whether to compile TD3, imagination and the agent's plans (minutes the first time,
            seconds later); auto for a phase that is long enough to earn it.
        progress: whether to say at least every ten seconds where the run is.
        actuator: numbers of the task's actuator that differ, by name: delay_steps, lag, slew,
            dead_zone, gain_low.
        action_rate_limit: largest rate of each action in its units per second, one number or one
            for each; null for the task's own.
        action_rate_cost: price of a change of the action, squared and in half-ranges, where the
            task is imagined; null for the task's own, 0 for none.
        constraints: limits of states that are kept softly at a price, or hard as the end of an
            episode, by name of the state: low, high, price, hard; null for a name drops the task's
            own.
        world: the real world.
        planner: how the agent plans.
        logger: where metrics are logged, besides metrics.csv.
        sections: settings of the phases, by name.

    Raises:
        ConfigError: for a value out of range, and for settings that do not fit the method; the
            message names the field.

    Examples:
        >>> from phihp_torchrl import load_config
        >>> from phihp_torchrl.trainers import read_run_config
        >>> config = read_run_config(load_config("pendulum", overrides=["policy.updates=100"]))
        >>> config.section("policy").updates, config.phases
        (100, ('model', 'policy', 'calibrate', 'evaluate'))
    """

    task: str
    method: str = "phihp"
    preset: str = "default"
    seed: int = 0
    phases: tuple[str, ...] | None = None
    start_from: str | None = field(default=None, metadata={"key": "from"})
    plugins: tuple[str, ...] = ()
    checkpoint_interval: float = 60.0
    keep_checkpoints: int = 2
    threads: int = 1
    compile: bool | Literal["auto"] = "auto"
    progress: bool = True
    actuator: Mapping[str, Any] = field(default_factory=dict, hash=False)
    action_rate_limit: float | tuple[float, ...] | None = None
    action_rate_cost: float | None = None
    constraints: Mapping[str, Any] = field(default_factory=dict, hash=False)
    world: Any = field(default_factory=SimulatedConfig, metadata={"kinds": WORLDS})
    planner: SearchConfig | None = field(default_factory=CEMConfig, metadata={"kinds": PLANNERS})
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    sections: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        check_fields(self)
        check_training_seed(self.seed)
        check_count(self, "keep_checkpoints", "threads")
        check_not_negative(self, "checkpoint_interval")
        if self.threads > _MOST_THREADS:
            raise ConfigError("threads", f"expected at most {_MOST_THREADS}, got {self.threads}.")
        if getattr(self.world, "kind", None) not in WORLDS:
            raise ConfigError("world", f"expected settings of a world, got {self.world!r}.")
        method = get_method(self.method)
        if unknown := unknown_phases(method.phases):
            raise ConfigError(
                "method", f"expected phases among {sorted(PHASES)}, {self.method!r} has {unknown}."
            )
        sections = {name: self.sections.get(name, PHASES[name].config()) for name in method.phases}
        for name, section in sections.items():
            if not isinstance(section, PHASES[name].config):
                kind = PHASES[name].config.__name__
                raise ConfigError(name, f"expected a {kind}, got {section!r}.")
        object.__setattr__(self, "sections", sections)
        self._check_planner(method)
        self._check_model_kind(method)
        if self.phases is None or tuple(self.phases) == method.phases:
            object.__setattr__(self, "phases", self.all_phases)
        object.__setattr__(self, "phases", self._checked_phases())

    def section(self, name: str) -> Any:
        """Return the settings of the phase ``name``.

        Raises:
            ConfigError: for a phase that the method does not have.
        """
        if name not in self.sections:
            raise ConfigError(name, f"expected one of {list(self.sections)}.")
        return self.sections[name]

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values by key, as in YAML; :func:`read_run_config` reads them again."""
        plain = to_mapping(self)
        sections = plain.pop("sections")
        return {**plain, **sections}

    @property
    def label(self) -> str:
        """Method, preset and seed, for the name of the run's directory."""
        method = "" if self.method == "phihp" else f"{self.method}-"
        return f"{method}{self.preset}-seed{self.seed}"

    @property
    def all_phases(self) -> tuple[str, ...]:
        """The phases of the method, without those whose settings say ``enabled: false``."""
        names = get_method(self.method).phases
        return tuple(name for name in names if is_enabled(self.sections[name]))

    @property
    def phases_before(self) -> tuple[str, ...]:
        """The phases of :attr:`all_phases` that come before those of this run."""
        return self.all_phases[: self.all_phases.index(self.phases_to_do[0])]

    @property
    def phases_to_do(self) -> tuple[str, ...]:
        """The phases of this run."""
        return self.phases or self.all_phases

    def _check_planner(self, method: Method) -> None:
        if not method.plans:
            object.__setattr__(self, "planner", None)
            return
        if self.planner is None:
            raise ConfigError("planner", f"expected settings for method {self.method!r}, got none.")
        if method.acting == "plain_planner" and self.planner.num_policy_candidates:
            raise ConfigError(
                "planner.num_policy_candidates",
                f"expected 0 for method {self.method!r}, which learns no actor, "
                f"got {self.planner.num_policy_candidates}.",
            )

    def _check_model_kind(self, method: Method) -> None:
        kind = getattr(self.sections.get("model"), "kind", None)
        if method.model_kind not in (None, kind):
            raise ConfigError(
                "model.kind",
                f"expected {method.model_kind!r} for method {self.method!r}, got {kind!r}.",
            )

    def _checked_phases(self) -> tuple[str, ...]:
        """The phases of this run, with those between them that are switched on."""
        ours, known = tuple(self.phases or ()), self.all_phases
        for name in ours:
            if name in self.sections and name not in known:
                raise ConfigError(
                    f"{name}.enabled", f"expected true, for phases={list(ours)}; got false."
                )
        inside = bool(ours) and {ours[0], ours[-1]} <= set(known)
        first = known.index(ours[0]) if inside else 0
        stretch = known[first : known.index(ours[-1]) + 1] if inside else ()
        optional = [name for name in stretch if hasattr(self.sections[name], "enabled")]
        if not ours or ours != tuple(n for n in stretch if n in ours or n not in optional):
            raise ConfigError(
                "phases",
                f"expected consecutive ones of {list(known)}, those of method {self.method!r}, "
                f"got {list(ours)}.",
            )
        if first > 0 and self.start_from is None:
            raise ConfigError(
                "from",
                f"expected the directory of a run that has done phase {known[first - 1]!r}, "
                f"for phases={list(ours)}.",
            )
        if first == 0 and self.start_from is not None:
            raise ConfigError("from", "expected none, for phases begin with the first one.")
        return stretch


def is_enabled(section: Any) -> bool:
    """Whether a run with these settings of a phase has it; an optional one has ``enabled``."""
    return getattr(section, "enabled", True)


def task_of(config: RunConfig, task: Task | None = None) -> Task:
    """Return the task of a run, with the actuator, the rates and the constraints of its settings.

    Args:
        config: settings of the run.
        task: the task, if it is not the registered one of that name.

    Raises:
        ConfigError: for a task that is not registered, and for numbers that do not fit it.

    Examples:
        >>> from phihp_torchrl import load_config
        >>> from phihp_torchrl.trainers import read_run_config
        >>> settings = load_config("pendulum", overrides=["actuator.delay_steps=2"])
        >>> task_of(read_run_config(settings)).state_dim  # two commands wait
        4
    """
    try:
        task = task or find_task(config.task)
    except ConfigError as error:
        raise ConfigError(
            error.key, f"{error.reason} A plugin may register more: plugins=[my_task.py]."
        ) from error
    names = ("action_rate_limit", "action_rate_cost")
    rates = {name: value for name in names if (value := getattr(config, name)) is not None}
    task = task.with_actuator(config.actuator).with_constraints(config.constraints)
    return replace(task, **rates) if rates else task
