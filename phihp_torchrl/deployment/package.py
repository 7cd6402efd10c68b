"""A plan as native code: an AOTInductor package of exactly what a planner calls at each step."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from phihp_torchrl.compilation import compile_ahead
from phihp_torchrl.config import DIGEST, digest_of, is_own_signature, own_signature
from phihp_torchrl.deployment.formats import AGENT_FILE, SAVING
from phihp_torchrl.deployment.manifest import platform_name, processor, torch_version
from phihp_torchrl.deployment.reading import AgentError, read_json
from phihp_torchrl.origin import package_version
from phihp_torchrl.planners import SamplingPlanner

if TYPE_CHECKING:
    from phihp_torchrl.deployment.agent import Agent

_log = logging.getLogger(__name__)

PACKAGE_FILE = "packaged_plan.pt2"
PACKAGE_NOTE = f"{PACKAGE_FILE}.json"
_FORMAT = "phihp_torchrl packaged plan"
# Largest relative difference of scores from the eager plan's, for the same noise.
_TOLERANCE = 0.01


class _Plan(nn.Module):
    """The plan of a planner as a module of flat tensors; other arguments are constants."""

    def __init__(self, planner: SamplingPlanner, arguments: tuple[Any, ...]) -> None:
        super().__init__()
        self.planner = planner  # whose parameters are then this module's
        self.leaves, self.spec = pytree.tree_flatten(arguments)

    def forward(self, *tensors: Tensor) -> list[Tensor]:
        given = iter(tensors)
        leaves = [next(given) if isinstance(leaf, Tensor) else leaf for leaf in self.leaves]
        planner = self.planner
        found = planner._plan(
            *pytree.tree_unflatten(leaves, self.spec),
            problem=planner.problem(compiled=True),
            settings=planner.settings,
        )
        return pytree.tree_leaves(found)


class _PackagedPlan:
    """A planner's plan by the code of a package, as long as the weights are those it was made of.

    Args:
        planner: the planner.
        loaded: the loaded package, a function of flat tensors.
        like: what a plan returns.
    """

    def __init__(self, planner: SamplingPlanner, loaded: Any, like: Any) -> None:
        # To call the package reads its layout anew each time, which is a twentieth of a fast plan.
        self._planner, self._run = planner, loaded.loader.boxed_run
        _, self._spec = pytree.tree_flatten(like)
        self._weights = [*planner.parameters(), *planner.buffers()]
        self._versions = [tensor._version for tensor in self._weights]

    @property
    def is_current(self) -> bool:
        """Whether the weights are as they were."""
        return [tensor._version for tensor in self._weights] == self._versions

    def __call__(self, *args: Any) -> Any:
        if not self.is_current:
            return self._planner.plan_eagerly(*args)
        return pytree.tree_unflatten(self._run(_tensors(args)), self._spec)


def write_package(agent: Agent, path: Path) -> None:
    """Compile an agent's plan for one observation at a time, with its weights, into a file.

    Raises:
        AgentError: for an agent that does not plan, or whose plan does not compile.
    """
    planner = agent.planner
    if planner is None:
        raise AgentError("packaged: expected an agent with a planner, got one without.")
    if reason := planner.why_not_compiled():
        raise AgentError(f"packaged: expected a plan that compiles, but {reason}.")
    arguments, _ = planner.example_call(agent.example())
    compile_ahead(_Plan(planner, arguments), tuple(_tensors(arguments)), path)


def use_package(agent: Agent, path: Path) -> None:
    """Plan by a package from now on, after it has found what the eager plan finds.

    When weights change, in place or by ``load_state_dict``, the agent plans eagerly again.

    Raises:
        AgentError: if it finds another plan.
    """
    planner = agent.planner
    assert planner is not None
    arguments, eager = planner.example_call(agent.example())
    plan = _PackagedPlan(planner, torch._inductor.aoti_load_package(str(path)), eager)
    with torch.no_grad():
        found = plan(*arguments)
    alike = torch.isclose(found.score, eager.score, rtol=_TOLERANCE, atol=_TOLERANCE)
    if found.actions.shape != eager.actions.shape or not alike.all():
        raise AgentError(
            f"{path}: expected the plan of this agent, of score {eager.score.tolist()}, got one of "
            f"{found.score.tolist()}."
        )
    planner.replace_plan(arguments, plan)


def place_package(made: Path, directory: Path) -> None:
    """Put a package of its plan beside a saved agent, with what says whose it is.

    Args:
        made: the package, as :func:`write_package` wrote it.
        directory: the directory of the agent.
    """
    text = describe(made, _identity(directory))
    with tempfile.TemporaryDirectory(dir=directory, prefix=SAVING) as temporary:
        shutil.copyfile(made, Path(temporary, PACKAGE_FILE))
        Path(temporary, PACKAGE_NOTE).write_text(text, encoding="utf-8")
        for name in (PACKAGE_FILE, PACKAGE_NOTE):
            os.replace(Path(temporary, name), directory / name)


def drop_package_of_another(directory: Path) -> None:
    """Remove a package of the agent that was here before, which nobody can plan by any more.

    Args:
        directory: the directory of the agent.
    """
    note = directory / PACKAGE_NOTE
    if (directory / PACKAGE_FILE).exists() and not _is_of(note, _identity(directory)):
        for name in (PACKAGE_FILE, PACKAGE_NOTE):
            (directory / name).unlink(missing_ok=True)


def _identity(directory: Path) -> str:
    return identify(read_json(directory / AGENT_FILE))


def take_package(agent: Agent, directory: Path, device: torch.device, *, trusted: bool) -> None:
    """Plan by the package in an agent's directory, if it is the user's own or trusted.

    If it is not what it should be, a warning says why and the agent plans eagerly.

    Args:
        agent: the agent of that directory.
        directory: the directory.
        device: the device of the agent.
        trusted: whether a package of somebody else is opened too.
    """
    identity = _identity(directory)
    try:
        if agent.planner is None:
            raise AgentError("packaged: expected an agent that plans, got one without a planner.")
        if device.type != "cpu":
            raise AgentError(f"packaged: expected the CPU, for which it is made, got {device}.")
        with tempfile.TemporaryDirectory(prefix="phihp-package-") as private:
            # What is checked is what is opened, whoever else may write into the directory.
            for name in (PACKAGE_FILE, PACKAGE_NOTE):
                with suppress(FileNotFoundError):
                    shutil.copyfile(directory / name, Path(private, name))
            package = Path(private, PACKAGE_FILE)
            if not trusted and not is_ours(package):
                _log.info(
                    "%s was not made by you on this machine and is not opened: it would run with "
                    "your rights. load_agent(..., packaged=True) plans by it.",
                    directory / PACKAGE_FILE,
                )
                return
            check_package(package, identity)
            use_package(agent, package)
    except (AgentError, RuntimeError, OSError) as error:
        _log.warning("The agent plans eagerly: %s", error)


def describe(made: Path, identity: str) -> str:
    """What a package is for, as JSON to lie beside it, signed by whoever makes it."""
    told = {"format": _FORMAT, "sha256": _digest(made), **_here(identity)}
    try:
        told["signature"] = own_signature(_signed(told))
    except OSError as error:
        _log.warning(
            "The packaged plan could not be signed (%s), so that load_agent opens it with "
            "packaged=True alone.",
            error,
        )
    return json.dumps(told, indent=2) + "\n"


def _is_of(note: Path, identity: str) -> bool:
    """Whether what lies beside a package says that it is of this agent."""
    try:
        return read_json(note).get("agent_sha256") == identity
    except AgentError:
        return False


def is_ours(path: Path) -> bool:
    """Whether a package was made by this user on this machine, and not changed since."""
    try:
        told = dict(read_json(_description(path)))
        signature = told.pop("signature", None)
        return is_own_signature(signature, _signed(told)) and told["sha256"] == _digest(path)
    except (AgentError, OSError, KeyError):
        return False


def check_package(path: Path, identity: str) -> None:
    """Refuse a package that was changed, or made for another agent, torch or processor.

    Raises:
        AgentError: naming what differs.
    """
    if not path.is_file():
        raise AgentError(
            f"{path}: expected a packaged plan, found none; "
            "save_agent(agent, directory, packaged=True) writes one."
        )
    told, again = read_json(_description(path)), "package the agent again on this machine."
    for name, here in {"format": _FORMAT, **_here(identity), "sha256": _digest(path)}.items():
        known = told.get(name)
        if name == "processor":
            if missing := sorted(set(known or ()) - set(here)):
                raise AgentError(f"{path}: this processor lacks {', '.join(missing)}; {again}")
        elif known != here:
            raise AgentError(f"{path}: expected {name} {here!r}, got {known!r}; {again}")


def identify(content: Mapping[str, Any]) -> str:
    """A digest of all of an agent's file that a plan depends on, its weights' among it."""
    plain = {key: value for key, value in content.items() if key not in ("metadata", DIGEST)}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def _here(identity: str) -> dict[str, Any]:
    return {
        "agent_sha256": identity,
        "package_version": package_version(),
        "torch_version": torch_version(),
        "platform": platform_name(),
        "processor": list(processor()),
    }


def _signed(told: Mapping[str, Any]) -> str:
    """The text that is signed; its first word keeps it apart from what else the key signs."""
    return "package " + json.dumps(told, sort_keys=True)


def _digest(path: Path) -> str:
    return digest_of(path.read_bytes())


def _description(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")


def _tensors(arguments: Any) -> list[Tensor]:
    nested = any(isinstance(part, tuple) for part in arguments)
    leaves = pytree.tree_leaves(arguments) if nested else arguments
    return [leaf for leaf in leaves if isinstance(leaf, Tensor)]
