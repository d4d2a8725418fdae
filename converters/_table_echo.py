"""Messages as `rostopic echo` and `ros2 topic echo` print them.

Fields stand below one another, with `---` between messages.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from ._table_numbers import is_number

BETWEEN = "---"
FIELD = re.compile(r"(?P<indent> *)(?P<item>- )?((?P<name>[A-Za-z_]\w*):(?!\S))?[ ]*(?P<value>.*)")
LEAST_MESSAGES, LEAST_NUMBERS = 3, 4  # in a text, and in a message


def of_echo(text: str) -> tuple[str, int]:
    """The messages as a table of text, and how many are left out; empty for any other text."""
    if text.count(f"\n{BETWEEN}") < LEAST_MESSAGES:
        return "", 0
    messages = [dict(_fields(part)) for part in re.split(rf"^{BETWEEN}\s*$", text, flags=re.MULTILINE)]
    messages = [message for message in messages if message]
    names = list(messages[0]) if messages else []
    rows = [[message[name] for name in names] for message in messages if {*message} >= {*names}]
    if len(names) < LEAST_NUMBERS or len(rows) < LEAST_MESSAGES:
        return "", 0
    return "\n".join("\t".join(row) for row in [names, *rows]) + "\n", len(messages) - len(rows)


def _fields(message: str) -> Iterator[tuple[str, str]]:
    """Names and numbers of a message's fields, with dots between the names of nested ones."""
    above: list[tuple[int, str]] = []
    count = 0
    for line in message.splitlines():
        match = FIELD.fullmatch(line.rstrip())
        if match is None or not (match["name"] or match["item"] or match["value"]):
            continue
        indent, value = len(match["indent"]), match["value"].strip("'\"")
        if match["item"]:  # of a list, which may stand as far left as its name
            if above and is_number(value):
                yield f"{'.'.join(name for _, name in above)}[{count}]", value
            count += 1
            continue
        above, count = [each for each in above if each[0] < indent], 0
        if match["name"] is None:
            continue
        name = ".".join([*(each for _, each in above), match["name"]])
        numbers = re.split(r",\s*", value[1:-1]) if value.startswith("[") and value.endswith("]") else []
        if not value:
            above.append((indent, match["name"]))
        elif is_number(value):
            yield name, value
        elif numbers and all(map(is_number, numbers)):
            yield from ((f"{name}[{place}]", number) for place, number in enumerate(numbers))
