"""The root of the command line: moved commands, errors that click would end with exit code 1, help texts."""

import inspect
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

from arctrack.cli.interrupt import InterruptedCommandError, lost_interrupts
from arctrack.errors import ArctrackError


def reflow(app: typer.Typer) -> None:
    """Take the breaks within paragraphs out of the helps of all commands of an app, and of its groups."""
    for command in app.registered_commands:
        if command.callback is not None:
            command.help = paragraphs(command.help or inspect.getdoc(command.callback) or "")
    for group in app.registered_groups:
        if group.typer_instance is not None:
            reflow(group.typer_instance)


def paragraphs(text: str) -> str:
    """Return a text with each of its paragraphs on a line."""
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))


MOVED = {
    ("figures",): "python -m validation.figures",
    ("diagnose", "check"): "python -m validation.blind_check",
    ("cell", "schedules"): "python -m validation.fault_schedules",
}
"""Commands that judge arctrack and are no longer installed with it, and what runs them in a clone."""


class UnexpectedEndError(Exception):
    """An EOFError or BrokenPipeError, which click would answer with exit code 1."""

    def __init__(self, error: EOFError | BrokenPipeError) -> None:
        super().__init__(str(error))
        self.error = error


class CommandGroup(TyperGroup):
    """A group that answers a moved command with the new one."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Raise ArctrackError for a moved command; a folder of its second word's name is a recording."""
        for words, command in MOVED.items():
            is_recording = len(words) > 1 and Path(words[1]).exists()
            if tuple(args[: len(words)]) == words and not is_recording:
                raise ArctrackError(f"arctrack {' '.join(words)} is now {command}, in a clone of arctrack")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the command; of one that says nothing of its own, Ctrl-C says its name."""
        with lost_interrupts() as lost:
            try:
                return super().invoke(ctx)
            except (InterruptedCommandError, ArctrackError):
                raise
            except (EOFError, BrokenPipeError) as error:
                raise UnexpectedEndError(error) from error
            except (KeyboardInterrupt, Exception) as error:
                if not lost and not isinstance(error, KeyboardInterrupt):
                    raise
                name = f"{ctx.info_name} {ctx.invoked_subcommand}"
                raise InterruptedCommandError(f"{name} interrupted; what it had finished stays") from None
