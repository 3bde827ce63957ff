"""Prints the table of the setup's keys in docs/how_to/own_sensor.md; it goes between the page's marks."""

from arctrack.new import KEYS


def keys_table() -> str:
    """Return each key with its meaning, source and usual values."""
    rows = ["| key | what it is | where it comes from | usual |", "| --- | --- | --- | --- |"]
    for key in KEYS:
        source = f"**{key.source.value}** {key.how}".rstrip()
        rows.append(f"| `[{key.table}]` `{key.name}` | {key.meaning} | {source} | {key.typical} |")
    return "\n".join(rows) + "\n"


if __name__ == "__main__":
    print(keys_table(), end="")
