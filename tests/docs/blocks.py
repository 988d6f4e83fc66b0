"""The code blocks of the documentation: fenced ones, and commands in indented ones."""

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
# The pages that run from start to end, in the order of their blocks: test_played_pages.py.
PLAYED = ("docs/tutorial.md", "docs/your_log.md", "docs/your_robot.md")

_FENCE = re.compile(r"^( *)(`{3,})([\w+-]*)(.*)$")
_TITLE = re.compile(r'title="([^"]+)"')
_FILE = re.compile(r"`(conf/[\w/]+\.yaml)`[^`]*:$")
_REASON = re.compile(r"<!-- not run: (\S.*?) -->$")
# What a line of an indented block starts with if it is a command.
_COMMAND = re.compile(
    r"^(\w+=\S+ )*(python3?|make|pip|git|source|export|eval|cd|tensorboard|mlflow|wandb|jupyter"
    r"|sbatch|srun|torchrun|pytest|mkdocs|docker|curl|pinn-dyn-\w+)( |$)"
)


@dataclass(frozen=True)
class Block:
    """A block of code.

    Attributes:
        page: file that it is in.
        line: line of its first row.
        language: word behind the fence; ``bash`` for indented commands.
        text: the code.
        title: file that the page says it is, ``title="..."`` or named in the line before.
        reason: why it is not run, ``<!-- not run: ... -->`` in the line before.
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
        """The commands of a bash block, in words; what stands for something else is replaced."""
        text = self.text.replace("\\\n", " ")
        text = re.sub(r"<[\w ]+>", "placeholder", text)
        found = []
        for line in text.splitlines():
            words = shlex.split(line.removeprefix("$ "), comments=True)
            command: list[str] = []
            for word in [*words, ";"]:
                if word in ("&&", ";", "|"):
                    found.append([part for part in command if part != "..."])
                    command = []
                else:
                    command.append(word)
        return [command for command in found if command]


def blocks(page: Path) -> list[Block]:
    """All blocks of a page: fenced ones of any language, and indented ones of commands."""
    lines = page.read_text().splitlines()
    found = []
    index = 0
    while index < len(lines):
        opening = _FENCE.match(lines[index])
        start = index
        index += 1
        if opening:
            indent, fence, language, rest = opening.groups()
            while lines[index].strip() != fence:
                index += 1
            text = "\n".join(row.removeprefix(indent) for row in lines[start + 1 : index])
            index += 1
            title = _TITLE.search(rest) or _FILE.search(_before(lines, start))
            found.append(
                Block(
                    page,
                    start + 2,
                    language,
                    text,
                    title[1] if title else None,
                    _reason(lines, start),
                )
            )
        elif lines[start].startswith("    ") and not _before(lines, start, adjacent=True):
            while index < len(lines) and lines[index].startswith("    "):
                index += 1
            rows = [row.strip() for row in lines[start:index]]
            if _COMMAND.match(rows[0]):
                commands = "\n".join(row for row in rows if _COMMAND.match(row))
                found.append(Block(page, start + 1, "bash", commands, reason=_reason(lines, start)))
    return found


def _before(lines: list[str], index: int, adjacent: bool = False) -> str:
    """The line before a block, past an empty one unless it has to be adjacent."""
    above = lines[index - 1].strip() if index else ""
    return above if above or adjacent else (lines[index - 2].strip() if index > 1 else "")


def _reason(lines: list[str], index: int) -> str | None:
    found = _REASON.search(_before(lines, index))
    return found[1] if found else None
