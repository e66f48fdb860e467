"""Who may import whom, and a few things that no file of ours does."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
MAX_FILE_LINES = 400
MAX_TOTAL_LINES = 27_350

OUTSIDE = {
    *("asyncio", "datetime", "logging", "multiprocessing", "os", "pathlib", "random", "signal"),
    *("socket", "subprocess", "tempfile", "threading", "time"),
}  # clock, files, threads, processes, chance


class Layer(NamedTuple):
    """`ours` and `others` that a part may import; "a.*" is a and all below it, "a" only a."""

    ours: str
    others: str = "numpy"
    pure: bool = False  # nothing of OUTSIDE


EVERYTHING = Layer("facet.* facet_protocol.*", "*")
SHELL = Layer(
    "facet facet.admission facet.config facet.corrections facet.firsts facet.frames "
    "facet.mapping.* facet.outgoing facet.past facet.pipeline facet.placement facet.plausibility "
    "facet.publishers facet.resolution facet.rivals facet.sequences facet.sinks "
    "facet.sources.naming facet.standing facet.status facet.trajectory facet_protocol.*"
)
WIRING = Layer(  # the threads of the running service: they join sources and sinks by hand
    f"{SHELL.ours} facet.intake facet.robots facet.session facet.sinks.* facet.sources.*"
)
LAYERS = {  # the longest name that fits counts
    "facet_protocol": Layer(
        "facet_protocol.*", "numpy google foxglove_schemas_protobuf", pure=True
    ),
    "facet_protocol.messages": Layer("", pure=True),
    "facet.mapping": Layer(
        "facet.mapping.* facet_protocol.messages", "numpy scipy numba llvmlite", pure=True
    ),
    "facet.mapping.kernel": Layer("", "numba"),  # it names the cache of compiled loops
    "facet.sources": Layer("facet.sources.* facet_protocol.*", "numpy zenoh mcap lz4 zstandard"),
    "facet.sinks": Layer(
        "facet.sinks.* facet.export.* facet_protocol.*", "numpy zenoh mcap rerun rerun_cli"
    ),
    "facet.sinks.viewer": Layer(  # a process of its own: a client, with a client's session
        "facet.logbook facet.session facet.sinks.* facet_protocol.*", "zenoh"
    ),
    "facet.export": Layer(
        "facet.export.* facet_protocol.*", "numpy trimesh plyfile shapely matplotlib PIL"
    ),
    "facet.simulate": Layer("facet.simulate.* facet_protocol.*", "numpy numba"),
    "facet.config": Layer("", "pydantic"),
    "facet.erasing": Layer(
        "facet.outgoing facet.sinks.* facet.sources.naming facet.status facet_protocol.*"
    ),
    "facet.frames": Layer("facet_protocol.*", pure=True),
    "facet.logbook": Layer(""),
    "facet.past": Layer("facet.sinks.log_file facet.sources.* facet_protocol.*"),
    "facet.publishers": Layer("", pure=True),
    "facet.resolution": Layer("facet.frames facet_protocol.*", pure=True),
    "facet.robots": Layer(
        "facet.admission facet.config facet.past facet.sources.dialects facet.status "
        "facet_protocol.*"
    ),
    "facet.session": Layer("facet.config", "zenoh"),
    "facet.trajectory": Layer("facet_protocol.messages", pure=True),
    "facet": SHELL,
    "facet.intake": WIRING,
    "facet.resume": Layer(f"{WIRING.ours} facet.checkpoint facet.cuts"),
    "facet.keeper": Layer("facet.checkpoint facet.config facet.resume facet.status"),
    "facet.service": Layer(
        f"{WIRING.ours} facet.checkpoint facet.erasing facet.export.* facet.keeper facet.resume",
        "numpy zenoh",
    ),
    "facet.commands": EVERYTHING,
    "facet.__main__": EVERYTHING,
}


def name_of(path: Path) -> str:
    """facet.mapping.store of service/facet/mapping/store.py; a package for its __init__.py."""
    parts = path.relative_to(ROOT).with_suffix("").parts[1:]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {
    name_of(path): path
    for folder in ("service", "protocol")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if not path.stem.endswith("_pb2")
}
every_module = pytest.mark.parametrize("module", FILES)


def imports(tree: ast.AST) -> Iterator[str]:
    """Full names of everything imported, also inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                known = inner in FILES or inner.startswith("facet_protocol.proto.")
                yield inner if known else base


