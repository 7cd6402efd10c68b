"""What stands beside an exported file: what it takes, for which task, and where it runs."""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from phihp_torchrl.deployment.reading import AgentError, read_json
from phihp_torchrl.deployment.saved_task import describe_task
from phihp_torchrl.origin import package_version

if TYPE_CHECKING:
    from phihp_torchrl.deployment.export_modules import ExportModule

FORMAT = "phihp_torchrl export"
FORMAT_VERSION = 2


@dataclass(frozen=True)
class Manifest:
    """The description of an exported file, kept as JSON beside it.

    Args:
        format: what sort of JSON file this is.
        format_version: 1 has nothing of the task but its signature and its actuator.
        part: ``"plan"`` or ``"actor"``.
        task: signature of the task.
        additions: what else an agent's file says of its task: actuator, rates, constraints, and the
            range and preview of what comes from outside.
        observation: number of components of an observation.
        noise: shape of the noise, or ``None``.
        memory: what is kept from step to step, by the names of its inputs: the values where an
            episode starts, with ``None`` for NaN.
        sha256: digest of the exported file.
        package_version: version of this package that wrote it.
        torch_version: version of torch that wrote it, without its build.
        platform: operating system and processor family.
        processor: instructions of the processor, for machine code that needs them.
    """

    format: str
    format_version: int
    part: str
    task: Mapping[str, Any]
    additions: Mapping[str, Any]
    observation: int
    noise: tuple[int, ...] | None
    memory: Mapping[str, list[Any]]
    sha256: str
    package_version: str
    torch_version: str
    platform: str
    processor: tuple[str, ...]

    @classmethod
    def of(cls, module: ExportModule, path: Path) -> Manifest:
        """Describe the file that was exported from a module here."""
        additions = json.loads(json.dumps(describe_task(module.task)))
        return cls(
            format=FORMAT,
            format_version=FORMAT_VERSION,
            part=module.part,
            task=additions.pop("task"),
            additions=additions,
            observation=module.task.observation_dim,
            noise=module.noise_shape,
            memory={name: _plain(value.tolist()) for name, value in module.memory.items()},
            sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
            package_version=package_version(),
            torch_version=torch_version(),
            platform=platform_name(),
            processor=processor(),
        )

    def write(self, path: Path) -> None:
        """Write it beside the exported file."""
        manifest_path(path).write_text(json.dumps(asdict(self), indent=2) + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> Manifest:
        """Read the description of an exported file.

        Raises:
            AgentError: if it is missing, no such description, or of another version.
        """
        place = manifest_path(path)
        content = read_json(place)
        content.setdefault("memory", {})  # version 0.2.0 kept nothing
        if "actuator" in content:  # version 0.2.0 again, where {} is none
            actuator = content.pop("actuator") or None
            content = {"format_version": 1, "additions": {"actuator": actuator}, **content}
        names = {field.name for field in fields(cls)}
        version = content.get("format_version", FORMAT_VERSION)
        if content.get("format") == FORMAT and version not in (1, FORMAT_VERSION):
            raise AgentError(
                f"{place}: expected format_version 1 or {FORMAT_VERSION}, got {version!r}."
            )
        if content.get("format") != FORMAT or set(content) != names:
            raise AgentError(f"{place}: expected the description of an exported file, got another.")
        try:
            content["task"] = dict(content["task"])
            content["additions"] = dict(content["additions"])
            content["noise"] = None if content["noise"] is None else tuple(content["noise"])
            content["processor"] = tuple(content["processor"])
            content["memory"] = dict(content["memory"])
        except (TypeError, ValueError) as error:
            raise AgentError(f"{place}: expected lists of numbers and names: {error}.") from error
        return cls(**content)

    def starts(self) -> dict[str, Tensor]:
        """What is kept from step to step, with its values where an episode starts.

        Raises:
            AgentError: for anything but numbers.
        """
        try:
            return {name: torch.tensor(_numbers(value)) for name, value in self.memory.items()}
        except (TypeError, ValueError, RuntimeError) as error:
            raise AgentError(f"memory: expected lists of numbers, got others: {error}.") from error

    def check(self, path: Path, *, machine_code: bool) -> None:
        """Refuse a file that is another one, or machine code that does not run here.

        Raises:
            AgentError: naming what differs.
        """
        if hashlib.sha256(path.read_bytes()).hexdigest() != self.sha256:
            raise AgentError(
                f"{path}: expected the file that {manifest_path(path).name} describes, got another."
            )
        if not machine_code:
            return
        here = {"torch_version": torch_version(), "platform": platform_name()}
        for name, value in here.items():
            if getattr(self, name) != value:
                raise AgentError(
                    f"{path}: it was made for {name} {getattr(self, name)!r}, here is {value!r}; "
                    "export the agent again on this machine."
                )
        if missing := sorted(set(self.processor) - set(processor())):
            raise AgentError(
                f"{path}: it was made for a processor with {', '.join(missing)}, which this one "
                "lacks; export the agent again on this machine."
            )


def _plain(value: Any) -> Any:
    """Nested lists with ``None`` in the place of NaN, which JSON lacks."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if math.isnan(value) else value


def _numbers(value: Any) -> Any:
    """The nested lists of which :func:`_plain` made these."""
    if isinstance(value, list):
        return [_numbers(item) for item in value]
    return math.nan if value is None else float(value)


def manifest_path(path: Path) -> Path:
    """Where the description of an exported file is."""
    return path.with_name(f"{path.name}.json")


def torch_version() -> str:
    """The version of torch, without its build."""
    return torch.__version__.split("+")[0]


def platform_name() -> str:
    """Operating system and processor family, such as ``Linux x86_64``."""
    return f"{platform.system()} {platform.machine()}"


def processor() -> tuple[str, ...]:
    """The vector instructions of this processor, by the names that Linux gives them.

    Elsewhere there are none, and only the family is compared.
    """
    prefixes = ("avx", "fma", "amx", "sse4", "f16c", "bmi", "sve", "asimd")
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return ()
    for line in text.splitlines():
        name, _, words = line.partition(":")
        if name.strip() in ("flags", "Features"):
            return tuple(sorted(word for word in set(words.split()) if word.startswith(prefixes)))
    return ()
