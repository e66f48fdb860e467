"""How commands speak: tables on standard output, progress on a terminal only, exit codes."""

from __future__ import annotations

import shlex
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

PATIENCE_S = 5.0  # without a word
PIPE_WIDTH = 200  # columns: in a pipe nothing is folded, so that it can be searched
out = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else PIPE_WIDTH)
err = Console(stderr=True, highlight=False, soft_wrap=True)


class Exit(IntEnum):
    CLEAN = 0
    FAULT = 1  # ours
    USAGE = 2
    LOST = 3  # finished, but data was lost or left out
    BAD_INPUT = 65
    IO = 74
    CONFIG = 78


class InputError(Exception):
    """Something given that cannot be read; the text says what."""


def table(title: str, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Print a table; numbers to the right."""
    grid = Table(title=title, title_justify="left", title_style="bold", header_style="bold")
    body = [[_cell(value) for value in row] for row in rows]
    for k, name in enumerate(columns):
        numeric = bool(body) and all(_is_number(row[k]) for row in body)
        grid.add_column(name, justify="right" if numeric else "left", overflow="fold")
    for row in body:
        grid.add_row(*map(Text, row))  # no markup: names come from outside
    out.print(grid)


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:,.3g}" if abs(value) < 100 else f"{value:,.0f}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _is_number(text: str) -> bool:
    return text[:1].isdigit() or text[:1] == "-"


@contextmanager
def progress(what: str, total: float | None = None) -> Iterator[Progress]:
    """A progress bar with one task, 0; nothing in a pipe."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err, disable=not err.is_terminal, transient=True) as bar:
        bar.add_task(what, total=total)
        yield bar


@contextmanager
def said_if_slow(text: str, say: Callable[[str], object]) -> Iterator[None]:
    """Say the text when what is done takes longer than PATIENCE_S."""
    timer = threading.Timer(PATIENCE_S, say, (text,))
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def existing(paths: Iterable[Path]) -> list[Path]:
    """The same paths. Raises InputError for one that is not there."""
    checked = list(paths)
    for path in checked:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
    return checked


def out_folder(path: Path) -> Path:
    """The same path, a folder that is there. Raises InputError where a file is in its place."""
    if path.exists() and not path.is_dir():
        raise InputError(f"{path} is a file: name a folder")
    path.mkdir(parents=True, exist_ok=True)
    return path


def out_file(path: Path) -> Path:
    """The same path, where a file may be written. Raises InputError where something else is: it is
    said before the work, and no device is replaced."""
    if path.exists() and not path.is_file():
        raise InputError(f"{path} is {'a folder' if path.is_dir() else 'no file'}: name a file")
    return path


def as_typed(context: typer.Context) -> str:
    """The command with what was given to it, of files their names alone: for a recording."""
    words = ["facet", str(context.info_name)]
    for parameter in context.command.params:
        name = str(parameter.name)
        source = context.get_parameter_source(name)
        if source is not None and source.name != "DEFAULT":
            value = context.params[name]
            is_option = parameter.param_type_name == "option"
            words += [parameter.opts[0]] if is_option else []
            words.append(value.name if isinstance(value, Path) else str(value))
    return shlex.join(words)


def megabytes(num_bytes: int) -> str:
    return f"{num_bytes / 1e6:,.1f} MB" if num_bytes >= 1e5 else f"{num_bytes / 1e3:,.1f} kB"
