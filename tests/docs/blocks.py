"""Code blocks of the documentation: fenced blocks, and commands in indented blocks."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    ROOT / "benchmarks" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
# Pages whose commands run from start to end: test_played_pages.py.
PLAYED = tuple(
    f"docs/{name}.md" for name in ("tutorial", "your_log", "from_log_to_controller", "your_robot")
)

_FENCE = re.compile(r"^( *)(`{3,})([\w+-]*)(.*)$")
_TITLE = re.compile(r'title="([^"]+)"')
_REASON = re.compile(r"<!-- not run: (\S.*?) -->$")
_COMMAND = re.compile(r"^(\w+=\S+ )*(python3?|make|pinn-dyn-\w+)( |$)", re.M)


@dataclass(frozen=True)
class Block:
    """A block of code.

    Attributes:
        page: file of the block.
        line: line of the first row.
        language: word after the fence; ``bash`` for indented commands.
        text: code.
        title: file that the block becomes, ``title="..."``.
        reason: text of ``<!-- not run: ... -->`` in the line before.
    """

    page: Path
    line: int
    language: str
    text: str
    title: str | None = None
    reason: str | None = None

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    def commands(self) -> list[list[str]]:
        """Return the words of each command; placeholders such as <date> are replaced."""
        text = re.sub(r"<[\w ]+>", "placeholder", self.text.replace("\\\n", " "))
        lines = [line for line in text.splitlines() if _COMMAND.match(line)]
        return [shlex.split(line, comments=True) for line in lines]


def blocks(page: Path) -> list[Block]:
    """Return all blocks of a page."""
    lines = page.read_text().splitlines()
    result = []
    index = 0
    while index < len(lines):
        opening = _FENCE.match(lines[index])
        start = index
        index += 1
        above = lines[start - 1].strip() if start else ""
        reason = _REASON.search(above or (lines[start - 2] if start > 1 else ""))
        text = reason[1] if reason else None
        if opening:
            indent, fence, language, options = opening.groups()
            while lines[index].strip() != fence:
                index += 1
            code = "\n".join(row.removeprefix(indent) for row in lines[start + 1 : index])
            index += 1
            title = _TITLE.search(options)
            name = title[1] if title else None
            result.append(Block(page, start + 2, language, code, name, text))
        elif lines[start].startswith("    ") and not above:
            while index < len(lines) and lines[index].startswith("    "):
                index += 1
            code = "\n".join(row.strip() for row in lines[start:index])
            if _COMMAND.search(code):
                result.append(Block(page, start + 1, "bash", code, reason=text))
    return result
