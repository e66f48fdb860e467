"""The command: what each answers, its exit code, and one whole run in processes of their own."""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import zenoh
from typer.testing import CliRunner

from facet import __version__
from facet.__main__ import _said, app
from facet.commands.demo import MARK, _is_alive, _make_room
from facet.commands.imports import _nanoseconds, _read_npz, _read_poses
from facet.commands.replay import replay_log
from facet.commands.settings import load_loops
from facet.commands.terminal import InputError
from facet.config import Config
from facet.session import client_settings, open_session
from facet.sinks.layout import GAUGES
from facet.sinks.log_file import write_recording
from facet.sources.recording import Recording
from facet_protocol.codec import decode
from facet_protocol.messages import Scan
from facet_protocol.topics import alive_key
from rig import WAIT_S, free_endpoint, patient, room, wait_until

COMMANDS = (
    *("run", "play", "status", "top", "cmd", "replay", "simulate"),
    *("export", "info", "digest", "recover", "config", "demo", "import"),
)
RECORDINGS = Path(__file__).parents[1] / "recordings"
BUNDLED = RECORDINGS / "office-pushbroom.mcap"
DATA = Path(__file__).parents[2] / "shared" / "data"


def facet(*arguments: object, code: int = 0) -> str:
    """The output of a command run in this process."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == code, result.output + repr(result.exception)
    return result.output


def refused(*arguments: object) -> str:
    """Why a command run in this process does not take what it was given."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert isinstance(result.exception, InputError), result.output + repr(result.exception)
    return str(result.exception)


def process(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "facet", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def hashes(output: str) -> dict[str, str]:
    lines = (line.split() for line in output.splitlines())
    return {words[0]: words[1] for words in lines if words and words[0] in ("state", "derived")}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "room.mcap"
    write_recording(path, room(6), {"map": "room", "frame": "map"})
    return path


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str) -> None:
    text = facet(command, "--help")
    assert f"  facet {command}" in text  # an example


def test_the_readme_names_every_command_and_no_option_that_is_not_there() -> None:
    text = (Path(__file__).parents[1] / "README.md").read_text("utf-8")
    told = [words.split() for words in re.findall(r"`facet ([a-z][^`]*)`", text)]
    assert {words[0] for words in told} == set(COMMANDS)
    for command, *words in told:
        options = {word.rstrip(",") for word in words if word.startswith("--")}
        said = facet(command, "--help")
        assert {option for option in options if f"{option} " not in said} == set(), command


def test_no_summary_of_a_command_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert "..." not in facet("--help").partition("Commands:")[2]


def test_version() -> None:
    assert facet("--version").strip() == f"facet {__version__}"


def test_replay_gives_the_map_its_report_and_its_files(log: Path, tmp_path: Path) -> None:
    text = facet("replay", log, "--voxel", 0.1, "--out", tmp_path / "out", "--report")
    assert "27,000" in text  # points
    assert "detail level" in text
    model = json.loads((tmp_path / "out" / "model.json").read_text())
    assert model["map"]["id"] == "room"
    assert model["settings"]["voxel_m"] == 0.1
    assert hashes(text) == model["digest"]
    assert (tmp_path / "out" / "picture.png").stat().st_size > 1000


def test_two_replays_write_the_same_updates(log: Path, tmp_path: Path) -> None:
    written = []
    for name in ("a.mcap", "b.mcap"):
        facet("replay", log, "--voxel", 0.1, "--updates", tmp_path / name)
        written.append((tmp_path / name).read_bytes())
    assert written[0] == written[1]


@pytest.mark.parametrize("every", ["log", "0.1", "end"])
def test_the_map_does_not_depend_on_the_cuts(log: Path, every: str) -> None:
    text = facet("replay", log, "--voxel", 0.1, "--update-every", every)
    once = facet("replay", log, "--voxel", 0.1, "--update-every", "end")
    assert hashes(text) == hashes(once)


def test_digest_of_a_log_and_of_its_model(log: Path, tmp_path: Path) -> None:
    facet("replay", log, "--out", tmp_path)
    of_log, of_model = facet("digest", log), facet("digest", tmp_path / "model.json")
    assert hashes(of_log)["derived"] == hashes(of_model)["derived"]
    model = json.loads((tmp_path / "model.json").read_text())
    model["planes"][0]["d"] += 1e-9
    (tmp_path / "model.json").write_text(json.dumps(model))
    facet("digest", tmp_path / "model.json", code=65)


