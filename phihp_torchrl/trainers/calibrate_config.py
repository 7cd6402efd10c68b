"""Settings of the phase that calibrates the planner in imagination."""

from __future__ import annotations

from dataclasses import dataclass

from phihp_torchrl.config import ConfigError, check_count, check_fields, check_not_negative


@dataclass(frozen=True)
class CalibrateConfig:
    """How the planner's settings are compared with the actor in imagined episodes.

    Args:
        enabled: whether to calibrate; false takes the settings of the section planner as they are,
            and the run has no such phase.
        episodes: paired imagined episodes of each way to plan; the one that is chosen may play
            more.
        confidence: standard errors by which one way to plan must beat another, and by which one of
            plan and actor beats the other without doubt.
        max_episodes: episodes at most; the way that is chosen goes on to 24, and to twice as many
            while it is in doubt who is to act.
        budget: transitions that plans may imagine, nearly half of them before a way is chosen; a
            call of the model counts as a thousand more, and one of a network as one for each ten
            thousand weights, so a million takes about half a second of one core. Transitions of a
            model whose step has over 60 tensor operations count more in proportion. Three episodes
            of three ways to plan and of the fast budget, and six of the one that is chosen, are
            played in any case.
        catch: whether a linear-quadratic regulator may act in the place of plans: near the task's
            goal where they do not come to rest, if imagined episodes show that it loses nothing,
            and on a reference that stands still, where it may cost 1 % of the return.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> CalibrateConfig(episodes=1)
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: episodes: expected a whole number >= 2, got 1.
    """

    enabled: bool = True
    episodes: int = 6
    confidence: float = 2.0
    max_episodes: int = 48
    budget: int = 160_000_000
    catch: bool = True

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("enabled", "catch"):
            if not isinstance(value := getattr(self, name), bool):
                raise ConfigError(name, f"expected true or false, got {value!r}.")
        check_count(self, "episodes", least=2)
        check_count(self, "budget")
        check_count(self, "max_episodes", least=self.episodes)
        check_not_negative(self, "confidence")
