"""A frozen map comes back as it was, goes on as it would have, and refuses what does not fit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.mapping.frozen import freeze, thaw
from facet.mapping.mapper import Mapper
from facet_protocol.maps import encode_update
from mapping_logs import log, mapped

Arrays = dict[str, NDArray[Any]]


@pytest.mark.parametrize("name", ["room-lidar3d", "room-pushbroom", "room-depth"])
def test_it_comes_back_and_goes_on(name: str) -> None:
    whole = log(name)
    half = len(whole.scans) // 2
    one = Mapper(whole.settings)
    for scan in whole.scans[:half]:
        one.insert(scan)
        one.update()
    other = thaw(freeze(one), whole.settings, one.map_id)
    assert other.digest() == one.digest()
    assert encode_update(other.snapshot()) == encode_update(one.snapshot())
    assert other.counts() == one.counts()
    other.check_invariants()
    for scan in whole.scans[half:]:
        updates = []
        for mapper in (one, other):
            mapper.insert(scan)
            updates.append(encode_update(mapper.update()))
        assert updates[0] == updates[1]
    for mapper in (one, other):
        mapper.retract(whole.scans[3])
    assert encode_update(one.update()) == encode_update(other.update())
    assert other.digest() == one.digest()
    assert other.work == one.work


def test_an_empty_map_comes_back() -> None:
    one = Mapper()
    one.update()
    other = thaw(freeze(one), one.settings, one.map_id)
    assert other.digest() == one.digest()
    scan = log("room-depth").scans[0]
    for mapper in (one, other):
        mapper.insert(scan)
        mapper.update()
    assert other.digest() == one.digest()


def test_it_shares_nothing_with_the_map() -> None:
    whole = log("room-depth")
    mapper = mapped(whole.scans[:4], whole.settings)
    arrays = freeze(mapper)
    kept = {name: array.copy() for name, array in arrays.items()}
    mapper.insert(whole.scans[5])
    mapper.update()
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, kept[name])


def test_what_waits_for_an_update_cannot_be_frozen() -> None:
    mapper = Mapper()
    mapper.insert(log("room-depth").scans[0])
    with pytest.raises(ValueError, match="wait for an update"):
        freeze(mapper)


FAULTS: dict[str, Callable[[Arrays], object]] = {
    "a column is missing": lambda a: a.pop("voxel/low"),
    "a column is short": lambda a: a.update({"voxel/middle": a["voxel/middle"][:-1]}),
    "another type": lambda a: a.update({"normal/unit": a["normal/unit"].astype(np.int64)}),
    "a voxel in no block": lambda a: a["voxel/block"].__setitem__(0, 1 << 20),
    "a voxel in no place": lambda a: a["voxel/local"].__setitem__(0, 512),
    "a block twice": lambda a: a["block/keys"].__setitem__(0, a["block/keys"][1]),
    "free space cut": lambda a: a.update({"free/counts": a["free/counts"][:-1]}),
    "ids cut": lambda a: a.update({"tile/ids": a["tile/ids"][:-1]}),
    "an id of another plane": lambda a: a["tile/ids"].__setitem__(a["tile/ids"].argmax(), 1 << 30),
    "tiles of another map": lambda a: a["tile/keys"].__setitem__(0, a["tile/keys"][0] + 1),
    "no history": lambda a: a.pop("history"),
    "a history of nonsense": lambda a: a.update({"history": np.frombuffer(b"{]", np.uint8)}),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_does_not_fit_is_refused(fault: str) -> None:
    whole = log("room-depth")
    mapper = mapped(whole.scans[:4], whole.settings)
    arrays = freeze(mapper)
    FAULTS[fault](arrays)
    with pytest.raises(ValueError, match=r"."):
        thaw(arrays, mapper.settings, mapper.map_id)