def test_a_cut_off_log_is_replayed_and_said_to_be_cut_off(log: Path) -> None:
    whole = log.read_bytes()
    log.write_bytes(whole[: len(whole) - 40])
    text = facet("replay", log, "--voxel", 0.1, code=3)
    assert "cut off" in text
    assert "cut off" in facet("info", log, code=3)


def test_what_is_left_out_is_counted(log: Path) -> None:
    scans = room(6)
    scans[2] = replace(scans[2], payload=b"\x01\x02")
    write_recording(log, scans, {})
    text = facet("replay", log, "--voxel", 0.1, code=3)
    assert "1 malformed" in text
    last = "mapped 5 of 6 scans recorded (83.3 %), missing from the log 0"
    assert text.splitlines()[-1] == last
    del scans[3]
    write_recording(log, scans, {})
    assert "missing from the log 1" in facet("replay", log, "--voxel", 0.1, code=3)


def test_two_maps_in_one_folder_are_not_made_one(log: Path, tmp_path: Path) -> None:
    write_recording(tmp_path / "hall.mcap", room(2), {"map": "hall", "frame": "map"})
    with pytest.raises(InputError, match=r"logs of 2 maps, hall, room: name the files of one"):
        replay_log([tmp_path], Config())
    assert replay_log([log], Config()).num_scans == 6


def test_millimetres_are_noticed(log: Path, tmp_path: Path) -> None:
    assert "metres" not in facet("replay", log, "--voxel", 0.1)
    scans = scans_of(log)
    np.savez(
        tmp_path / "mm.npz",
        stamp_ns=np.array([scan.stamp_ns for scan in scans]),
        T_world_sensor=np.stack([np.eye(4)] * len(scans)),
        points=1000.0 * np.concatenate([scan.points for scan in scans]),
        lengths=np.array([len(scan.points) for scan in scans]),
    )
    facet("import", tmp_path / "mm.npz", tmp_path / "mm.mcap")
    text = facet("replay", tmp_path / "mm.mcap", "--voxel", 0.1)
    assert "most points were left out" in text
    assert "are they in metres?" in text


def test_info(log: Path, tmp_path: Path) -> None:
    text = facet("info", log)
    assert "r1/lidar" in text
    assert "foxglove.PointCloud" in text
    facet("replay", log, "--out", tmp_path)
    assert "floor" in facet("info", tmp_path / "model.json")