def layer_of(module: str) -> Layer:
    while module not in LAYERS:
        module = module.rpartition(".")[0]
    return LAYERS[module]


def allowed(name: str, entries: str) -> bool:
    return any(
        entry in ("*", name) or (entry.endswith(".*") and f"{name}.".startswith(entry[:-1]))
        for entry in entries.split()
    )


def crossings(module: str, tree: ast.AST) -> list[str]:
    """What `module` imports and may not, each as a sentence."""
    layer = layer_of(module)
    found = []
    for name in imports(tree):
        top = name.partition(".")[0]
        if top in ("facet", "facet_protocol"):
            good = allowed(name, layer.ours)
        elif top in sys.stdlib_module_names:
            good = not (layer.pure and top in OUTSIDE)
        else:
            good = allowed(top, layer.others)  # relative imports have an empty top: refused
        if not good:
            found.append(f"{module} imports {name}")
    return found


FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve"}
FORBIDDEN_CALLS = {"eval", "exec", "yaml.load", "os.system", "os.popen"}
FORBIDDEN_TRUE = {"shell", "allow_pickle", "fastmath"}


def dangers(module: str, tree: ast.AST) -> list[str]:
    """Code from data, shells, and arithmetic that differs between machines."""
    found = [f"{module} imports {n}" for n in imports(tree) if n.split(".")[0] in FORBIDDEN_MODULES]
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        if ast.unparse(node.func) in FORBIDDEN_CALLS:
            found.append(f"{module}:{node.lineno} calls {ast.unparse(node.func)}")
        for keyword in node.keywords:
            off = isinstance(keyword.value, ast.Constant) and not keyword.value.value
            if keyword.arg in FORBIDDEN_TRUE and not off:
                found.append(f"{module}:{node.lineno} passes {keyword.arg}")
    return found


@every_module
def test_imports_stay_within_their_layer(module: str) -> None:
    assert crossings(module, ast.parse(FILES[module].read_text())) == []


@every_module
def test_no_code_from_data_and_no_shell(module: str) -> None:
    assert dangers(module, ast.parse(FILES[module].read_text())) == []


@every_module
def test_files_are_short_and_named_after_nouns(module: str) -> None:
    lines = len(FILES[module].read_text().splitlines())
    assert lines <= MAX_FILE_LINES, f"{module}: {lines} lines"
    vague = {"utils", "util", "helpers", "common", "core", "manager", "misc"}
    assert not vague & set(module.split("."))


def test_the_whole_stays_within_its_budget() -> None:
    assert sum(len(p.read_text().splitlines()) for p in FILES.values()) <= MAX_TOTAL_LINES


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("facet.mapping.mapper", "import time"),
        ("facet.mapping.mapper", "from pathlib import Path"),
        ("facet.mapping.mapper", "from facet_protocol.codec import encode"),
        ("facet.mapping.mapper", "from facet_protocol import Scan"),
        ("facet.mapping.mapper", "def f():\n    import zenoh"),
        ("facet.mapping.mapper", "from . import store"),
        ("facet.sinks.viewer", "from facet.mapping.mapper import Mapper"),
        ("facet.sources.live", "from facet.sinks import recorder"),
        ("facet.pipeline", "import mcap.writer"),
        ("facet.pipeline", "from facet.sinks.recorder import Recorder"),
        ("facet.pipeline", "import facet.commands.run"),
        ("facet.config", "from facet import mapping"),
        ("facet_protocol.codec", "import facet"),
        ("facet_protocol.codec", "import zenoh"),
        ("facet_protocol.messages", "import google.protobuf"),
    ],
)
def test_a_planted_crossing_is_caught(module: str, line: str) -> None:
    assert crossings(module, ast.parse(line))


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from dill import loads",
        "eval('1')",
        "exec('1')",
        "yaml.load(f)",
        "run('ls', shell=True)",
        "run('ls', shell=flag)",
        "np.load(f, allow_pickle=True)",
        "njit(fastmath=True)",
    ],
)
def test_a_planted_danger_is_caught(line: str) -> None:
    assert dangers("facet.pipeline", ast.parse(line))
    assert not dangers("facet.pipeline", ast.parse("run('ls', shell=False)"))
