"""The settings of a run as dataclasses, and their reading from YAML and command lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from phihp_torchrl.config import (
    METHODS,
    PLACES,
    ConfigError,
    Method,
    apply_overrides,
    check_count,
    check_not_negative,
    finish,
    from_mapping,
    get_method,
    override_key,
    parse_overrides,
    resolve_seconds,
    to_mapping,
)
from phihp_torchrl.evaluation import check_training_seed
from phihp_torchrl.planners import PLANNERS, CEMConfig, SearchConfig
from phihp_torchrl.tasks import Task, find_task
from phihp_torchrl.trainers.loggers import LoggerConfig
from phihp_torchrl.trainers.phases import PHASES, unknown_phases
from phihp_torchrl.trainers.plugins import import_plugins
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.strategies import strategies_of
from phihp_torchrl.worlds import WORLDS, SimulatedConfig, World

FREE_KEYS = ("checkpoint_interval", "keep_checkpoints", "progress", "logger")
"""Settings that a resumed run may change, because they do not affect its results."""


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
            seconds later).
        progress: whether to show progress bars on a terminal.
        actuator: numbers of the task's actuator that differ, by name: delay_steps, lag, slew,
            dead_zone, gain_low.
        action_rate_limit: largest rate of each action in its units per second, one number or one
            for each; null for the task's own.
        action_rate_cost: price of a change of the action, squared and in half-ranges, where the
            task is imagined; null for the task's own, 0 for none.
        world: the real world.
        planner: how the agent plans.
        logger: where metrics are logged, besides metrics.csv.
        sections: settings of the phases, by name.

    Raises:
        ConfigError: for a value out of range, and for settings that do not fit the method; the
            message names the field.

    Examples:
        >>> from phihp_torchrl import load_config
        >>> config = read_run_config(load_config("pendulum", overrides=["policy.updates=100"]))
        >>> config.section("policy").updates, config.phases
        (100, ('model', 'policy', 'evaluate'))
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
    compile: bool = True
    progress: bool = True
    actuator: Mapping[str, Any] = field(default_factory=dict, hash=False)
    action_rate_limit: float | tuple[float, ...] | None = None
    action_rate_cost: float | None = None
    world: Any = field(default_factory=SimulatedConfig, metadata={"kinds": WORLDS})
    planner: SearchConfig | None = field(default_factory=CEMConfig, metadata={"kinds": PLANNERS})
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    sections: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        check_training_seed(self.seed)
        check_count(self, "keep_checkpoints", "threads")
        check_not_negative(self, "checkpoint_interval")
        method = get_method(self.method)
        if unknown := unknown_phases(method.phases):
            raise ConfigError(
                "method", f"expected phases among {sorted(PHASES)}, {self.method!r} has {unknown}."
            )
        sections = {name: self.sections.get(name, PHASES[name].config()) for name in method.phases}
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


@dataclass(frozen=True)
class RunRequest:
    """The run that a command line describes.

    Args:
        config: settings of the run.
        path: directory of the run; ``None`` for a new one.
        resume: whether to resume the run in that directory.
    """

    config: RunConfig
    path: str | None
    resume: bool


def read_request(composed: Any, overrides: Sequence[str]) -> RunRequest:
    """Read the settings that Hydra composed as a typed request, and import their plugins.

    Args:
        composed: the composed settings.
        overrides: the command line.

    Raises:
        ConfigError: for the first key that is unknown or has a wrong value, by its dotted name.
    """
    keys = [override_key(line) for line in parse_overrides(overrides)]
    settings = finish(composed, overrides)
    places = {key: settings.pop(key, None) for key in PLACES}
    for key, value in places.items():
        if value is not None and not isinstance(value, str):
            raise ConfigError(key, f"expected a directory, got {value!r}.")
    if places["resume"] is not None:
        if places["run_dir"] is not None:
            raise ConfigError("run_dir", "expected none with resume, which names the directory.")
        kept = RunDirectory(places["resume"]).read_config()
        if "logger" in keys:
            kept["logger"] = settings["logger"]
        given = [line for line, key in zip(overrides, keys, strict=False) if key not in PLACES]
        settings = apply_overrides(kept, given)
    config = read_run_config(settings, given=keys)
    path = places["resume"] or places["run_dir"]
    return RunRequest(config, path, resume=places["resume"] is not None)


def read_run_config(settings: Mapping[str, Any], given: Sequence[str] = ()) -> RunConfig:
    """Read plain settings as a :class:`RunConfig`, and import the plugins that they name.

    Args:
        settings: plain values by key, as :func:`~phihp_torchrl.load_config` returns them.
        given: keys that were set explicitly, which the method must use.

    Raises:
        ConfigError: for a key that is unknown or missing, or has a wrong value; the message has its
            dotted name.

    Examples:
        >>> read_run_config({"task": "acrobot", "method": "td3", "td3": {"seed_steps": 5}})
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: td3.seed_steps: unknown key; did you mean 'real_steps'?
    """
    rest = {key: value for key, value in settings.items() if key not in (*PLACES, "presets")}
    import_plugins(rest.get("plugins") or ())
    method_name = rest.get("method", "phihp")
    method = METHODS.find(method_name)
    unknown_phases(method.phases)  # those of the package's own have settings from now on
    used = method.sections
    known = {*PHASES, *(name for each in METHODS.values() for name in each.phases), "planner"}
    sections = {}
    for name in sorted(known & set(rest)):
        if name not in used:
            rest.pop(name)
            if keys := [key for key in given if key.split(".")[0] == name]:
                raise ConfigError(
                    keys[0],
                    f"method {method_name!r} has no use for {name!r}; "
                    f"its sections are {list(used)}.",
                )
        elif name in PHASES:
            sections[name] = from_mapping(PHASES[name].config, rest.pop(name), name)
    if "sections" in rest:
        raise ConfigError("sections", "unknown key; phases are set by their own names.")
    return from_mapping(RunConfig, {**rest, "sections": sections})


def task_of(config: RunConfig, task: Task | None = None) -> Task:
    """Return the task of a run, with the actuator and the rates that its settings give it.

    Args:
        config: settings of the run.
        task: the task, if it is not the registered one of that name.

    Raises:
        ConfigError: for a task that is not registered, and for numbers that do not fit it.

    Examples:
        >>> from phihp_torchrl import load_config
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
    task = task.with_actuator(config.actuator)
    return replace(task, **rates) if rates else task


