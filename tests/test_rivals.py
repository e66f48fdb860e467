"""Several scans under one number: the payload with the smaller hash is in the map, whatever came
first, live as in the replay, after corrections and across a resume."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from facet import rivals
from facet.__main__ import app
from facet.commands.replay import replay_log
from facet.config import Config, load_config
from facet.mapping.mapper import Mapper
from facet.past import Number, Past
from facet.resume import resume
from facet.rivals import Claim, Recent, Rivals, Verdict
from facet.sinks.log_file import write_recording
from facet.sources.recording import Recording, is_replayed
from facet_protocol import topics
from facet_protocol.codec import decode
from facet_protocol.messages import Conflict, Envelope, Pose, ProtocolError, Scan
from rig import scan_envelope
from test_corrections import CorrectedLine, correction, digest_of, pose, small
from test_resume import METADATA, SETTINGS, config, told

SOURCE = "r1/lidar"


def other(sequence: int, variant: int, robot: str = "r1") -> Scan:
    """Another scan of the same number: fewer points, another pose; the same stamp."""
    scan = small(sequence, robot)
    return replace(scan, points=scan.points[variant::2], pose=pose(0.05 * variant, 0.03, 0.01))


def digest(scan: Scan) -> bytes:
    return hashlib.sha256(scan_envelope(scan).payload).digest()


def winner(scans: Iterable[Scan]) -> Scan:
    return min(scans, key=digest)


def rival_pair(sequence: int) -> tuple[Scan, Scan]:
    """(the one that wins, the one that loses)."""
    first, second = sorted((other(sequence, 1), other(sequence, 2)), key=digest)
    return first, second


def put(line: CorrectedLine, *scans: Scan) -> None:
    line.scans(*map(scan_envelope, scans))


def account_of(line: CorrectedLine) -> Any:
    return line.pipeline._account


@settings(
    max_examples=12,
    deadline=None,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=list(HealthCheck),
)
@given(data=st.data())
def test_whatever_comes_first(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Rivals, copies and corrections in any order and any batches, with kills in between: the map
    is that of the winners, the replay says the same at every update, and any other order of the
    scans gives the same map."""
    folder = tmp_path_factory.mktemp("log")
    line = CorrectedLine(folder)
    drawn = data.draw(
        st.lists(st.tuples(st.integers(1, 4), st.integers(1, 3)), min_size=2, max_size=10)
    )
    came: dict[int, list[Scan]] = {}
    moved: dict[int, Pose] = {}
    messages: list[Envelope] = []
    batch: list[Envelope] = []

    def flush() -> None:
        line.apply(line.record(batch))
        if line.pipeline.is_stale:
            line.pipeline.update()
        messages.extend(batch)
        batch.clear()

    for sequence, variant in drawn:
        came.setdefault(sequence, []).append(other(sequence, variant))
        batch.append(scan_envelope(came[sequence][-1]))
        if data.draw(st.booleans()):
            flush()
        if not data.draw(st.integers(0, 3)):
            flush()
            k = data.draw(st.sampled_from(sorted(came)))
            moved[k] = pose(0.2 + 0.01 * len(messages))
            batch.append(correction({k: moved[k]}, 1 + len(messages)))
            flush()
        if not data.draw(st.integers(0, 4)):
            flush()
            line.checkpoint()
            line.recorder.commit()
            line = CorrectedLine(folder, resume(config(folder), Mapper(SETTINGS)))
            assert line.admission.past._segments
    flush()
    put(line, small(9))  # a log may end with what changes nothing: the replay updates after it
    came[9] = [small(9)]
    messages.append(scan_envelope(small(9)))
    best = [winner(scans) for scans in came.values()]
    best = [replace(s, pose=moved.get(s.sequence, s.pose)) for s in best]
    assert line.mapper.digest() == digest_of(best)
    line.recorder.close()
    assert told(replay_log([folder], Config()).mapper) == told(line.mapper)
    scans = [e for e in messages if e.key == topics.scan_key("map", "r1", "lidar")]
    shuffled = [*data.draw(st.permutations(scans)), *(e for e in messages if e not in scans)]
    write_recording(folder / "other" / "a.mcap", shuffled, METADATA)
    assert replay_log([folder / "other"], Config()).mapper.digest() == line.mapper.digest()


