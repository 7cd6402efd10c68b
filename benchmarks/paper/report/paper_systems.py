"""The systems that tables compare: a row or a column for each registered method."""

from __future__ import annotations

from dataclasses import dataclass

from phihp_torchrl.config import METHODS, get_method

GROUPS = ("ours", "baseline", "ablation", "imagined")
"""The groups of methods in the order in which tables have them."""

_PAPER_ORDER = (
    "phihp",
    "td-mpc",
    "td3",
    "cem-oracle",
    "td-mpc-star",
    "ph-td-mpc-star",
    "dd-cem",
    "ph-cem",
    "dd-phihp",
    "td3-im-ph",
    "td3-im-dd",
)
# Methods that the paper does not have come after those of their group.

AGENT = "agent"
"""How an agent acts as it was saved: by plans, or by its actor if calibration said so."""

_WAY = {"hybrid_planner": "planner", "plain_planner": "planner", "actor": "actor"}


@dataclass(frozen=True)
class PaperSystem:
    """A row or a column of a table.

    Args:
        name: the paper's name.
        sources: methods whose runs it is in, and how it acts there (``None``: as that run does;
            :data:`AGENT`: by plans, unless calibration has let the actor act).
            The first that a seed was run with counts: PhIHP's actor alone is TD3-im-ph.
    """

    name: str
    sources: tuple[tuple[str, str | None], ...]


def has_share(method: str) -> bool:
    """Whether a method takes a share of the published real samples, by which its model is fitted.

    Examples:
        >>> has_share("dd-phihp"), has_share("td3"), has_share("of a plugin that is not here")
        (True, False, False)
    """
    known = METHODS.get(method)
    return known is not None and known.samples_key == "model.real_steps"


def system(method: str) -> PaperSystem:
    """What tables have of a registered method.

    Examples:
        >>> system("td3-im-ph").sources
        (('td3-im-ph', 'actor'), ('phihp', 'actor'))
        >>> system("phihp").sources
        (('phihp', 'agent'),)
    """
    known = get_method(method)
    also = () if known.also_in is None else (known.also_in,)
    # No run is left out for what its calibration chose: that would select on the outcome.
    way = AGENT if "calibrate" in known.phases else _WAY.get(known.acting)
    return PaperSystem(known.label, ((method, way), *also))


def systems(*groups: str) -> tuple[PaperSystem, ...]:
    """The systems of these groups, or of all: those of the paper and those of plugins.

    Examples:
        >>> [one.name for one in systems("baseline")][:3]
        ['TD-MPC', 'TD3', 'CEM-oracle']
    """
    order = {name: i for i, name in enumerate(_PAPER_ORDER)}
    names = sorted(METHODS, key=lambda name: order.get(name, len(order)))
    return tuple(
        system(name) for group in groups or GROUPS for name in names if METHODS[name].group == group
    )


PHIHP, TD_MPC, TD3 = system("phihp"), system("td-mpc"), system("td3")
DD_PHIHP = system("dd-phihp")
TD3_IM_PH, TD3_IM_DD = system("td3-im-ph"), system("td3-im-dd")
PH_CEM, DD_CEM = system("ph-cem"), system("dd-cem")
PH_TD_MPC_STAR, TD_MPC_STAR = system("ph-td-mpc-star"), system("td-mpc-star")