def check_run(config: RunConfig, world: World) -> None:
    """Refuse settings that the task or the world of a run cannot serve, before any real step.

    Raises:
        ConfigError: if the system has no prior or the world is not simulated, where one is needed,
            for constants to draw where none are learned, and for seconds that are too few for a
            step of the task or do not fit other settings.
    """
    task = world.task
    for name, section in {**config.sections, "planner": config.planner}.items():
        if section is not None:
            try:
                resolve_seconds(section, task.time_step)
            except ConfigError as error:
                raise error.inside(name) from error
    kind = getattr(config.sections.get("model"), "kind", None)
    if kind in ("hybrid", "prior") and not task.system.has_prior:
        raise ConfigError(
            "model.kind",
            f"method {config.method!r} with a model of kind {kind!r} needs a prior, and the system "
            f"of task {task.name!r}, {type(task.system).__name__}, has none; expected "
            "'data_driven' or a method that needs none.",
        )
    if not world.has_env:
        phases = [name for name in config.phases_to_do if PHASES[name].needs_env]
        if phases:
            raise ConfigError(
                "method",
                f"expected one that does without acting in the world, {config.method!r} acts in it "
                f"in {phases}, and {world} has recordings alone.",
            )
    if isinstance(policy := config.sections.get("policy"), PolicyConfig):
        strategies_of(policy)  # refuses unknown ones
    if getattr(config.sections.get("policy"), "draw_constants", False):
        _check_drawing(config, task)
    if world.truth is None:
        phases = [name for name in config.phases_to_do if PHASES[name].needs_truth]
        if phases:
            raise ConfigError(
                "method",
                f"expected one that does without a simulated world, {config.method!r} needs one "
                f"for {phases}, and {world} is none.",
            )
        if kind == "oracle":
            raise ConfigError(
                "model.kind", f"expected another than 'oracle': {world} has no truth to plan with."
            )


def _check_drawing(config: RunConfig, task: Task) -> None:
    """Refuse to draw constants where none are learned, or their fit gives no covariance."""
    model = config.section("model")
    learned = [name for name, c in task.system.ranges.items() if not c.fixed]
    if model.kind not in ("hybrid", "prior") or not learned:
        raise ConfigError(
            "policy.draw_constants",
            f"expected false for a model of kind {model.kind!r} of a system that has "
            f"{len(learned)} constants to learn: there are none to draw.",
        )
    if not model.has_fixed_steps and config.section("policy").constants_std is None:
        raise ConfigError(
            "policy.constants_std",
            f"expected a number with draw_constants=true and model.integrator={model.integrator}, "
            "whose fit has no covariance.",
        )
