"""Prints docs/reference/setup_keys.md: `python docs/keys_table.py > docs/reference/setup_keys.md`."""

from itertools import groupby

from arctrack.new import KEYS

HEAD = """# The keys of a setup

Each number of `recording.toml`, where it comes from, and what it usually is. `arctrack new` writes the same
beside each key. [Recordings](recording.md#recordingtoml) says which may be left out, and draws each joint's
dimensions.
"""


def setup_keys() -> str:
    """Return the page: a table for each section of the setup."""
    lines = [HEAD]
    for section, keys in groupby(KEYS, key=lambda key: key.table):
        lines += [
            f"## [{section}]",
            "",
            "| key | what it is | where it comes from | usual |",
            "| --- | --- | --- | --- |",
        ]
        for key in keys:
            source = f"**{key.source.value}** {key.how}".rstrip()
            lines.append(f"| `{key.name}` | {key.meaning} | {source} | {key.typical} |")
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    print(setup_keys(), end="")
