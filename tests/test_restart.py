"""`facet run` again in the same folder: it goes on with the map; --fresh begins anew."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from facet.sinks.log_file import write_recording
from rig import room
from test_commands import Running, facet, hashes, process


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "room.mcap"
    write_recording(path, room(6), {"map": "room", "frame": "map"})
    return path


def lived(log: Path, folder: Path, *arguments: object) -> tuple[str, str]:
    """(what it wrote to standard output, to standard error) of a life with one play of the log."""
    service = Running(folder, *arguments)
    try:
        played = process("play", log, "--connect", service.endpoint, "--speed", "max")
        assert played.returncode == 0, played.stderr
        code, output = service.stop(signal.SIGTERM)
    finally:
        service.process.kill()
        service.process.wait()
    assert code == 0, output
    return output, (folder / "stderr.txt").read_text()


def digest_of_model(folder: Path) -> dict[str, str]:
    digest: dict[str, str] = json.loads((folder / "model.json").read_text())["digest"]
    return digest


def test_the_map_goes_on_and_begins_anew_when_told(log: Path, tmp_path: Path) -> None:
    folder = tmp_path / "log"
    _, first = lived(log, folder, "--fast")
    assert "survives the end of the service, no power cut" in first
    assert hashes(facet("digest", folder / "map.checkpoint")) == digest_of_model(folder)
    text = facet("info", folder / "map.checkpoint")
    assert "newest of r1/lidar" in text
    output, again = lived(log, folder)
    assert "map goes on: map.checkpoint, 0 scans of its log" in again
    assert "recorded 6 of 6 received" in output
    model = json.loads((folder / "model.json").read_text())
    assert model["counts"]["scans"] == 12
    assert hashes(facet("replay", folder)) == model["digest"]
    assert hashes(facet("digest", folder / "map.checkpoint")) == model["digest"]
    _, fresh = lived(log, folder, "--fresh")
    assert "a new map; the log of the one before lies in" in fresh
    assert json.loads((folder / "model.json").read_text())["counts"]["scans"] == 6
    (aside,) = folder.glob("map-before-*")
    assert len(list(aside.glob("*.mcap"))) == 2
    assert hashes(facet("replay", aside)) == model["digest"]


def test_another_map_finds_the_folder_taken(log: Path, tmp_path: Path) -> None:
    """Its model would take the place of the one that is there."""
    lived(log, tmp_path / "log")
    model = digest_of_model(tmp_path / "log")
    refused = process("run", "--record", tmp_path / "log", "--map", "other")
    assert refused.returncode == 65
    assert "holds the log of map 'map': --map map goes on with it" in refused.stderr
    assert digest_of_model(tmp_path / "log") == model
