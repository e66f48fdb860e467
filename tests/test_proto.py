"""The committed code is what protoc makes of the .proto files."""

import subprocess
import sys
from pathlib import Path

PROTOCOL = Path(__file__).parents[1] / "protocol"
FOLDER = PROTOCOL / "facet_protocol" / "proto"


def test_generated_code_is_current(tmp_path: Path) -> None:
    """Else: `make proto`."""
    sources = sorted(FOLDER.glob("*.proto"))
    out = [f"--python_out={tmp_path}", f"--pyi_out={tmp_path}"]
    command = [sys.executable, "-m", "grpc_tools.protoc", f"-I{PROTOCOL}", *out]
    subprocess.run([*command, *map(str, sources)], check=True)
    made = {path.name: path.read_text() for path in tmp_path.rglob("*_pb2.py*")}
    committed = {path.name: path.read_text() for path in FOLDER.glob("*_pb2.py*")}
    assert made == committed
    assert len(made) == 2 * len(sources)
