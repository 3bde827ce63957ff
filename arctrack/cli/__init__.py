"""The command line: one thin file a command; heavy things are loaded by the command that needs them."""

import io
import logging
import sys
from typing import Annotated, NoReturn

import typer

from arctrack.cli.bead import bead
from arctrack.cli.calibrate import calibrate
from arctrack.cli.cell_file import cell
from arctrack.cli.check import check
from arctrack.cli.crash import crash, end_of_output
from arctrack.cli.diagnose import diagnose
from arctrack.cli.doctor import doctor
from arctrack.cli.exit_codes import BAD_INPUT, INTERRUPTED
from arctrack.cli.explain import explain
from arctrack.cli.find import find
from arctrack.cli.group import CommandGroup, UnexpectedEndError, reflow
from arctrack.cli.import_files import import_files
from arctrack.cli.inspect import inspect
from arctrack.cli.interrupt import InterruptedCommandError
from arctrack.cli.lines import write_line
from arctrack.cli.new import new
from arctrack.cli.plan import plan
from arctrack.cli.replay import replay
from arctrack.cli.serve import serve
from arctrack.cli.shift import shift
from arctrack.cli.simulate import simulate
from arctrack.cli.warm import warm
from arctrack.errors import ArctrackError
from arctrack.printable import printable

app = typer.Typer(
    name="arctrack",
    cls=CommandGroup,
    help="Seam tracking for GTAW under reflected arc light.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["--help", "-h"]},
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)
app.command(
    epilog="Example: arctrack replay examples/v_groove --out /tmp/results. After an interruption: "
    "arctrack replay monday tuesday --workers 2 --resume"
)(replay)
app.command(epilog="Example: arctrack check examples/v_groove --out /tmp/check.png")(check)
app.command(epilog="Example: arctrack inspect examples/v_groove --out /tmp/v_groove.png")(inspect)
app.command(epilog="Example: arctrack explain examples/v_groove 12 --out /tmp/frame_12.html")(explain)
app.command(epilog="Example: arctrack find master/p1 master/p2 master/p3 --out master.json")(find)
app.command(epilog="Example: arctrack shift master.json part.json --out shift.json")(shift)
app.command(epilog="Example: arctrack bead monday --limit width_mm=4:8 --limit undercut_left_mm=:0.5")(bead)
app.command(epilog="Example: arctrack new /tmp/my_sensor --joint lap")(new)
app.command(
    "import",
    epilog="Example: arctrack import photos --setup recording.toml --poses robot.csv --rotation kuka "
    "--rate-hz 25 --out monday",
)(import_files)
app.command(
    epilog="Example: arctrack simulate /tmp/pipe --joint fillet --path circle:60 --production --frames 4"
)(simulate)
app.command(epilog="Example: arctrack plan examples/v_groove --out /tmp/plan")(plan)
app.command(epilog="Example: arctrack diagnose monday tuesday --workers 2")(diagnose)
app.command(epilog="Example: arctrack serve --simulated --seconds 30")(serve)
app.command(epilog="Example: arctrack doctor /tmp/my_cell/cell.toml")(doctor)
app.command(epilog="Example: arctrack warm examples/v_groove")(warm)
app.add_typer(calibrate)
app.add_typer(cell)
reflow(app)


def _print_version(wanted: bool) -> None:
    if wanted:
        from arctrack.version import __version__

        typer.echo(f"arctrack {__version__}")
        raise typer.Exit


@app.callback(epilog="Example: arctrack replay examples/v_groove")
def _arctrack(
    _version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Seam tracking for GTAW under reflected arc light."""


def main() -> None:
    """Run the command line."""
    run_app(app, "arctrack")


def run_app(app: typer.Typer, name: str) -> None:
    """Run an app; what is wrong with the input is one line on stderr and exit code 2.

    Ctrl-C says what it interrupted and what is kept; the exit code is then 130. A fault of arctrack itself is
    one line too, and exit code 70.
    """
    for stream in (sys.stdout, sys.stderr):
        # Not every terminal can show a sigma.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    # python-can complains of a bus that it could not open, after the error's own line.
    logging.getLogger("can.bus").addHandler(logging.NullHandler())
    try:
        app(prog_name=name)
    except InterruptedCommandError as interrupted:
        write_line(f"arctrack: {printable(str(interrupted))}", sys.stderr)
        sys.exit(INTERRUPTED)
    except ArctrackError as error:
        _complain(str(error))
    except OSError as error:
        # A disk that is full, a folder that went away: what was written stays.
        _complain(printable(f"{error.filename or 'file'}: {error.strerror or error}"))
    except UnexpectedEndError as error:
        end_of_output(error.error)
    except Exception as error:
        crash(error)


def _complain(problem: str) -> NoReturn:
    write_line(f"arctrack: error: {problem}", sys.stderr)
    sys.exit(BAD_INPUT)
