"""Sine, cosine and fans, against libm."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from facet_protocol.projection import (
    KEPT_BEAMS,
    MAX_ANGLE,
    count_ignored,
    fan_angles,
    fan_directions,
    project_fan,
    sin_cos,
)

PINNED_SINES = [
    "0x0.0p+0",
    "0x1.eaee8744b05f0p-2",
    "-0x1.aed548f090ceep-1",
    "0x1.d18f6ead1b445p-1",
    "0x1.210386db6d55bp-3",
    "0x1.1e1f18ab0a2c0p-2",
]
PINNED_COSINES = [
    "0x1.0000000000000p+0",
    "0x1.c1528065b7d50p-1",
    "0x1.14a280fb5068cp-1",
    "-0x1.aa22657537205p-2",
    "-0x1.fae04be85e5d2p-1",
    "0x1.eb9b7097822f6p-1",
]


@pytest.mark.parametrize("turns", [1.0, 100.0])
def test_sine_and_cosine_are_those_of_libm(turns: float) -> None:
    limit = 2.0 * np.pi * turns
    assert limit < MAX_ANGLE
    quarters = np.arange(-8, 9) * (np.pi / 4.0)
    angles = np.concatenate([np.linspace(-limit, limit, 100_001), quarters])
    sine, cosine = sin_cos(angles)
    assert np.abs(sine - np.sin(angles)).max() < 1e-15
    assert np.abs(cosine - np.cos(angles)).max() < 1e-15


def test_the_bits_are_pinned() -> None:
    """What every machine must give: changing a constant changes the map's digest."""
    sine, cosine = sin_cos([0.0, 0.5, -1.0, 2.0, 3.0, -6.0])
    assert [x.hex() for x in sine.tolist()] == PINNED_SINES
    assert [x.hex() for x in cosine.tolist()] == PINNED_COSINES


@given(st.floats(-MAX_ANGLE, MAX_ANGLE), st.floats(-MAX_ANGLE, MAX_ANGLE), st.integers(0, 9))
def test_one_angle_gives_one_value_wherever_it_stands(a: float, b: float, shift: int) -> None:
    """Vectorised loops have tails: an element must not depend on its place."""
    alone = sin_cos(a)
    among = sin_cos(np.array([b] * shift + [a] + [b] * (9 - shift)))
    assert float(alone[0]) == float(among[0][shift])
    assert float(alone[1]) == float(among[1][shift])


def test_angles_include_both_ends() -> None:
    assert fan_angles(-1.0, 1.0, 5).tolist() == [-1.0, -0.5, 0.0, 0.5, 1.0]
    assert fan_angles(0.25, 9.0, 1).tolist() == [0.25]
    assert fan_angles(0.25, 9.0, 0).tolist() == []


def test_beams_are_points_empty_ends_or_nothing() -> None:
    ranges = [2.0, np.inf, np.nan, 0.0, -1.0, -np.inf, 4.0]
    points, no_return = project_fan(0.0, 3.0, ranges, reach_m=8.0)
    assert points.dtype == no_return.dtype == np.float32
    np.testing.assert_allclose(points, [[2, 0, 0], [4 * np.cos(3), 4 * np.sin(3), 0]], atol=1e-6)
    np.testing.assert_allclose(no_return, [[8 * np.cos(0.5), 8 * np.sin(0.5), 0]], atol=1e-6)
    assert count_ignored(ranges) == {"nan": 1, "not_positive": 3}
    assert count_ignored([1.0, np.inf]) == {}


def test_no_beams_give_no_points() -> None:
    points, no_return = project_fan(0.0, 1.0, [], reach_m=8.0)
    assert points.shape == no_return.shape == (0, 3)


def test_a_range_beyond_float32_is_infinite_and_quiet() -> None:
    points, _ = project_fan(0.5, 0.5, [1e300], reach_m=8.0)
    assert np.isinf(points[0, :2]).all()


@pytest.mark.parametrize("num", [0, 1, 361, KEPT_BEAMS, KEPT_BEAMS + 1])
def test_directions_that_are_kept_are_the_same(num: int) -> None:
    told = sin_cos(fan_angles(-2.0, 2.5, num))
    for _ in range(2):
        for one, other in zip(fan_directions(-2.0, 2.5, num), told, strict=True):
            assert one.tobytes() == other.tobytes()
            assert num > KEPT_BEAMS or not one.flags.writeable
