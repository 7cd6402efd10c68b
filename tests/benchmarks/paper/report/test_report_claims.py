"""The paper's claims, each with its verdict."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from kept_runs import make, make_run, results, table, text

from grid.cell import Cell
from report import Results, read_runs
from report.action_times import faster, read_turns
from report.claims import (
    claims_section,
    fewer_samples,
    hybrid_earns_more,
    not_worse,
    planning_improves,
)
from report.paper_systems import DD_CEM, PH_CEM, TD3_IM_DD, TD_MPC
from report.planned import Planned


def test_each_claim_gets_its_verdict(tmp_path: Path) -> None:
    for seed in (0, 1, 2):
        more = 0.1 * seed  # seeds differ, as they do
        acting = {"planner": [9.0 + more, 9.5], "actor": [1.0, 2.0 + 3 * more]}
        make_run(tmp_path, seed=seed, acting=acting)
        make_run(tmp_path, seed=seed, samples=500, acting={"planner": [9.0]})
        curve = ((2000, -9.0), (9000, 9.0), (20000, 9.0))
        acting = {"planner": [9.0, 9.0]}
        make_run(tmp_path, "td-mpc", seed=seed, samples=20000, curve=curve, acting=acting)
        make_run(tmp_path, "td3", seed=seed, samples=300, acting={"actor": [9.0, 11.0 + more]})
        make_run(tmp_path, "ph-cem", seed=seed, samples=500, acting={"planner": [5.0 + more]})
        make_run(tmp_path, "ph-cem", seed=seed, samples=5000, acting={"planner": [1.0]})
        make_run(tmp_path, "dd-cem", seed=seed, samples=500, acting={"planner": [4.9 + more]})
    found = results(tmp_path)
    turns = {"PhIHP, eager": [4.0, 5.0, 4.0], "TD-MPC, published, eager": [40.0, 50.0, 44.0]}
    section = claims_section(found, {"pendulum": turns})
    lines = section.text.splitlines()
    # Of samples only the ends are known: TD-MPC reached 90 % after 2000 and by 9000, PhIHP by 500.
    assert "not shown in 1 of 1 comparisons" in lines[0]
    assert "refuted in 1 of 1 comparisons (refuted: pendulum)" in lines[1]
    assert "**: shown in 1 of 1 comparisons (shown: pendulum)" in lines[2]
    assert "not shown in 1 of 1 comparisons" in lines[3]
    assert "**: shown in 1 of 1 comparisons (shown: TD-MPC, published, eager on" in lines[4]
    rows = {
        str(row[0]): [str(cell) for cell in row[1:]] for row in section.tables["Comparisons"].rows
    }
    assert rows["1, pendulum"] == [
        "not shown",
        "≤ 500 against 2000–9000 samples",
        "4.0 and more times",
        "4.0 and more times",
        "3, 3",
    ]
    assert rows["5, TD-MPC, published, eager on pendulum"] == [
        "shown",
        "4.0 ms against 44.0, 10.00 times",
        "–",
        "10.00 to 11.00 times",
        "3 turns",
    ]
    assert rows["4, Ph-CEM on pendulum, 500 samples"][2:] == ["–", "−0.1 to 0.3", "3, 3"]
    assert [finding.what for finding in fewer_samples(found)] == ["pendulum"]


def test_a_claim_needs_three_seeds_and_differences_beyond_their_noise(tmp_path: Path) -> None:
    for seed in (0, 1):
        make_run(tmp_path, seed=seed, acting={"planner": [9.0 + seed], "actor": [1.0]})
    (few,) = planning_improves(results(tmp_path))
    assert (few.verdict, few.seeds) == ("not shown", "2, 2")
    make_run(tmp_path, seed=2, acting={"planner": [9.5], "actor": [1.0]})
    (enough,) = planning_improves(results(tmp_path))
    assert enough.verdict == "shown"
    # Four more seeds of another task in which the planner gains nothing.
    for seed, gain in enumerate((0.01, -0.02, 0.01, -0.01)):
        acting = {"planner": [-90.0 + gain], "actor": [-90.0]}
        make_run(tmp_path, task="acrobot", seed=seed, samples=2500, acting=acting)
    by_task = {finding.what: finding for finding in planning_improves(results(tmp_path))}
    assert by_task["acrobot"].verdict == "not shown"
    assert "equivalent" in by_task["acrobot"].effect


def test_samples_known_by_their_ends_can_show_a_claim_or_refute_it(tmp_path: Path) -> None:
    acting, planned = {"planner": [9.0], "actor": [1.0]}, {"planner": [9.0]}
    curves = {"pendulum": ((501, 0.0), (1000, 9.0)), "acrobot": ((100, 9.0), (200, 9.0))}
    for seed in (0, 1, 2):
        for task, curve in curves.items():
            for samples in (100, 200):
                make_run(tmp_path, task=task, seed=seed, samples=samples, acting=acting)
            make_run(tmp_path, "td-mpc", task, seed, 2000, curve=curve, acting=planned)
        few = {"planner": [1.0], "actor": [1.0]}
        make_run(tmp_path, task="cartpole", seed=seed, samples=50, acting=few)
        make_run(tmp_path, task="cartpole", seed=seed, samples=900, acting=acting)
        curve = ((200, 9.0), (400, 9.0))
        make_run(tmp_path, "td-mpc", "cartpole", seed, 2000, curve=curve, acting=planned)
        verdicts = {finding.what: finding.verdict for finding in fewer_samples(results(tmp_path))}
        if seed < 2:  # one or two seeds show nothing
            assert set(verdicts.values()) == {"not shown"}
    assert verdicts == {"pendulum": "shown", "acrobot": "not shown", "cartpole": "refuted"}


def test_hybrid_and_data_driven_are_compared_at_equal_samples_alone(tmp_path: Path) -> None:
    make_run(tmp_path, "td3-im-ph", samples=1000, acting={"actor": [-1.0]})
    make_run(tmp_path, "td3-im-dd", samples=500, acting={"actor": [-2.0]}, kind="data_driven")
    found = results(tmp_path)
    assert found.has_run(TD3_IM_DD, "pendulum")
    assert not found.has_run(DD_CEM, "pendulum")
    assert not found.has_run(PH_CEM, "pendulum")
    assert not found.has_run(TD_MPC, "pendulum")
    assert claims_section(found).text.splitlines()[3].endswith("**: nothing to compare.")


def test_one_number_of_samples_shows_nothing_of_how_many_are_needed(tmp_path: Path) -> None:
    """A return at one number alone is the best one, however bad it is."""
    cells = []
    for seed in (100, 101, 102):
        make_run(tmp_path, seed=seed, acting={"planner": [-1950.0]})
        make_run(tmp_path, "td-mpc", seed=seed, samples=30_000, acting={"planner": [-150.0]},
                 curve=((10_000, -900.0), (20_000, -200.0)))  # fmt: skip
        cells += [Cell(method, "pendulum", seed, 1000) for method in ("phihp", "td-mpc")]
    assert fewer_samples(results(tmp_path)) == []
    (found,) = fewer_samples(Results(results(tmp_path).runs, Planned(tuple(cells))))
    assert (found.verdict, found.seeds) == ("not measured", "3, 3")


def test_seeds_that_disagree_do_not_show_a_ratio(tmp_path: Path) -> None:
    """The mean is beyond the bound, its interval over seeds is not."""
    for seed, before in enumerate((100, 200, 1800)):
        for samples in (100, 200):
            make_run(tmp_path, seed=seed, samples=samples, acting={"planner": [9.0]})
        curve = ((before, 0.0), (before + 100, 9.0))
        make_run(tmp_path, "td-mpc", seed=seed, samples=2000, curve=curve,
                 acting={"planner": [9.0]})  # fmt: skip
    (found,) = fewer_samples(results(tmp_path))
    assert found.ends == "7.0 and more times"
    assert found.interval == "1.0 and more times"
    assert found.verdict == "not shown"


def test_a_seed_whose_actor_acts_gains_nothing_and_counts(tmp_path: Path) -> None:
    for seed, gain in enumerate((8.0, 9.0)):
        make_run(tmp_path, seed=seed, acting={"planner": [gain], "actor": [0.0]})
    make_run(tmp_path, seed=2, acting={"actor": [5.0]})
    (mean,) = planning_improves(results(tmp_path))
    assert (mean.effect.split(",")[0], mean.seeds) == ("+5.7", "3, 3")
    for seed in range(3):
        make_run(tmp_path, task="cartpole", seed=seed, acting={"actor": [500.0]})
    nil = {finding.what: finding for finding in planning_improves(results(tmp_path))}["cartpole"]
    assert (nil.verdict, nil.effect, nil.seeds) == ("not shown", "+0.0, equivalent", "3, 3")


def test_a_cell_of_several_configurations_gets_no_verdict(tmp_path: Path) -> None:
    for seed in (0, 1, 2):
        acting = {"planner": [9.0 + seed], "actor": [1.0]}
        make_run(tmp_path / "runs", seed=seed, samples=100, acting=acting)
        folder = make_run(tmp_path / "runs", seed=seed, acting=acting)
        td3 = {"actor": [0.1 * seed]}
        make_run(tmp_path / "runs", "td3", seed=seed, samples=300, acting=td3)
        planned = {"planner": [9.0 + seed]}
        curve = ((2000, 1.0), (9000, 9.0))
        make_run(tmp_path / "runs", "td-mpc", seed=seed, samples=9000, acting=planned, curve=curve)
    config = folder / "config.yaml"
    config.write_text(config.read_text() + "evaluate: {first_seed: 2000100}\n")
    section = claims_section(results(tmp_path / "runs"))
    rows = {str(row[0]): [str(cell) for cell in row] for row in section.tables["Comparisons"].rows}
    assert {name: row[1] for name, row in rows.items()} == {
        "1, pendulum": "mixed",
        "2, pendulum": "mixed",
        "3, pendulum": "mixed",
        "6, TD-MPC on pendulum": "mixed",
        "6, TD3 on pendulum": "mixed",
    }
    assert rows["3, pendulum"][2] == "+9.0", "no p"
    assert "mixed in 1 of 1 comparisons (mixed: pendulum)" in section.text
    make(tmp_path)
    assert table(tmp_path, "planning_gain")[0]["p"] == "mixed"
    assert table(tmp_path, "differences")[0]["p"] == "mixed"


@pytest.mark.parametrize(
    ("theirs", "verdict"),
    [
        ([9.0, 8.0, 10.0, 9.0], "shown"),
        ([3.0, 5.0, 3.0, 5.0], "not shown"),
        ([3.0, 2.0, 3.0, 2.0], "refuted"),
    ],
)
def test_times_are_compared_by_turns(tmp_path: Path, theirs: list[float], verdict: str) -> None:
    turns = {"PhIHP, compiled": [4.0] * 4, "TD-MPC, reduced, compiled": theirs}
    (tmp_path / "acrobot.json").write_text(json.dumps({"turns": turns}))
    (finding,) = faster(read_turns(tmp_path)[0])
    assert (finding.what, finding.verdict) == ("TD-MPC, reduced, compiled on acrobot", verdict)


def test_a_p_value_of_a_margin_says_so(tmp_path: Path) -> None:
    for seed, way in enumerate((-0.1, 0.0, 0.1)):
        make_run(tmp_path, seed=seed, acting={"planner": [way], "actor": [way]})
        make_run(tmp_path, "td3", seed=seed, samples=300, acting={"actor": [-2 * way]})
    (finding,) = not_worse(results(tmp_path))
    assert finding.effect.endswith(" of −19.7")  # 1 % of 200 π²


@pytest.mark.parametrize(
    ("worse_by", "spread", "verdict"),
    [
        (0.0, 0.1, "shown"),
        (0.0, 0.0, "shown"),  # nothing varies: both keep the pole up
        (0.0, 9.0, "not shown"),  # as much on average, but nobody knows
        (4.9, 0.0, "shown"),
        (4.9, 0.1, "not shown"),
        (5.1, 0.0, "refuted"),
        (9.0, 0.1, "refuted"),
    ],
)
def test_what_is_worse_by_less_than_the_margin_is_as_good(
    tmp_path: Path, worse_by: float, spread: float, verdict: str
) -> None:
    """The margin of CartPole is 1 % of 500."""
    for seed, way in enumerate((-1.0, 0.0, 1.0)):
        ours = 490.0 + spread * way
        acting = {"planner": [ours], "actor": [ours]}
        make_run(tmp_path, task="cartpole", seed=seed, samples=2500, acting=acting)
        theirs = {"actor": [490.0 + worse_by - spread * way]}
        make_run(tmp_path, "td3", task="cartpole", seed=seed, samples=9000, acting=theirs)
    (finding,) = not_worse(results(tmp_path))
    assert (finding.what, finding.verdict) == ("TD3 on cartpole", verdict)


def test_a_comparison_has_one_verdict(tmp_path: Path) -> None:
    """That of its claim; tables of other families of tests are to explore."""
    make_run(tmp_path / "runs")
    made = make(tmp_path)
    for name, title in (
        ("differences", "PhIHP against each baseline"),
        ("planning_gain", "PhIHP, planner and actor"),
    ):
        assert "xploratory" in text(made, title)
        assert not [key for key in table(tmp_path, name)[0] if key.endswith(" is")]


def test_equal_samples_are_those_with_enough_seeds(tmp_path: Path) -> None:
    for seed in (0, 1, 2):
        make_run(tmp_path, "ph-cem", seed=seed, samples=500, acting={"planner": [5.0 + seed]})
        make_run(tmp_path, "dd-cem", seed=seed, samples=500, acting={"planner": [4.0 + seed]})
    for method in ("ph-cem", "dd-cem"):
        make_run(tmp_path, method, samples=5000, acting={"planner": [1.0]})
    rows = claims_section(results(tmp_path)).tables["Comparisons"].rows
    assert [(row[0], row[-1]) for row in rows] == [("4, Ph-CEM on pendulum, 500 samples", "3, 3")]


def test_the_hybrid_is_compared_at_few_samples_and_at_many(tmp_path: Path) -> None:
    for seed in (0, 1, 2):
        for samples, gain in ((100, 9.0), (1000, 0.1)):
            ours = {"planner": [5.0 + gain + 0.1 * seed], "actor": [4.0 + gain + 0.1 * seed]}
            make_run(tmp_path, seed=seed, samples=samples, acting=ours)
            more = (0.0, 0.5, -0.5)[seed]
            theirs = {"planner": [5.0 + more], "actor": [4.0 + more]}
            make_run(tmp_path, "dd-phihp", seed=seed, samples=samples, acting=theirs,
                     kind="data_driven")  # fmt: skip
    found = {finding.what: finding for finding in hybrid_earns_more(results(tmp_path))}
    assert {name: (f.verdict, f.effect.split(",")[0]) for name, f in found.items()} == {
        "PhIHP on pendulum, 100 samples": ("shown", "+9.1"),
        "PhIHP on pendulum, 1000 samples": ("not shown", "+0.2"),
        "TD3-im-ph on pendulum, 100 samples": ("shown", "+9.1"),
        "TD3-im-ph on pendulum, 1000 samples": ("not shown", "+0.2"),
    }


def test_a_twin_that_has_a_prior_is_left_out(tmp_path: Path) -> None:
    make_run(tmp_path, "dd-phihp", kind="hybrid")
    folders = read_runs(tmp_path)
    assert not folders.runs
    assert "model.kind: expected 'data_driven' for dd-phihp, got 'hybrid'" in folders.problems[0]


def test_cells_of_other_episodes_are_not_compared(tmp_path: Path) -> None:
    """Each cell is of one configuration, and one of them was evaluated by another seed."""
    runs = tmp_path / "runs"
    for seed in (100, 101, 102):
        more = 0.1 * (seed - 100)
        acting = {"planner": [9.0 + more], "actor": [1.0 - more**2]}
        for samples in (100, 1000):
            config = make_run(runs, seed=seed, samples=samples, acting=acting) / "config.yaml"
            config.write_text(config.read_text() + "evaluate: {first_seed: 2000100}\n")
        make_run(runs, "td3", seed=seed, samples=300, acting={"actor": [5.0 + more]})
        acting = {"planner": [8.0 - more]}
        curve = ((2000, 1.0), (9000, 9.0))
        make_run(runs, "td-mpc", seed=seed, samples=9000, acting=acting, curve=curve)
    rows = claims_section(results(runs)).tables["Comparisons"].rows
    assert {str(row[0]): row[1] for row in rows} == {
        "1, pendulum": "mixed",
        "2, pendulum": "mixed",
        "3, pendulum": "shown",  # planner and actor of one cell
        "6, TD-MPC on pendulum": "mixed",
        "6, TD3 on pendulum": "mixed",
    }
    make(tmp_path)
    compared = [row for row in table(tmp_path, "differences") if row["seeds"] == "3, 3"]
    assert [row["p"] for row in compared] == ["mixed", "mixed"]
