"""Prints docs/reference/setup_keys.md: `python docs/keys_table.py > docs/reference/setup_keys.md`."""

from itertools import groupby

from arctrack.recording.new import KEYS

HEAD = """# The keys of a setup

What each number of `recording.toml` is, where it comes from, and what it usually is. `arctrack new` writes
the same beside each key. [Recordings](recording.md#recordingtoml) says which may be left out.
"""


def setup_keys() -> str:
    """Return the page: a list for each section of the setup."""
    lines = [HEAD]
    for section, keys in groupby(KEYS, key=lambda key: key.table):
        lines += [f"## [{section}]", ""]
        for key in keys:
            source = f"*{key.source.value}*: {key.how}" if key.how else f"*{key.source.value}*."
            lines.append(f"- `{key.name}`: {key.meaning} From {source} Usual: {key.typical}.")
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    print(setup_keys(), end="")
