"""Settings of the phase that calibrates the planner in imagination."""

from __future__ import annotations

from dataclasses import dataclass

from phihp_torchrl.config import (
    ConfigError,
    check_count,
    check_fields,
    check_not_negative,
    is_whole,
)


@dataclass(frozen=True)
class CalibrateConfig:
    """How the planner's settings are compared with the actor in imagined episodes.

    Args:
        enabled: whether to calibrate; false takes the settings of the section planner as they are,
            and the run has no such phase.
        episodes: paired imagined episodes, and as many starts in the second half of one.
        rounds: steps that each setting plans before the actor takes over, in each round; after a
            round the better half of the settings goes on.
        follow_steps: steps of the actor after those.
        confidence: standard errors by which settings must beat those that were given, and by which
            one of plan and actor beats the other without doubt, in episodes at the end.
        max_episodes: episodes at the end at most; their number doubles while it is in doubt who is
            to act.
        budget: transitions that plans may imagine, of which half is for the rounds; a call of the
            model counts as a thousand more, and one of a network as one for each ten thousand
            weights, so a million takes about a second of one core. Three episodes a round, and at
            the end the steps of the last round, are played in any case.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> CalibrateConfig(rounds=(20, 10))
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: rounds: expected rising whole numbers >= 2, got (20, 10).
    """

    enabled: bool = True
    episodes: int = 6
    rounds: tuple[int, ...] = (10, 30)
    follow_steps: int = 50
    confidence: float = 2.0
    max_episodes: int = 48
    budget: int = 12_000_000

    def __post_init__(self) -> None:
        check_fields(self)
        if not isinstance(self.enabled, bool):
            raise ConfigError("enabled", f"expected true or false, got {self.enabled!r}.")
        check_count(self, "episodes", least=2)
        check_count(self, "budget")
        check_count(self, "max_episodes", least=self.episodes)
        check_count(self, "follow_steps", least=0)
        check_not_negative(self, "confidence")
        rounds = self.rounds
        good = bool(rounds) and all(is_whole(steps, 2) for steps in rounds)
        if not good or list(rounds) != sorted(set(rounds)):
            raise ConfigError("rounds", f"expected rising whole numbers >= 2, got {rounds}.")
