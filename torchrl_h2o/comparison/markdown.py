"""Tables in Markdown."""

from collections.abc import Iterable, Sequence


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a table with a line for each row.

    Example:
        >>> print(markdown_table(["method", "return"], [["IQL", "18"]]))
        | method | return |
        | --- | --- |
        | IQL | 18 |
    """
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
