import math

import numpy as np
import pytest

from sim.control.transforms import inverse_clarke, inverse_park, park
from sim.observers.transforms import clarke


@pytest.mark.parametrize("theta", np.linspace(-4, 4, 9))
def test_park_and_clarke_have_their_inverses(theta):
    cos, sin = math.cos(theta), math.sin(theta)
    assert inverse_park(*park(1.5, -0.5, cos, sin), cos, sin) == pytest.approx((1.5, -0.5))
    assert clarke(*inverse_clarke(1.5, -0.5)) == pytest.approx((1.5, -0.5))
    assert sum(inverse_clarke(1.5, -0.5)) == pytest.approx(0, abs=1e-15)


def test_the_q_axis_leads_the_d_axis_and_d_is_the_rotor_angle():
    theta = 0.7
    rotor = math.cos(theta), math.sin(theta)
    assert park(*rotor, *rotor) == pytest.approx((1.0, 0.0), abs=1e-15)
    assert park(-rotor[1], rotor[0], *rotor) == pytest.approx((0.0, 1.0), abs=1e-15)
