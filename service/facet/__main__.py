"""The command `facet`: what can be asked for, and what the process answers when it fails."""

from __future__ import annotations

import logging
import re
import signal
import sys

import typer
import zenoh

from facet import __version__
from facet.commands.configuration import config
from facet.commands.demo import demo
from facet.commands.export import export
from facet.commands.imports import import_
from facet.commands.inspect import digest, info
from facet.commands.play import play
from facet.commands.recover import recover
from facet.commands.replay import replay
from facet.commands.run import run
from facet.commands.simulate import simulate
from facet.commands.talk import cmd, status, top
from facet.commands.terminal import Exit, InputError, err, out
from facet.config import ConfigError
from facet.logbook import Logbook
from facet.session import DEFAULT_ENDPOINT
from facet.sources.mcap_damage import LogError
from facet_protocol.messages import ProtocolError

app = typer.Typer(
    name="facet",
    help="Facet maps buildings: scans with poses in, walls, floors and doors out, live.",
    epilog="Start with `facet demo`. Every command explains itself: `facet replay --help`.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
# Zenoh's own words end with the line of its source; what they begin with tells what was tried
_SOURCE = re.compile(r" at \S+\.rs:\d+\.?")
_NOBODY = re.compile(r"Unable to connect to any of \[\w+\((.*?)\)\]")
_NO_ENDPOINT = re.compile(r"Endpoints must be of the form \S+: ([^\s\"]+)")
_TAKEN = re.compile(r"bound to (\S+): .*Address already in use")
LIVE, FILES = (
    (run, play, status, top, cmd),
    (replay, simulate, export, info, digest, recover, config, demo),
)
for command in (*LIVE, *FILES):
    app.command()(command)
app.command("import")(import_)


def _print_version(asked: bool) -> None:
    if asked:
        out.print(f"facet {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Print the version."
    ),
) -> None:
    """Facet maps buildings: scans with poses in, walls, floors and doors out, live."""


def app_main() -> None:
    """Run the command; failures that are not ours become one line and an exit code."""
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # tidies up, as Ctrl-C
    sys.exit(_run())


def _run() -> int:
    try:
        app()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else Exit.FAULT
    except ConfigError as error:
        return _fail(Exit.CONFIG, error)
    except (LogError, ProtocolError, InputError) as error:
        return _fail(Exit.BAD_INPUT, error)
    except (OSError, zenoh.ZError) as error:
        return _fail(Exit.IO, error)
    return Exit.CLEAN


def _fail(code: Exit, error: Exception) -> Exit:
    text = f"facet: {_said(error)}"
    books = [handler for handler in logging.root.handlers if isinstance(handler, Logbook)]
    for book in books:  # where standard error may be a pipe that nobody reads
        book.say(text)
    if not books:
        err.print(text, style="bold red", markup=False)
    return code


def _said(error: Exception) -> str:
    """The failure in the words of who typed the command: what was tried, and what to do."""
    if isinstance(error, zenoh.ZError):
        return _network_said(str(error))
    if isinstance(error, OSError) and error.filename is not None:
        names = (str(n) for n in (error.filename, error.filename2) if n is not None)
        return f"{' -> '.join(names)}: {error.strerror}"
    return str(error)


def _network_said(text: str) -> str:
    text = _SOURCE.sub("", text)
    if nobody := _NOBODY.search(text):
        return (
            f"nobody answers at {nobody[1]}: `facet run` starts a service; "
            "--connect names another address"
        )
    if wrong := _NO_ENDPOINT.search(text):
        return f"{wrong[1]!r} is no endpoint: that is PROTOCOL/HOST:PORT, as in {DEFAULT_ENDPOINT}"
    if taken := _TAKEN.search(text):
        return (
            f"{taken[1]} is taken, by another service perhaps: --listen names another, "
            "as in --listen tcp/127.0.0.1:7448"
        )
    return text


if __name__ == "__main__":
    app_main()
