"""Write the tables of the README and of the documentation, after results/ has changed.

python -m docs.tables
"""

from docs.tables.pages import PAGES, filled
from docs.tables.paper import FIGURE, draw

for page, tables in PAGES.items():
    page.write_text(filled(page.read_text(), tables()))
    print(f"wrote {page}")
draw(FIGURE)
print(f"wrote {FIGURE}")