@pytest.mark.parametrize("command", ["replay", "digest", "export"])
def test_who_waits_for_the_compiler_is_told(
    command: str, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def compile_slowly(settings: object) -> None:
        wait_until(lambda: not any(isinstance(t, threading.Timer) for t in threading.enumerate()))

    monkeypatch.setattr("facet.warmup.warm_up", compile_slowly)
    monkeypatch.setattr("facet.commands.terminal.PATIENCE_S", 0.0)
    load_loops.cache_clear()
    more = [tmp_path / "a.glb"] if command == "export" else []
    text = facet(command, log, *more)
    load_loops.cache_clear()
    assert "compiling the mapper's loops" in text
    monkeypatch.undo()
    assert "compiling" not in facet(command, log, *more)  # they are there


@pytest.mark.parametrize("path", sorted(RECORDINGS.glob("*.mcap")), ids=lambda path: path.stem)
def test_the_bundled_recordings_are_whole(path: Path) -> None:
    """And what the table says: `make recordings` has made them since logs became what they are."""
    facet("info", path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert digest in (path.parent / "README.md").read_text("utf-8")


def test_export_from_a_log_and_from_a_model(log: Path, tmp_path: Path) -> None:
    facet("export", log, tmp_path / "points.ply")
    facet("export", log, tmp_path / "model.json")
    facet("export", tmp_path / "model.json", tmp_path / "rooms.glb")
    assert (tmp_path / "rooms.glb").read_bytes().startswith(b"glTF")
    assert (tmp_path / "points.ply").read_bytes().startswith(b"ply")


def test_simulate_writes_scans_and_their_truth(tmp_path: Path) -> None:
    out = tmp_path / "s.mcap"
    facet("simulate", out, "--scene", "corridor", "--duration", 0.2, "--robot", "r7")
    assert {e.key for e in Recording([out])} == {"facet/v1/map/robot/r7/scan/pushbroom"}
    truth = json.loads((tmp_path / "s.truth.json").read_text())
    assert truth["scene"] == "corridor"
    made_by = "facet simulate s.mcap --scene corridor --duration 0.2 --robot r7"
    assert made_by in facet("info", out)


def test_a_recording_that_is_stopped_leaves_nothing_behind(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "facet", "simulate", str(tmp_path / "s.mcap")]
    with subprocess.Popen([*command, "--sensor", "lidar3d"]) as process:
        wait_until(lambda: any(tmp_path.iterdir()))
        process.terminate()
        assert process.wait(WAIT_S) == 128 + signal.SIGTERM
    assert not any(tmp_path.iterdir())


def scans_of(path: Path) -> list[Scan]:
    return [scan for e in Recording([path]) if isinstance(scan := decode(e), Scan)]


def test_import_npz(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(30, 3)).astype(np.float32)
    turn = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    np.savez(
        tmp_path / "a.npz",
        stamp_ns=np.array([5, 9]),
        T_world_sensor=np.stack([np.eye(4), turn]),
        points=points,
        lengths=np.array([10, 20]),
    )
    facet("import", tmp_path / "a.npz", tmp_path / "a.mcap")
    first, second = scans_of(tmp_path / "a.mcap")
    assert np.array_equal(first.points, points[:10])
    assert np.array_equal(second.points, points[10:])
    assert (first.stamp_ns, second.stamp_ns) == (5, 9)
    assert second.pose.position.tolist() == [1, 2, 3]
    half = np.sqrt(0.5)
    assert np.allclose(second.pose.orientation_xyzw, [0, 0, half, half])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"T_world_sensor": np.zeros((2, 4, 4))}, r"T_world_sensor\[0\] is no rotation"),
        ({"T_world_sensor": np.stack([np.eye(4), 1000 * np.eye(4)])}, r"\[1\] is no rotation"),
        ({"T_world_sensor": np.diag([-1.0, 1, 1, 1])[None].repeat(2, 0)}, "is no rotation"),
        ({"lengths": np.array([10, 21])}, r"sum to 31, points \(30, 3\)"),
        ({"points": np.zeros((30, 2))}, r"points \(30, 2\)"),
        ({"lengths": np.array([10.0, 20.0])}, "lengths whole ones"),
        ({"stamp_ns": np.array(["5", "9"])}, "stamp_ns and T_world_sensor need numbers"),
        ({"stamp_ns": np.array([5, -9])}, "stamp_ns -9 lies before 1970"),
        ({"stamp_ns": None}, "stamp_ns .* needed are stamp_ns, T_world_sensor, points, lengths"),
    ],
)
def test_an_npz_that_does_not_fit_is_named(
    tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    arrays = {
        "stamp_ns": np.array([5, 9]),
        "T_world_sensor": np.stack([np.eye(4), np.eye(4)]),
        "points": np.zeros((30, 3)),
        "lengths": np.array([10, 20]),
    } | change
    np.savez(tmp_path / "a.npz", **{k: v for k, v in arrays.items() if v is not None})
    with pytest.raises(InputError, match=said):
        _read_npz(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["a.npz", "a.ply"])
def test_what_is_not_what_its_name_says(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"\xa3\x80\xff" * 100)
    text = refused("import", tmp_path / name, tmp_path / "a.mcap")
    assert name in text
    assert re.search(r"not an? \.(npz|ply) file", text)
    np.savez(tmp_path / "whole.npz", a=np.zeros(1000))
    whole = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    assert "not an .npz file" in refused("import", tmp_path / "cut.npz", tmp_path / "a.mcap")


def test_a_log_without_a_scan_is_no_empty_map_in_silence(tmp_path: Path) -> None:
    write_recording(tmp_path / "a.mcap", [replace(room(1)[0], schema="foxglove.Log")], {})
    assert "`facet info` lists" in refused("replay", tmp_path / "a.mcap")
    for command in (("replay",), ("digest",), ("export",), ("demo", "--recording")):
        more = [tmp_path / "out.glb"] if command == ("export",) else []
        more += ["--out", tmp_path / "demo"] if command[0] == "demo" else []
        text = refused(*command, tmp_path / "a.mcap", *more)
        assert "a.mcap: no scan in it" in text


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("one 0 0 1 0 0 0 1", "'one' are no seconds since 1970; a line is stamp"),
        ("-1.5 0 0 1 0 0 0 1", "'-1.5' are no seconds since 1970"),
        ("1 0 0 1 0 0 0 1 9", "9 numbers, 8 are stamp x y z qx qy qz qw"),
        ("1 0 0 one 0 0 0 1", "'one'; a line is stamp x y z qx qy qz qw"),
        ("1 0 0 1 0 0 0 0", "has not the length 1"),
    ],
)
def test_a_pose_that_is_none_is_named(tmp_path: Path, line: str, said: str) -> None:
    (tmp_path / "poses.txt").write_text(line)
    with pytest.raises(InputError, match=rf"poses\.txt:1: .*{said}"):
        _read_poses(tmp_path / "poses.txt")


