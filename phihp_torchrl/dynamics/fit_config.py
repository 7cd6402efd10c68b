"""How a model is fitted, as settings."""

from __future__ import annotations

from dataclasses import dataclass

from phihp_torchrl.config import (
    ConfigError,
    check_choice,
    check_count,
    check_fields,
    check_positive,
    check_positive_share,
)

METHODS = ("levenberg_marquardt", "multiple_shooting", "adam")
"""The methods of a fit, by the name that settings use."""


@dataclass(frozen=True)
class FitConfig:
    """How a model is fitted to transitions.

    Args:
        method: ``"levenberg_marquardt"``, ``"multiple_shooting"`` or ``"adam"``. The model is small
            and its loss is a sum of squares, so a second-order method reaches within seconds errors
            that Adam never reaches. Multiple shooting is for noisy sensors: it fits trajectories
            whose starts are free.
        steps: number of optimization steps.
        scaled: whether errors are measured in units of one-step changes
            (:meth:`DynamicsLoss.set_scales`), or in raw units as published.
        batch_size: transitions per step; ``None`` for all of them, as published.
        learning_rate: learning rate of Adam.
        cosine_decay: whether the learning rate of Adam decays to zero.
        initial_lambda: first value of λ for methods of least squares. A small one lets the prior
            explain as much as it can before the residual contributes.
        final_lambda: last value of λ for them.
        patience: they stop after this many steps at the final λ in which the held-out error did not
            fall by a tenth (multiple shooting: by a hundredth).
        window: steps in a trajectory of multiple shooting.
        shuffle_actions: whether the penalty on F^r of Levenberg-Marquardt pairs each state with the
            action of another transition. The actions of a controller go with the velocities, so
            that the smallest F^r on the pairs as recorded would explain friction by a wrong effect
            of the action.
        robust: errors of Levenberg-Marquardt beyond so many robust standard deviations count in
            proportion to their size and no longer to its square, so that outliers and hits of
            stops, which the equations do not describe, do not dominate the fit; 1.5 to 3 is usual.
            Null for squares.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> FitConfig(method="newton")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: method: expected one of ['levenberg_marquardt', \
'multiple_shooting', 'adam'], got 'newton'.
    """

    method: str = "levenberg_marquardt"
    steps: int = 60
    scaled: bool = True
    batch_size: int | None = 1000
    learning_rate: float = 1e-3
    cosine_decay: bool = False
    initial_lambda: float = 1e-2
    final_lambda: float = 1e7
    patience: int = 8
    window: int = 20
    shuffle_actions: bool = True
    robust: float | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        check_choice(self, "method", METHODS)
        check_count(self, "steps", "patience", "window")
        check_positive(self, "initial_lambda", "final_lambda")
        check_positive_share(self, "learning_rate")
        if self.batch_size is not None:
            check_count(self, "batch_size")
        if self.robust is not None:
            check_positive(self, "robust")
            if self.method != "levenberg_marquardt":
                raise ConfigError(
                    "robust",
                    f"expected null with method={self.method!r}, which has a loss of its own, "
                    f"got {self.robust}.",
                )

    @property
    def lambda_growth(self) -> float:
        """Factor of λ per step of least squares: from first to last in half of the steps."""
        return (self.final_lambda / self.initial_lambda) ** (1.0 / max(1, self.steps // 2))
