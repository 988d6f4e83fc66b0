"""Markdown tables, and numbers as they stand in them."""

from __future__ import annotations


def table(head: list[str], rows: list[list[str]]) -> str:
    """A table, with the empty lines that Markdown wants around it."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def commands(lines: list[str]) -> str:
    """Commands as an indented block."""
    return "\n" + "\n".join(f"    {line}" for line in lines) + "\n"


def number(value: float) -> str:
    """Two digits: 0.0018, 0.80, 45."""
    exponent = int(f"{value:e}".split("e")[1])
    return f"{value:.{max(0, 1 - exponent)}f}"


def bold(text: str, condition: bool) -> str:
    return f"**{text}**" if condition else text