@pytest.mark.skipif(not DATA.exists(), reason="the shared recordings are not here")
def test_import_a_real_recording(tmp_path: Path) -> None:
    facet("import", DATA / "rooms.npz", tmp_path / "rooms.mcap")
    scans = scans_of(tmp_path / "rooms.mcap")
    with np.load(DATA / "rooms.npz") as data:
        assert [len(s.points) for s in scans] == data["lengths"].tolist()


PCD = """VERSION .7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH 2
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 2
DATA ascii
1 2 3
4 5 6
"""
PLY = """ply
format ascii 1.0
element vertex 2
property float x
property float y
property float z
end_header
1 2 3
4 5 6
"""


@pytest.mark.parametrize(("name", "text"), [("0.ply", PLY), ("0.pcd", PCD)])
def test_import_clouds_with_poses(tmp_path: Path, name: str, text: str) -> None:
    if name.endswith("pcd"):
        pytest.importorskip("pypcd4")
    folder = tmp_path / "clouds"
    folder.mkdir()
    (folder / name).write_text(text)
    (folder / name.replace("0", "1")).write_text(text)
    poses = tmp_path / "poses.txt"
    poses.write_text("# stamp x y z qx qy qz qw\n1.000000001 0 0 1 0 0 0 1\n2.5 1 0 1 0 0 0 1\n")
    facet("import", folder, tmp_path / "a.mcap", "--poses", poses)
    first, second = scans_of(tmp_path / "a.mcap")
    assert first.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert (first.stamp_ns, second.stamp_ns) == (1_000_000_001, 2_500_000_000)
    assert second.pose.position.tolist() == [1, 0, 1]


def test_a_cloud_by_itself_is_of_when_its_file_was_written(tmp_path: Path) -> None:
    cloud = tmp_path / "a.ply"
    cloud.write_text(PLY)
    os.utime(cloud, ns=(0, 1_700_000_000_000_000_007))
    facet("import", cloud, tmp_path / "a.mcap")
    (scan,) = scans_of(tmp_path / "a.mcap")
    assert scan.stamp_ns == 1_700_000_000_000_000_007
    assert scan.pose.position.tolist() == [0, 0, 0]