def test_the_log_says_which_is_kept(tmp_path: Path) -> None:
    best, worst = rival_pair(1)
    line = CorrectedLine(tmp_path)
    put(line, worst, best)
    put(line, worst)
    line.recorder.close()
    records = [decode(e) for e in Recording([tmp_path]) if e.key == topics.CONFLICT_TOPIC]
    assert [(r.kept, r.left_out, r.replaced) for r in records if isinstance(r, Conflict)] == [
        (digest(best), digest(worst), True),
        (digest(best), digest(worst), False),
    ]
    account = account_of(line)
    assert account[f"conflict[{SOURCE}]"] == 2
    assert account["applied"] == 1
    assert account["duplicate"] == 0
    result = CliRunner().invoke(app, ["info", str(tmp_path)])
    said = "2 times a number came with other bytes: 1 took the place of the scan before"
    assert said in " ".join(result.output.split())


def test_replaced_while_an_update_was_under_way(tmp_path: Path) -> None:
    """The rival lies before the cut of an update that does not know it yet; stamps are equal, so
    that only the record tells the two apart. The replay updates at the same places."""
    best, worst = rival_pair(2)
    line = CorrectedLine(tmp_path)
    put(line, small(1))
    first = line.record([scan_envelope(worst), scan_envelope(small(3))])
    late = line.record([scan_envelope(best)])
    line.apply(first)
    line.pipeline.update()
    line.apply(late)
    line.pipeline.update()
    put(line, small(4))
    line.recorder.close()
    assert told(replay_log([tmp_path], Config()).mapper) == told(line.mapper)


def test_killed_before_the_record_of_it_was_written(tmp_path: Path) -> None:
    best, worst = rival_pair(2)
    line = CorrectedLine(tmp_path)
    put(line, small(1), worst)
    line.record([scan_envelope(small(3)), scan_envelope(best)])  # durable, and then it is killed
    again = CorrectedLine(tmp_path, resume(config(tmp_path), Mapper(SETTINGS)))
    again.pipeline.update()
    put(again, small(4))
    assert again.mapper.digest() == digest_of([small(1), best, small(3), small(4)])
    again.recorder.close()
    assert told(replay_log([tmp_path], Config()).mapper) == told(again.mapper)


@pytest.mark.parametrize("window_bytes", [0, 1 << 20], ids=["from the log", "from memory"])
def test_what_has_to_go_is_found(tmp_path: Path, window_bytes: int) -> None:
    best, worst = rival_pair(1)
    line = CorrectedLine(tmp_path, max_file_bytes=30_000)
    line.admission._placement._rivals._window_bytes = window_bytes
    put(line, worst)
    for k in range(2, 6):
        put(line, small(k))
    put(line, best)
    assert line.mapper.digest() == digest_of([best, *(small(k) for k in range(2, 6))])


def test_when_the_log_is_gone_the_first_stays(tmp_path: Path) -> None:
    best, worst = rival_pair(1)
    line = CorrectedLine(tmp_path)
    line.admission._placement._rivals._window_bytes = 0
    put(line, worst)
    line.admission.past._files[0] = tmp_path / "moved-away.mcap"
    account_of(line).arrive(SOURCE)
    line.apply([scan_envelope(best)])
    assert account_of(line)["rejected.unreadable_log"] == 1
    line.pipeline.update()
    assert line.mapper.digest() == digest_of([worst])


