"""Constants of equations that leave something out, and warnings that must not be given."""

from __future__ import annotations

import pytest
import torch

from phihp_torchrl.identification import Identification, IdentifyConfig, identify
from phihp_torchrl.identification.completeness import loosened_system
from phihp_torchrl.identification.parts import IDENTIFIED, IF_COMPLETE
from tests.identification.rigs import MASS, Mass, Undamped, make_task, record
from tests.identification.test_identify import PLAIN, UNSEEN, codes

NOISE = (1e-3, UNSEEN)


def find(system: Mass, damping: float, noise: tuple[float, float] = NOISE) -> Identification:
    log = record(Mass(), {**MASS, "damping": damping}, noise=noise, samples=1000)
    return identify(make_task(system), [log], IdentifyConfig(**PLAIN))


@pytest.fixture(scope="module")
def forgotten() -> Identification:
    return find(Undamped(), damping=1.5)


def test_constants_that_friction_moves_hold_for_complete_equations_alone(forgotten):
    gain = forgotten.constants["gain"]
    assert gain.verdict == IF_COMPLETE
    assert gain.low <= MASS["gain"] <= gain.high
    assert gain.estimate < 0.95 * MASS["gain"]  # what the verdict is about
    assert gain.high == pytest.approx(MASS["gain"], rel=0.01)  # where added terms bring it
    assert "With friction" in gain.advice
    assert "complete" in codes(forgotten)
    assert IF_COMPLETE in forgotten.table()


def test_they_are_first_guesses_that_training_may_move(forgotten):
    task = forgotten.task(make_task(Undamped()), fixed=True)
    assert not task.system.ranges["gain"].fixed


def test_a_prior_may_take_its_constants_in_turn():
    class InTurn(Mass):
        def prior(self, state, action, constants):
            gain, stiffness, damping = constants.values()
            return super().prior(
                state, action, {"gain": gain, "stiffness": stiffness, "damping": damping}
            )

    states, action = torch.rand(2, 5, 2), torch.rand(3, 1)
    loose = loosened_system(InTurn(), states, torch.arange(5.0).expand(2, 5))
    constants = {name: torch.tensor(c.guess) for name, c in loose.ranges.items()}
    found = loose.prior(states[0, :3], action, constants)
    own = {name: constants[name] for name in Mass().ranges}
    torch.testing.assert_close(found, Mass().prior(states[0, :3], action, own))  # added ones are 0


def test_friction_is_not_taken_for_a_late_command(forgotten):
    assert "white" in codes(forgotten)
    assert "delay" not in codes(forgotten)


def test_complete_equations_are_not_doubted():
    found = find(Mass(), damping=0.5)
    assert {c.verdict for c in found.constants.values()} == {IDENTIFIED}
    assert not codes(found) & {"white", "complete", "incomplete", "delay"}


def test_a_simulator_without_noise_is_no_reason_to_warn():
    found = find(Mass(), damping=0.5, noise=(0.0, 0.0))
    assert found.warnings == ()
    assert found.actuator.actuator is None
