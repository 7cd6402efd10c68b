"""The configuration of a run, from the command line to typed dataclasses."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf

from phihp_torchrl.evaluation.seeds import check_training_seed
from phihp_torchrl.planners.factory import PlannerConfig
from phihp_torchrl.ranges import check_count, check_not_negative
from phihp_torchrl.tasks import get_task
from phihp_torchrl.trainers.config import ConfigError, from_mapping
from phihp_torchrl.trainers.loggers import LoggerConfig
from phihp_torchrl.trainers.methods import Method, get_method
from phihp_torchrl.trainers.model import ModelConfig
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.td3 import RealTD3Config
from phihp_torchrl.trainers.tdmpc import TDMPCTrainConfig

SECTIONS = ("model", "policy", "td3", "tdmpc", "planner")
"""The sections of a configuration that a method may have no use for."""

FREE_KEYS = ("checkpoint_interval", "keep_checkpoints", "progress", "logger")
"""What a resumed run may change, for it changes no result."""

_NAMES = ("task", "preset", "method")
_GROUPS = (*_NAMES, "logger", "budget")
_PLACES = ("run_dir", "resume")


@dataclass(frozen=True)
class EvaluateConfig:
    """The last phase: how the trained agent is judged and shown.

    Args:
        episodes: real episodes, from seeds that no training ever uses.
        latency_actions: actions whose time is measured, one at a time; 0 for none.
        video: whether to write a GIF of an episode.
    """

    episodes: int = 50
    latency_actions: int = 200
    video: bool = True

    def __post_init__(self) -> None:
        check_count(self, "episodes")
        check_not_negative(self, "latency_actions")


@dataclass(frozen=True)
class RunConfig:
    """All that decides what a run does; ``recipes/config/base.yaml`` mirrors it.

    Sections that the method has no use for become ``None``.

    Args:
        task: name of a registered task.
        method: name of the method (:data:`~phihp_torchrl.trainers.methods.METHODS`).
        preset: name of the set of hyper-parameters, for the record.
        seed: of everything random.
        phases: those to do, consecutive ones of the method's; ``None`` becomes all of them.
        start_from: directory of a run that has done the phases before (``from`` in YAML).
        plugins: Python files or modules to import, which register tasks.
        checkpoint_interval: seconds between two checkpoints; 0 for one after every unit of work.
        keep_checkpoints: how many of them stay.
        threads: intra-op threads.
        compile: whether to compile the hot loops.
        progress: whether to show progress bars, on a terminal.
        model: the phase that learns a model from real steps.
        policy: the phase that learns actor and critics in imagination.
        td3: the phase that learns actor and critics from real steps.
        tdmpc: the phase that learns all of TD-MPC from real steps.
        planner: how the agent plans.
        evaluate: the phase that judges the agent.
        logger: where metrics go besides ``metrics.csv``.
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
    compile: bool = False
    progress: bool = True
    model: ModelConfig | None = field(default_factory=ModelConfig)
    policy: PolicyConfig | None = field(default_factory=PolicyConfig)
    td3: RealTD3Config | None = field(default_factory=RealTD3Config)
    tdmpc: TDMPCTrainConfig | None = field(default_factory=TDMPCTrainConfig)
    planner: PlannerConfig | None = field(default_factory=PlannerConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    logger: LoggerConfig = field(default_factory=LoggerConfig)

    def __post_init__(self) -> None:
        check_training_seed(self.seed)
        check_count(self, "keep_checkpoints", "threads")
        if not self.checkpoint_interval >= 0:
            raise ValueError(
                f"checkpoint_interval: expected seconds >= 0, got {self.checkpoint_interval}."
            )
        method = get_method(self.method)
        self._check_sections(method)
        if self.phases is None:
            object.__setattr__(self, "phases", method.phases)
        self._check_phases(method.phases)

    @property
    def label(self) -> str:
        """What tells this run from others of its task."""
        method = "" if self.method == "phihp" else f"{self.method}-"
        return f"{method}{self.preset}-seed{self.seed}"

    @property
    def phases_before(self) -> tuple[str, ...]:
        """The method's phases that another run has done."""
        phases = get_method(self.method).phases
        return phases[: phases.index(self.phases_to_do[0])]

    @property
    def phases_to_do(self) -> tuple[str, ...]:
        """The phases that are this run's own."""
        return self.phases or get_method(self.method).phases

    def _check_sections(self, method: Method) -> None:
        for name in SECTIONS:
            if name not in method.sections:
                object.__setattr__(self, name, None)
            elif getattr(self, name) is None:
                raise ValueError(f"{name}: expected settings for method {self.method!r}, got none.")
        kind = self.model and self.model.kind
        if method.model_kind not in (None, kind):
            raise ValueError(
                f"model.kind: expected {method.model_kind!r} for method {self.method!r}, "
                f"got {kind!r}."
            )
        if method.acting == "plain_planner" and self.planner.num_policy_candidates:  # type: ignore[union-attr]
            raise ValueError(
                f"planner.num_policy_candidates: expected 0 for method {self.method!r}, which "
                f"learns no actor, got {self.planner.num_policy_candidates}."  # type: ignore[union-attr]
            )

    def _check_phases(self, known: tuple[str, ...]) -> None:
        ours = self.phases or ()
        first = known.index(ours[0]) if ours and ours[0] in known else 0
        if not ours or tuple(ours) != known[first : first + len(ours)]:
            raise ValueError(
                f"phases: expected consecutive ones of {list(known)}, those of method "
                f"{self.method!r}, got {list(ours)}."
            )
        if first > 0 and self.start_from is None:
            raise ValueError(
                f"from: expected the directory of a run that has done phase {known[first - 1]!r}, "
                f"for phases={list(ours)}."
            )
        if first == 0 and self.start_from is not None:
            raise ValueError("from: expected none, for phases begin with the first one.")


@dataclass(frozen=True)
class RunRequest:
    """What a command line asks for.

    Args:
        config: the run.
        path: its directory; ``None`` for a new one.
        resume: whether to go on with the run there.
    """

    config: RunConfig
    path: str | None
    resume: bool


def read_request(composed: DictConfig, overrides: Sequence[str]) -> RunRequest:
    """Turn what Hydra composed into a typed request, and import its plugins.

    A task's YAML has a section for each preset, and a method's one of what it changes. The task's
    goes over the preset, the method's over the task's, and the command line over all of them; so
    the command line is applied once more. Sections that the method has no use for are left out.

    Args:
        composed: the composed configuration.
        overrides: the command line, as ``HydraConfig.get().overrides.task`` has it.

    Raises:
        ConfigError: for the first key that is unknown or has a wrong value, by its dotted name.
    """
    lines = [
        o for o in OverridesParser.create().parse_overrides(list(overrides)) if not o.is_delete()
    ]
    config: Any = OmegaConf.create(OmegaConf.to_container(composed, resolve=True))
    places = {key: config.pop(key, None) for key in _PLACES}
    for key, value in places.items():
        if value is not None and not isinstance(value, str):
            raise ConfigError(f"{key}: expected a directory, got {value!r}.")
    presets, changes = config.pop("presets", None) or {}, config.pop("changes", None) or {}
    if places["resume"] is None:
        preset = presets.get(config.get("preset")) or {}
        for name, section in (("presets.<preset>", preset), ("changes", changes)):
            _check_section(section, config, name)
            config = OmegaConf.merge(config, section)
    else:
        if places["run_dir"] is not None:
            raise ConfigError("run_dir: expected none with resume, which names the directory.")
        config, given = OmegaConf.create(RunDirectory(places["resume"]).read_config()), config
        if any(_key(line) == "logger" for line in lines):
            config.logger = given.logger
    for line in lines:
        if _key(line) in _NAMES:
            config[_key(line)] = str(line.value())
        elif _key(line) not in (*_GROUPS, *_PLACES):
            OmegaConf.update(config, _key(line), line.value(), force_add=True)
    plain: Any = OmegaConf.to_container(config, resolve=True)
    import_plugins(plain.get("plugins") or ())
    _leave_out(plain, [_key(line) for line in lines])
    typed = from_mapping(RunConfig, plain)
    check_task(typed)
    path = places["resume"] or places["run_dir"]
    return RunRequest(typed, path, resume=places["resume"] is not None)


def import_plugins(plugins: Sequence[str]) -> None:
    """Import Python files (``path/to/my_task.py``) or modules (``my_package.tasks``), each once.

    Raises:
        ConfigError: for one that is absent or fails, named in the message.
    """
    for name in plugins:
        if not isinstance(name, str):
            raise ConfigError(f"plugins: expected files or modules, got {name!r}.")
        try:
            if name.endswith(".py"):
                _import_file(Path(name))
            else:
                importlib.import_module(name)
        # A user's file may fail in any way; he should read which one, and why.
        except Exception as error:
            raise ConfigError(
                f"plugins: {name} cannot be imported: {type(error).__name__}: {error}"
            ) from error


def _import_file(path: Path) -> None:
    path = path.resolve()
    module_name = f"phihp_torchrl_plugin_{path.stem}"
    if getattr(sys.modules.get(module_name), "__file__", None) == str(path):
        return
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise ImportError("not a Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules[module_name] = module


def _key(line: Override) -> str:
    return str(line.key_or_group)


def check_task(config: RunConfig) -> None:
    """Refuse a task that is not registered, and one without prior where the method needs it.

    Raises:
        ConfigError: naming the key.
    """
    try:
        task = get_task(config.task)
    except ValueError as error:
        raise ConfigError(f"{error} A plugin may register more: plugins=[my_task.py].") from error
    kind = None if config.model is None else config.model.kind
    if kind in ("hybrid", "prior") and not task.system.has_prior:
        raise ConfigError(
            f"model.kind: method {config.method!r} with a model of kind {kind!r} needs a prior, "
            f"and the system of task {task.name!r}, {type(task.system).__name__}, has none; "
            "expected 'data_driven' or a method that needs none."
        )


def _leave_out(plain: dict[str, Any], given: Sequence[str]) -> None:
    """Take the sections out that the method has no use for, unless the command line sets them."""
    name = plain.get("method", "phihp")
    try:
        used = get_method(name).sections
    except ValueError as error:
        raise ConfigError(str(error)) from error
    for section in SECTIONS:
        if section in used:
            continue
        plain.pop(section, None)
        if keys := [key for key in given if key.split(".")[0] == section]:
            raise ConfigError(
                f"{keys[0]}: method {name!r} has no use for {section!r}; "
                f"its sections are {list(used)}."
            )


def _check_section(section: Mapping[str, Any], config: Mapping[str, Any], path: str) -> None:
    """A task's or a method's section may only set what the preset has."""
    for key, value in section.items():
        name = f"{path}.{key}"
        if key not in config:
            raise ConfigError(f"{name}: unknown key; expected one of {sorted(config)}.")
        if isinstance(value, Mapping) and isinstance(config[key], Mapping):
            _check_section(value, config[key], name)