def test_beyond_the_horizon_the_first_stays_and_it_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever comes so late; other sources have a horizon of their own."""
    monkeypatch.setattr(rivals, "HORIZON", 64)
    best, worst = rival_pair(1)
    line = CorrectedLine(tmp_path)
    thin = [replace(small(k), points=small(k).points[:9]) for k in range(2, 66)]
    put(line, worst, *(replace(s, robot="r2") for s in thin))
    put(line, *thin[:62], best, thin[62])  # in time
    put(line, thin[63])
    assert account_of(line)[f"conflict[{SOURCE}]"] == 1
    put(line, worst, best, small(70))
    assert account_of(line)[f"late_duplicate[{SOURCE}]"] == 2
    assert account_of(line)["conflict"] == 1
    said = [m for m in caplog.messages if m.startswith(f"{SOURCE}: late_duplicate: ")]
    assert len(said) == 1
    expected = digest_of([best, *thin, small(70), *(replace(s, robot="r2") for s in thin)])
    assert line.mapper.digest().state == expected.state
    line.recorder.close()
    assert told(replay_log([tmp_path], Config()).mapper) == told(line.mapper)
    # what was replaced is known for good: a correction finds the one that is in the map
    again = CorrectedLine(tmp_path, resume(config(tmp_path), Mapper(SETTINGS)))
    again.scans(correction({1: pose(0.4)}))
    moved = replace(best, pose=pose(0.4))
    expected = digest_of([moved, *thin, small(70), *(replace(s, robot="r2") for s in thin)])
    assert again.mapper.digest().state == expected.state


@pytest.fixture
def short_window(monkeypatch: pytest.MonkeyPatch) -> None:
    """All numbers are old as soon as another scan has come, for whoever is made from now on."""
    monkeypatch.setitem(Rivals.__init__.__kwdefaults__, "window_bytes", 1)
    monkeypatch.setattr(rivals, "FAR_EVERY", 3)


@pytest.mark.usefixtures("short_window")
def test_for_old_rivals_the_log_is_read_now_and_then_only(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It takes the mapper long: one robot's old numbers, sent again with other bytes, would stop it
    for all. Copies of what came first are not asked about."""
    line = CorrectedLine(tmp_path)
    reads: list[Number] = []
    read = line.admission.past.read
    line.admission.past.read = lambda wanted: reads.extend(wanted) or read(wanted)  # type: ignore[method-assign, func-returns-value]
    pairs = {k: rival_pair(k) for k in (1, 2, 3)}
    put(line, *(worst for _, worst in pairs.values()))
    for k, (best, worst) in pairs.items():
        put(line, best, worst)
        assert [number.sequence for number in reads] == [1], k
    put(line, *(replace(small(k), robot="r2") for k in range(1, 8)))  # another's change nothing
    put(line, pairs[2][0])
    assert account_of(line)[f"late_duplicate[{SOURCE}]"] == 3
    put(line, *(small(k) for k in (4, 5, 6)), pairs[2][0])
    assert [number.sequence for number in reads] == [1, 2]
    others = [replace(small(k), robot="r2") for k in range(1, 8)]
    kept = [pairs[1][0], pairs[2][0], pairs[3][1], *(small(k) for k in (4, 5, 6)), *others]
    assert line.mapper.digest() == digest_of(kept)
    assert len([m for m in caplog.messages if f"{SOURCE}: late_duplicate: " in m]) == 1
    line.recorder.close()
    assert told(replay_log([tmp_path], Config()).mapper) == told(line.mapper)


@pytest.mark.usefixtures("short_window")
@pytest.mark.parametrize("seed", range(6))
def test_old_rivals_live_resumed_and_replayed(tmp_path: Path, seed: int) -> None:
    """Which of them are late is told by the log: the same after a kill, and in the replay."""
    draw = random.Random(seed)
    line, num_late, waiting = CorrectedLine(tmp_path), 0, list[Envelope]()
    for number in range(1, 40):
        scan = other(draw.randint(1, 1 + number // 2), draw.randint(1, 3))
        waiting.append(scan_envelope(scan))
        if draw.random() < 0.5:
            line.scans(*waiting)
            waiting.clear()
        if draw.random() < 0.1:
            num_late += account_of(line)["late_duplicate"]
            line.checkpoint()
            line.recorder.commit()
            line = CorrectedLine(tmp_path, resume(config(tmp_path), Mapper(SETTINGS)))
    put(line, small(90))
    assert num_late + account_of(line)["late_duplicate"] > 0
    line.recorder.close()
    replayed = replay_log([tmp_path], Config())
    assert told(replayed.mapper) == told(line.mapper)


def test_without_room_to_remember_it_the_first_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rivals, "MAX_CHOSEN", 1)
    line = CorrectedLine(tmp_path)
    for k in (1, 2):
        best, worst = rival_pair(k)
        put(line, worst, best)
    assert account_of(line)["rejected.too_many_conflicts"] == 1
    assert line.mapper.digest() == digest_of([rival_pair(1)[0], rival_pair(2)[1]])


def test_a_refused_scan_is_not_taken_out_by_a_correction(tmp_path: Path) -> None:
    """It has a number, and it is in the log, but never was in the map."""
    jump = replace(small(2), pose=Pose(np.array([9.0, 0.0, 1.2]), small(2).pose.orientation_xyzw))
    jump = replace(jump, stamp_ns=small(1).stamp_ns + 1)
    overrides = {"record.directory": tmp_path, "mapping.voxel_m": 0.1, "robots.reject_jumps": True}
    line = CorrectedLine(tmp_path, resume(load_config(None, overrides), Mapper(SETTINGS)))
    put(line, small(1), jump)
    line.scans(correction({1: pose(0.1), 2: pose(0.2)}))
    account = account_of(line)
    assert (account["rejected.pose_jump"], account["rejected.unknown_scan"]) == (1, 1)
    assert line.mapper.digest() == digest_of([small(1)])
    good = replace(other(2, 1), stamp_ns=jump.stamp_ns)  # the number is free for another
    put(line, good)
    line.scans(correction({2: pose(0.2)}, 2))
    assert line.mapper.digest() == digest_of([small(1), replace(good, pose=pose(0.2))])


def claim(sequence: int, text: str) -> Claim:
    return Claim(Number(SOURCE, 5, sequence), hashlib.sha256(text.encode()).digest())


def test_recent_is_a_ring(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rivals, "HORIZON", 128)
    recent = Recent()
    for k in range(1, 1000):
        recent.add(k % 3, k, bytes([k % 256]) * 32)
        assert len(recent.numbers) <= rivals.HORIZON
        known = [j for j in range(max(1, k - 130), k + 1) if recent.find(j % 3, j) is not None]
        assert known == list(range(max(1, k - rivals.HORIZON + 1), k + 1))
    assert recent.find(0, 999) is not None
    assert recent.find(1, 999) is None
    columns = recent.columns()
    assert columns[0][:, 1].tolist() == list(range(1000 - rivals.HORIZON, 1000))
    again = Recent.of(columns)
    for one in (recent, again):
        one.add(1, 1000, bytes(32))
        assert one.find(*(int(n) for n in columns[0][0])) is None
    assert [c.tobytes() for c in again.columns()] == [c.tobytes() for c in recent.columns()]


def test_no_more_than_so_many_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rivals, "MAX_SOURCES", 3)
    one = Rivals(Past())
    for k in (1, 2, 3, 1, 4):
        one.meet(Claim(Number(f"r{k}/a", 5, k), bytes(32)), is_first=k != 1 or not one._recent)
        one._recent.move_to_end(f"r{k}/a")
    assert list(one._recent) == ["r3/a", "r1/a", "r4/a"]
    assert one.meet(Claim(Number("r2/a", 5, 2), bytes(32)), is_first=False) is Verdict.LATE


