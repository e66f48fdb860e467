"""The committed recordings, made again from their seeds: `make recordings`."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

RECORDINGS = {
    "office-pushbroom": (
        "Two rooms and the corridor of a simulated office, by a line scanner across the way",
        ("--scene", "office", "--sensor", "pushbroom", "--speed", "0.7", "--duration", "36"),
    ),
}
HEAD = """# Recordings

Simulated, each with its truth beside it; nothing here was recorded by anyone.
`make recordings` makes them again, bit for bit with the same libraries.

| file | what | made by | sha256 |
|---|---|---|---|
"""


def make(folder: Path) -> str:
    """Write every recording into `folder`; the table of its README."""
    rows = []
    for name, (what, options) in RECORDINGS.items():
        path = folder / f"{name}.mcap"
        arguments = [str(path), *options, "--compression", "zstd"]
        subprocess.run([sys.executable, "-m", "facet", "simulate", *arguments], check=True)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        command = " ".join(["facet simulate", path.name, *options, "--compression", "zstd"])
        rows.append(f"| `{path.name}` | {what} | `{command}` | `{digest}` |\n")
    return HEAD + "".join(rows)


if __name__ == "__main__":
    target = Path(sys.argv[1])
    target.mkdir(parents=True, exist_ok=True)
    (target / "README.md").write_text(make(target), encoding="utf-8")
