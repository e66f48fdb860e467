"""Current poses: a dictionary in arrays, bounded, and the same after a checkpoint."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from facet.trajectory import Trajectories
from facet_protocol.messages import Pose


def pose(x: float) -> Pose:
    return Pose(np.array([x, 0.0, 1.0]), np.array([0.0, 0.0, 0.0, 1.0]))


def x_of(kept: Trajectories, source: str, sequence: int) -> float | None:
    found = kept.find(source, 1, sequence)
    return None if found is None else float(found.position[0])


@given(st.lists(st.tuples(st.booleans(), st.sampled_from("ab"), st.integers(1, 40))))
def test_it_is_a_dictionary(steps: list[tuple[bool, str, int]]) -> None:
    kept, expected = Trajectories(), {}
    for number, (is_moved, source, sequence) in enumerate(steps):
        if is_moved:
            assert kept.move({(source, 1): [(sequence, pose(number)), (50, pose(-number))]})
            expected[source, 50] = -number
        else:
            kept.note(source, 1, sequence, pose(number))
        expected[source, sequence] = number
    again = Trajectories()
    again.thaw(kept.freeze())
    for one in (kept, again):
        assert len(one) == len(expected)
        for source in "ab":
            for sequence in range(1, 51):
                assert x_of(one, source, sequence) == expected.get((source, sequence))
    assert kept.find("a", 2, 1) is None


def test_what_was_found_is_forgotten_and_what_was_given_is_not() -> None:
    kept = Trajectories(max_poses=10)
    assert kept.move({("a", 1): [(k, pose(k)) for k in (1, 2, 3)]})
    for k in range(4, 30):
        kept.note("a", 1, k, pose(k))
        assert len(kept) <= 10
    assert [x_of(kept, "a", k) for k in (1, 2, 3, 29)] == [1, 2, 3, 29]
    assert x_of(kept, "a", 4) is None
    assert not kept.move({("b", 1): [(k, pose(k)) for k in range(1, 9)]})
    assert x_of(kept, "b", 1) is None
    assert kept.move({("b", 1): [(k, pose(k)) for k in range(1, 5)]})


def test_arrays_that_do_not_fit_together_are_refused() -> None:
    kept = Trajectories()
    kept.note("a", 1, 1, pose(1.0))
    frozen = kept.freeze()
    with pytest.raises(ValueError, match="1 poses"):
        Trajectories().thaw({**frozen, "track_poses": frozen["track_poses"][:0]})
