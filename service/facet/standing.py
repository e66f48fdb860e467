"""What an admission knows besides the map, as arrays for a checkpoint: the frames of every robot,
and the scans that wait for their pose."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import astuple
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.frames import Edge, Frames, Rank, Rigid
from facet.resolution import Held, Resolution, identity_of
from facet_protocol.messages import Envelope, Rule, Scan

Arrays = Mapping[str, NDArray[Any]]
FIELDS = ("key", "schema", "encoding", "stamp_ns", "epoch", "sequence", "received_ns")


def freeze_resolution(resolution: Resolution) -> dict[str, NDArray[Any]]:
    """Frames as a table of edges over common columns; what waits as its bytes."""
    edges = [(r, e) for r, frames in resolution._frames.items() for e in frames._edges.values()]
    neighbours = [
        [robot, frame, [[e.parent, e.child] for e in near]]
        for robot, frames in resolution._frames.items()
        for frame, near in frames._neighbours.items()
    ]
    held = list(resolution._held.items())
    text = {
        "edges": [[r, e.parent, e.child, e.rank.value, e.topic] for r, e in edges],
        "neighbours": neighbours,
        "held": [[n, *_row(h.envelope)] for n, h in held],
        "number": resolution._number,
    }
    samples = [(*s.position, *s.rotation) for _, e in edges for s in e.samples]
    payloads = b"".join(bytes(h.envelope.payload) for _, h in held)
    return {
        "resolution": np.frombuffer(json.dumps(text, sort_keys=True).encode(), np.uint8),
        "lengths": np.array([(len(e.stamps), len(e.arrivals)) for _, e in edges], np.int64).reshape(
            -1, 2
        ),
        "stamps": np.array([s for _, e in edges for s in e.stamps], np.int64),
        "samples": np.array(samples, np.float64).reshape(-1, 7),
        "arrivals": np.array([s for _, e in edges for s in e.arrivals], np.int64),
        "payload_bytes": np.array([len(h.envelope.payload) for _, h in held], np.int64),
        "payloads": np.frombuffer(payloads, np.uint8),
    }


def thaw_resolution(
    resolution: Resolution, frozen: Arrays, scan_of: Callable[[Envelope], Scan]
) -> None:
    """Fill one that is new; `scan_of` decodes what waits again. Raises KeyError, TypeError,
    ValueError for anything that was not frozen."""
    text = json.loads(frozen["resolution"].tobytes())
    _thaw_frames(resolution, text, frozen)
    at, payloads = 0, frozen["payloads"].tobytes()
    for (number, *row), num_bytes in zip(
        text["held"], frozen["payload_bytes"].tolist(), strict=True
    ):
        payload, at = payloads[at : at + num_bytes], at + num_bytes
        envelope = _envelope(row, payload)
        scan = scan_of(envelope)
        resolution._held[int(number)] = Held(envelope, scan)
        resolution._by_identity[identity_of(envelope, scan)].append(int(number))
        resolution._num_bytes += num_bytes
    resolution._number = int(text["number"])


def _row(envelope: Envelope) -> list[Any]:
    """All of it but its payload."""
    rule = astuple(envelope.rule) if envelope.rule is not None else None
    return [*(getattr(envelope, name) for name in FIELDS), envelope.is_derived, rule]


def _envelope(row: list[Any], payload: bytes) -> Envelope:
    *values, is_derived, rule = row
    fields = dict(zip(FIELDS, values, strict=True))
    kept = Rule(*rule) if rule is not None else None
    return Envelope(payload=payload, is_derived=is_derived, rule=kept, **fields)


def _thaw_frames(resolution: Resolution, text: Any, frozen: Arrays) -> None:
    stamps, samples = frozen["stamps"].tolist(), frozen["samples"].tolist()
    arrivals = frozen["arrivals"].tolist()
    lengths = frozen["lengths"].tolist()
    totals = [len(stamps), len(samples), len(arrivals)]
    if totals != [sum(n for n, _ in lengths)] * 2 + [sum(m for _, m in lengths)]:
        raise ValueError(f"{len(lengths)} edges do not have {totals} stamps, samples, arrivals")
    at = at_arrival = 0
    for (robot, parent, child, rank, topic), (num, num_arrivals) in zip(
        text["edges"], lengths, strict=True
    ):
        frames = resolution._frames.setdefault(robot, Frames(resolution._wait_ns))
        frames._edges[parent, child] = Edge(
            parent,
            child,
            Rank(rank),
            topic,
            stamps[at : at + num],
            [Rigid((a, b, c), (d, e, f, g)) for a, b, c, d, e, f, g in samples[at : at + num]],
            deque(arrivals[at_arrival : at_arrival + num_arrivals]),
        )
        at, at_arrival = at + num, at_arrival + num_arrivals
    for robot, frame, names in text["neighbours"]:
        frames = resolution._frames[robot]
        frames._neighbours[frame] = [frames._edges[parent, child] for parent, child in names]
