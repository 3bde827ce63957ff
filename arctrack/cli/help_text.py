"""Help texts without the line breaks of their source: a terminal breaks lines where its own width ends."""

import inspect

import typer


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
