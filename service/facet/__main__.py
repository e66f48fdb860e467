"""The command `facet`: what can be asked for, and what the process answers when it fails."""

from __future__ import annotations

import sys

import typer
import zenoh

from facet import __version__
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
LIVE, FILES = (run, play, status, top, cmd), (replay, simulate, export, info, digest, recover, demo)
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
    err.print(f"facet: {error}", style="bold red", markup=False)
    return code


if __name__ == "__main__":
    app_main()
