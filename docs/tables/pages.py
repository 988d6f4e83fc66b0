"""Pages with places for tables: ``<!-- table: name -->``, the table, ``<!-- end -->``."""

from __future__ import annotations

import re

from docs.tables import paper, results
from reproduce import ROOT

PLACE = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
PAGES = {
    ROOT / "docs" / "reproduction.md": paper.tables,
    **{ROOT / name: tables for name, tables in results.TABLES.items()},
}


def filled(page: str, tables: dict[str, str]) -> str:
    """The page with every table made anew.

    Raises:
        ValueError: if a table has no place, or a place no table.
    """
    places = {match[2] for match in PLACE.finditer(page)}
    if different := places ^ tables.keys():
        raise ValueError(f"a place without a table, or the reverse: {', '.join(sorted(different))}")
    return PLACE.sub(lambda match: f"{match[1]}{tables[match[2]]}\n{match[3]}", page)