def test_stamps_are_exact() -> None:
    assert _nanoseconds("1700000000.123456789") == 1_700_000_000_123_456_789
    assert _nanoseconds("12") == 12_000_000_000


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("replay", "nowhere.mcap"), 65, "nowhere.mcap: no such file"),
        (("replay", __file__), 65, "not an MCAP file"),
        (("replay", __file__, "--voxel", "9"), 78, "mapping.voxel_m = 9.0"),
        (("replay", __file__, "--update-every", "never"), 2, "never"),
        (("replay", __file__, "--out", __file__), 65, f"{__file__} is a file: name a folder"),
        (("replay", __file__, "--updates", "."), 65, ". is a folder: name a file"),
        (("replay", "."), 65, "facet: .: no .mcap file in this folder"),
        (("export", __file__, "/dev/null", "--format", "ply"), 65, "/dev/null is no file"),
        (("export", __file__, "a.xyz"), 2, "'xyz' is not one of json"),
        (("demo", "--speed", "fast"), 2, "'fast' is neither a number above 0 nor max"),
        (("import", __file__, "a.mcap"), 65, "its name ends in none of .npz, .ply, .pcd"),
        (("import", str(BUNDLED), "a.mcap"), 65, "is a recording already: `facet replay`"),
        (("simulate", "."), 65, ". is a folder: name a file"),
        (("simulate", "x.mcap", "--duration", "inf"), 2, "--duration"),
        (("simulate", "x.mcap", "--range-noise", "inf"), 2, "--range-noise"),
        (("run", "--listen", "tcp/0.0.0.0:7447"), 78, "open to the network"),
        (("run", "--viewer", "vr"), 78, "viewer"),
        (("run", "--listen", "127.0.0.1:7447"), 78, "PROTOCOL/HOST:PORT"),
        (("run", "--record", __file__), 65, "the log needs a folder"),
        (("status", "--connect", "tcp/127.0.0.1:9"), 74, "nobody answers at tcp/127.0.0.1:9"),
        (("status", "--connect", "127.0.0.1:9"), 74, "PROTOCOL/HOST:PORT"),
        (("cmd", "export", "glb"), 2, "'glb' is not key=value"),
        (("simulate", "x.mcap", "--range-noise", "-1"), 2, "--range-noise"),
        (("simulate", "x.mcap", "--speed", "0"), 2, "--speed"),
        (("simulate", "x.mcap", "--scene", "castle"), 2, "castle"),
    ],
)
def test_exit_codes(
    arguments: tuple[str, ...], code: int, said: str, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    result = process(*arguments)
    assert result.returncode == code, result.stderr
    assert said in result.stderr
    assert "Traceback" not in result.stderr
    assert ".rs:" not in result.stderr  # where in a library's source
    assert list(tmp_path.iterdir()) == []


def test_what_the_system_refuses_is_said_without_its_numbers() -> None:
    assert _said(PermissionError(13, "Permission denied", "/data")) == "/data: Permission denied"
    moved = FileExistsError(17, "File exists", "a.part", None, "a")
    assert _said(moved) == "a.part -> a: File exists"
    assert _said(OSError("no port is free")) == "no port is free"
    assert _said(zenoh.ZError("invalid port at /home/x/lib.rs:62.")) == "invalid port"


def test_the_demo_does_not_wait_for_a_service_that_has_ended() -> None:
    class Ended:
        def poll(self) -> int:
            return 1

    assert not _is_alive(None, Ended(), float("inf"))  # type: ignore[arg-type]


class Running:
    """`facet run` in a process of its own."""

    def __init__(self, folder: Path, *arguments: object) -> None:
        self.endpoint, self.folder = free_endpoint(), folder
        folder.mkdir(exist_ok=True)
        options = ["run", "--listen", self.endpoint, "--record", folder, "--voxel", 0.1]
        command = [sys.executable, "-m", "facet", *map(str, [*options, *arguments])]
        with (folder / "stderr.txt").open("w") as stderr:
            self.process = subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=stderr, text=True, env=os.environ.copy()
            )
        try:
            wait_until(self._listens, 240)  # its loops may have to be compiled
            settings = patient(client_settings(self.endpoint, shared_memory=False))
            with open_session(settings) as session:
                wait_until(lambda: list(session.liveliness().get(alive_key("map"))))
        except BaseException:
            self.process.kill()
            self.process.wait()
            raise

    def _listens(self) -> bool:
        assert self.process.poll() is None, (self.folder / "stderr.txt").read_text()
        with socket.socket() as probe:
            return not probe.connect_ex(("127.0.0.1", int(self.endpoint.rpartition(":")[2])))

    def stop(self, number: int = signal.SIGTERM, timeout_s: float = WAIT_S) -> tuple[int, str]:
        """(exit code, standard output)."""
        self.process.send_signal(number)
        output, _ = self.process.communicate(timeout=timeout_s)
        return self.process.returncode, output


def test_run_play_stop_replay(log: Path, tmp_path: Path) -> None:
    """A robot's scans through a running service, SIGTERM, and the same map again from its log."""
    service = Running(tmp_path / "log")
    try:
        played = process("play", log, "--connect", service.endpoint, "--speed", "max")
        assert played.returncode == 0, played.stderr
        assert "played 6 scans" in played.stdout
        status = process("status", "--connect", service.endpoint)
        assert status.returncode == 0, status.stderr
        assert "[r1/lidar]" in status.stdout
        drawn = {name for names in GAUGES.values() for name in names}
        assert {name for name in drawn if f"│ {name} " not in status.stdout} == set()
        said = " ".join(status.stdout.split())
        law = re.search(r"received (\d+) = applied (\d+) \+ .* \+ in flight (\d+)", said)
        assert law is not None
        assert int(law[1]) == int(law[2]) + int(law[3])
        code, output = service.stop()
    finally:
        service.process.kill()
        service.process.wait()
    assert code == 0, output
    last = output.splitlines()[-1]
    assert last == "recorded 6 of 6 received (100.0 %), lost upstream 0"
    model = json.loads((tmp_path / "log" / "model.json").read_text())
    assert hashes(facet("replay", tmp_path / "log")) == model["digest"]
    assert hashes(facet("replay", log, "--voxel", 0.1)) == model["digest"]


