"""What the policy phase compiles, compiled by another process while the model is learned."""

from __future__ import annotations

import logging
import math
import pickle
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from phihp_torchrl.compilation import OtherProcess
from phihp_torchrl.config import resolve_seconds
from phihp_torchrl.trainers.model_config import ModelConfig, first_integrator, make_dynamics
from phihp_torchrl.trainers.policy import PolicyTrainer
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.trainers.run_config import RunConfig
from phihp_torchrl.trainers.spare import has_idle_core, is_importable
from phihp_torchrl.worlds import World

DOING = "waiting for what another process compiles"
"""What a run says that it is doing while this is on its stack."""

_log = logging.getLogger(__name__)
_GIVEN = "run"
# Seconds that the policy phase waits; it then compiles by itself what is not in the cache yet.
_PATIENCE = 300.0
# Any states that data have, of which imagined lives may start from some.
_FEW = 64


class CompileAhead:
    """A policy phase on its way into the compiler's cache, while the phases before it are done.

    Another process trains a policy of the run's sizes in an untrained model for as long as
    everything takes that is compiled. What it makes has no part in the run, which finds graphs of
    the same code and shapes in the cache. Where the fit of the model changes those
    (:meth:`still_fits`), or anything fails, the phase compiles as it would have.

    Args:
        config: settings of the run.
        world: its world.
    """

    def __init__(self, config: RunConfig, world: World) -> None:
        self.config, self.world = config, world
        self._process: OtherProcess | None = None
        try:
            given = pickle.dumps((config, world))
            place = tempfile.TemporaryDirectory(prefix="phihp-compile-")
            Path(place.name, _GIVEN).write_bytes(given)
            self._process = OtherProcess(f"{__name__}:compile_policy", [], place)
        except Exception as error:  # a world may refuse in any way, and a run needs none of it
            _log.debug("Nothing is compiled ahead, for another process cannot have it: %s", error)

    @property
    def is_at_work(self) -> bool:
        """Whether the other process is at work."""
        return self._process is not None and not self._process.ended

    def still_fits(self, model: Any) -> bool:
        """Whether the policy phase has the same graphs after this phase of the model.

        It has not where the fit has chosen another integrator, or has found an actuator, with which
        the world has another task.
        """
        settings, dynamics = self.config.section("model"), getattr(model, "dynamics", None)
        same = str(getattr(dynamics, "integrator", "")) == str(first_integrator(settings))
        world = getattr(model, "world", self.world)
        return (same or settings.kind == "oracle") and world is self.world

    def wait(self) -> None:
        """Wait until all is in the cache that the other process can put there."""
        if self._process is None or self._process.ended:
            return
        try:
            self._process.wait(_PATIENCE)
        except TimeoutError:
            self._process.end()
        else:
            if failure := self._process.failure:
                _log.debug("What was to be compiled ahead is compiled now: %s", failure)

    def end(self) -> None:
        """End the other process, if it is still at work."""
        if self._process is not None:
            self._process.end()


def compiles_ahead(config: RunConfig, world: World) -> bool:
    """Whether another process may compile the policy phase: it costs nobody much.

    The model is learned before, in a simulated world, a core is to spare, and the other process
    finds what the run is made of. A policy phase that ends after so many seconds compiles by
    itself, for how far it gets must not depend on an idle core.

    Args:
        config: settings of the run, whose policy phase is compiled.
        world: its world.
    """
    if not {"model", "policy"} <= set(config.phases_to_do):
        return False
    model, policy = (config.section(name) for name in ("model", "policy"))
    if not isinstance(model, ModelConfig) or not isinstance(policy, PolicyConfig):
        return False
    if policy.max_seconds is not None or world.truth is None:
        return False
    return is_importable(config, world.task) and has_idle_core(config.threads, begun=False)


def compile_policy(place: str) -> None:
    """Train a policy for as long as something is compiled: what the other process does."""
    config, world = pickle.loads(Path(place, _GIVEN).read_bytes())
    torch.set_num_threads(config.threads)
    torch.set_flush_denormal(True)
    generator = torch.Generator().manual_seed(config.seed)
    trainer = PolicyTrainer(
        world.task,
        make_dynamics(world, config.section("model"), generator),
        _short(resolve_seconds(config.section("policy"), world.task.time_step)),
        world=world,
        seed=config.seed,
        data_states=world.task.sample_start([_FEW], generator),
        compile=True,
    )
    trainer.advance()


def _short(settings: PolicyConfig) -> PolicyConfig:
    """Settings of the same graphs, in one round of updates and one step of the critics' fit."""
    critic_updates = settings.analytic.critic_updates if settings.method == "analytic" else 1
    updates = math.lcm(settings.td3.policy_delay, critic_updates)
    fits = updates if settings.refit.interval else 0
    return replace(
        settings,
        updates=updates,
        evaluation_interval=updates,
        planned=0.0,
        patience=0.0,
        constants_std=0.01 if settings.draw_constants else None,
        refit=replace(settings.refit, start=0, interval=fits, steps=1),
    )
