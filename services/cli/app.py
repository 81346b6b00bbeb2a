"""The command line ``endo3d``: a table of commands, each in a file of its own, imported when it runs."""

from __future__ import annotations

import errno
import importlib
import sys
from importlib.util import find_spec
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from endo3d.services.runtime.errors import UserError

PANELS: dict[str, dict[str, str]] = {
    "Scan": {
        "demo": "Scan the micro-contour standard on the virtual rig, and compare with the truth.",
        "up": "Start every service of a stack file, and keep them running.",
        "mode": "Switch what the projector shows, while the stack runs.",
        "exposure": "Set the exposure of every pattern, while the stack runs.",
        "record": "Start or stop the recording of a running stack.",
    },
    "Look": {
        "top": "Live table of the services: rate, latency, drops, CPU, memory.",
        "tap": "Print a stream as it passes, or save its images and clouds.",
        "view": "Show a log in Rerun, or make a picture of it.",
    },
    "Logs": {
        "replay": "Run a log through the services again, bit for bit or with other parameters.",
        "recover": "Repair a log that was torn by a crash.",
        "export": "Write clouds, meshes, depth maps, trajectories or a ROS 2 bag from a log.",
        "render": "Render frames of a scene into a log, with full physics.",
        "evaluate": "Repeat the paper's experiments on the virtual rig.",
    },
    "Set up": {
        "doctor": "Check this machine, and say what to do.",
        "calibrate": "Calibrate camera and projector: capture, solve, verify, export.",
        "check": "Check a stack file and print its dataflow.",
        "run": "Run one service of a stack in this process.",
        "devices": "List cameras and projectors, and try them.",
        "keys": "Certificates for the hosts of a rig.",
        "import": "Turn images of another instrument into a log.",
    },
}
"""What ``endo3d --help`` lists: command ``name`` lives in ``services/cli/<name>.py`` as a function ``name``
(or a typer app ``app``, if it has subcommands)."""


def _module(name: str) -> str:
    return f"{__package__}.{name}_" if name == "import" else f"{__package__}.{name}"


class LazyGroup(TyperGroup):
    """Lists commands without importing them: help must not wait for what only a command needs."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for panel, commands in PANELS.items():
            for name, line in commands.items():
                if find_spec(_module(name)):
                    self.commands[name] = TyperCommand(name=name, help=line, rich_help_panel=panel)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Import the command that is meant."""
        if args and args[0] in self.commands:
            self.commands[args[0]] = load(args[0])
        return super().resolve_command(ctx, args)


def load(name: str) -> Any:
    """A command, from its file."""
    module = importlib.import_module(_module(name))
    subcommands = getattr(module, "app", None)
    if subcommands is None:
        subcommands = typer.Typer(
            add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich"
        )
        subcommands.command(name)(getattr(module, _module(name).rpartition(".")[2]))
    command = typer.main.get_command(subcommands)
    command.name = name
    return command


app = typer.Typer(
    cls=LazyGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"endo3d {version('endo3d')}")
        raise typer.Exit


@app.callback(
    epilog="First steps: [bold]endo3d doctor[/], [bold]endo3d demo[/]. "
    "Each command explains itself: endo3d COMMAND --help."
)
def endo3d(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version."
    ),
) -> None:
    """Live 3-D measurement through a hand-held fibre endoscope."""


def main() -> None:
    """The entry point: an error that is meant for the user is one line and exit code 2."""
    try:
        app()
    except UserError as error:
        print(f"endo3d: {error}", file=sys.stderr)
        sys.exit(2)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] in ("endo3d", "endo3d_core"):
            raise
        print(f"endo3d: this needs the package {error.name!r}; pip install it", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output is gone: nothing to say, and nobody to say it to
        sys.exit(141)
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        print(f"endo3d: the disk is full ({error.filename or 'writing'}); make room and try again", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