def test_who_asks_for_the_wrong_map_learns_the_right_one(log: Path, tmp_path: Path) -> None:
    service = Running(tmp_path / "log")
    here = ("--connect", service.endpoint)
    try:
        status = process("status", "--map", "hall", *here)
        played = process("play", log, "--speed", "max", "--map", "hall", *here)
        refused = process("cmd", "export", "format=stl", *here)
        second = process("run", "--listen", service.endpoint, "--record", tmp_path / "b")
    finally:
        service.process.kill()
        service.process.communicate()
    missing = f"no service maps 'hall' at {service.endpoint}; --map map would find one"
    assert (status.returncode, missing in status.stderr) == (65, True), status.stderr
    assert missing in played.stderr
    assert (refused.returncode, "'stl' is not one of" in refused.stderr) == (65, True)
    assert second.returncode == 74
    assert f"{service.endpoint} is taken" in second.stderr


def test_killed_at_any_moment_the_log_is_whole_chunks(log: Path, tmp_path: Path) -> None:
    service = Running(tmp_path / "log")
    process("play", log, "--connect", service.endpoint, "--speed", "max")
    recorded = tmp_path / "log"
    wait_until(lambda: any(p.stat().st_size > 300_000 for p in recorded.glob("*.mcap")))
    service.process.kill()
    service.process.communicate()
    assert "6" in facet("replay", recorded, code=3)
    again = Running(tmp_path / "log")  # the lock died with the process
    assert again.stop(signal.SIGINT)[0] == 0


def test_a_viewer_that_dies_changes_nothing(log: Path, tmp_path: Path) -> None:
    """Its viewer has nothing to draw into, and is killed; the map goes on."""
    service = Running(tmp_path / "log", "--viewer", "connect:rerun+http://127.0.0.1:9/proxy")
    children = psutil.Process(service.process.pid).children
    wait_until(lambda: len(children()) == 1)
    children()[0].kill()
    wait_until(lambda: not children())
    process("play", log, "--connect", service.endpoint, "--speed", "max")
    code, output = service.stop()
    assert code == 0, output
    assert "recorded 6 of 6" in output
    assert "viewer_ended" in output


def test_the_demo_empties_no_folder_but_its_own(log: Path, tmp_path: Path) -> None:
    """`facet demo --out out` would have taken the map in out/log with it."""
    for folder, name in (("home", "thesis.txt"), ("out", "log"), ("mixed", "notes.md")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / name).write_text("dear")
        if folder == "mixed":
            (tmp_path / folder / MARK).write_text("")
        with pytest.raises(InputError, match=rf"holds '{name}', not from a demo"):
            _make_room(tmp_path / folder, log)
        assert (tmp_path / folder / name).read_text() == "dear"
    with pytest.raises(InputError, match="is a file: name a folder"):
        _make_room(log, log)
    again = tmp_path / "demo"
    (again / "log").mkdir(parents=True)
    (again / MARK).write_text("ready")
    with pytest.raises(InputError, match="which is emptied"):
        _make_room(again, again / "log" / "a.mcap")
    _make_room(again, log)
    assert list(again.iterdir()) == []


def test_the_demo_ends_with_the_same_map_twice(log: Path, tmp_path: Path) -> None:
    result = process("demo", "--recording", log, "--out", tmp_path / "demo", "--speed", "max")
    assert result.returncode == 0, result.stderr + result.stdout
    assert "live and replayed alike" in result.stdout
    written = {path.name for path in (tmp_path / "demo").iterdir()}
    assert {"model.json", "picture.png", "demo.rrd", "log"} <= written


def test_a_second_service_does_not_write_the_same_log(tmp_path: Path) -> None:
    service = Running(tmp_path / "log")
    second = process("run", "--listen", free_endpoint(), "--record", tmp_path / "log")
    assert service.stop()[0] == 0
    assert second.returncode == 74
    assert "another service" in second.stderr