def test_the_window_is_bounded() -> None:
    one = Rivals(Past(), window_bytes=1000)
    for k in range(1, 50):
        payload = bytes([k]) * 90
        mine = claim(k, "")._replace(digest=hashlib.sha256(payload).digest())
        one.meet(mine, is_first=True)
        one.place(mine, Envelope("k", "s", "protobuf", memoryview(payload), sequence=k))
        assert sum(len(e.payload) for e in one._window.values()) == one._num_bytes <= 1000
    assert isinstance(one.find(mine.number, mine.digest).payload, bytes)
    with pytest.raises(ProtocolError, match="not found in the log"):
        one.find(Number(SOURCE, 5, 1), bytes(32))


def test_what_is_frozen_is_all_of_it() -> None:
    one = Rivals(Past())
    for k in range(1, 100):
        one.meet(claim(k, "b"), is_first=True)
        one.place(claim(k, "b"), Envelope("k", "s", "protobuf", b""))
    lower, higher = sorted((claim(7, "b"), claim(7, "c")), key=lambda c: c.digest)
    one.meet(claim(200, "x"), is_first=True)
    one.refuse(Number(SOURCE, 5, 200))
    if lower == claim(7, "c"):
        one.place(lower, Envelope("k", "s", "protobuf", b""))
    other_one = Rivals(Past())
    other_one.thaw({name: np.array(column) for name, column in one.freeze().items()})
    for a, b in zip(one.freeze().values(), other_one.freeze().values(), strict=True):
        assert a.tobytes() == b.tobytes()
    assert other_one.judge(lower) is Verdict.DUPLICATE
    assert other_one.judge(higher) is Verdict.LOSES
    with pytest.raises(ProtocolError, match="not in the map"):
        other_one.in_map(Number(SOURCE, 5, 200))
    with pytest.raises(ValueError, match="scans in"):
        Rivals(Past()).thaw({**one.freeze(), "rival_placed": np.zeros(0, np.bool_)})


def test_the_record_is_read_again(tmp_path: Path) -> None:
    """Of the replay's input, for it says where an update ended; no input itself."""
    best, worst = rival_pair(1)
    line = CorrectedLine(tmp_path)
    put(line, worst, best)
    line.recorder.close()
    kept = [e for e in Recording([tmp_path]) if is_replayed(e)]
    assert sum(e.key == topics.CONFLICT_TOPIC for e in kept) == 1
    replayed = replay_log([tmp_path], Config())
    assert replayed.account.balance().received == 2
    assert replayed.account.balance().is_exact
    assert replayed.account["conflict"] == 1
