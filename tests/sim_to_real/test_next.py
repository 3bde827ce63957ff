"""What looks the same, and the least that shows."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from noise_model.fit import Parameter
from sim_to_real.next import not_resolvable, own_signatures, smallest
from sim_to_real.quadratic import N_EFFECTIVE
from sim_to_real.screen import Screened

N = 400
RNG = np.random.default_rng(7)
A, B, C, NUISANCE = RNG.standard_normal((4, N))


def screened(name, *columns, place=("height_mm", 0.5)):
    return Screened(name, 1.0, {}, np.column_stack(columns), place)


def baseline(jacobian):
    parameters = tuple(Parameter(f"n{i}", "", 0.0) for i in range(jacobian.shape[1]))
    return SimpleNamespace(quadratic=SimpleNamespace(parameters=parameters), jacobian=jacobian)


def test_nuisances_are_projected_out():
    signatures = own_signatures(baseline(NUISANCE[:, None]), [screened("arc_length", A + 50.0 * NUISANCE)])
    assert abs(signatures["arc_length"][:N, 0] @ NUISANCE) < 1e-6 * N
    expected = A - NUISANCE * (A @ NUISANCE) / (NUISANCE @ NUISANCE)
    np.testing.assert_allclose(signatures["arc_length"][:N, 0], expected, atol=1e-6)


def test_effects_that_a_nuisance_makes_alike_are_a_pair():
    looked = [
        screened("arc_length", A),
        screened("arc_radius", -2.0 * A + 30.0 * NUISANCE),
        screened("gamma", B),
    ]
    signatures = own_signatures(baseline(NUISANCE[:, None]), looked)
    assert not_resolvable(signatures) == (("arc_length", "arc_radius"),)


def test_one_that_lies_within_the_span_of_another_cannot_be_told_from_it():
    looked = [screened("arc_length", A + B), screened("hand_eye", A, B), screened("gamma", C)]
    signatures = own_signatures(baseline(NUISANCE[:, None]), looked)
    assert not_resolvable(signatures) == (("arc_length", "hand_eye"),)


def test_the_least_that_shows_outweighs_what_its_parameter_costs():
    one = screened("arc_length", A)
    signatures = own_signatures(baseline(np.zeros((N, 1))), [one])
    least = smallest(signatures, [one])["arc_length"]
    added = (least.value / 0.5) ** 2 * float(A @ A) / N
    assert 0.5 * N_EFFECTIVE * math.log1p(added) == pytest.approx(3.0 + 0.5 * math.log(N_EFFECTIVE))
    assert least.unit == "mm"
