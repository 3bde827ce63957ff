"""The root of the command line: commands of two words, and errors that click would end with exit code 1."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from typer.core import TyperGroup

from arctrack.cli.interrupt import InterruptedCommandError


class UnexpectedEndError(Exception):
    """An EOFError or BrokenPipeError, which click would answer with exit code 1."""

    def __init__(self, error: EOFError | BrokenPipeError) -> None:
        super().__init__(str(error))
        self.error = error


class CommandGroup(TyperGroup):
    """A group with commands of two words, beside the command that the first word alone is."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Take the first two words for one where they are a command, or nearly one."""
        both = " ".join(args[:2])
        if both in self.commands:
            return super().resolve_command(ctx, [both, *args[2:]])
        second_words = [name.split()[1] for name in self.commands if name.startswith(f"{args[0]} ")]
        # What is written as a path is none of them, whether it is there or not.
        if second_words and len(args) > 1 and "/" not in args[1] and not Path(args[1]).exists():
            from noise_model.spelling import nearest

            near = nearest(args[1], second_words)
            if near is not None:
                ctx.fail(f"No such command {both!r}. Did you mean '{args[0]} {near}'?")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the command; of one that says nothing of its own, Ctrl-C says its name."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            name = f"arctrack {ctx.invoked_subcommand}"
            raise InterruptedCommandError(f"{name} interrupted; what it had finished stays") from None
        except (EOFError, BrokenPipeError) as error:
            raise UnexpectedEndError(error) from error
