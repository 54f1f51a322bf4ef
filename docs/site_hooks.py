"""What the documentation site has beyond its Markdown files: measured tables where a page refers to them.

A line that is nothing but a link to a section of results.md is followed, on the site, by that section's table, which a
command wrote. In a repository's view of the page it is a link.
"""

import re
from pathlib import Path
from typing import Any

from markdown.extensions.toc import slugify

REFERENCE = re.compile(r"^\[[^\]\n]+\]\(results\.md#([\w-]+)\)$", re.MULTILINE)


def on_page_markdown(markdown: str, config: Any, **_: Any) -> str:
    """The page with the tables that it refers to; links to sections that do not exist stay, for MkDocs to report."""
    if not REFERENCE.search(markdown):
        return markdown
    tables = tables_of(Path(config.docs_dir, "results.md").read_text(encoding="utf-8"))
    return REFERENCE.sub(lambda found: f"{found[0]}\n\n{tables.get(found[1], '')}", markdown)


def tables_of(results: str) -> dict[str, str]:
    """The table of each section of results.md, by the anchor of its heading."""
    tables = {}
    for section in results.split("\n## ")[1:]:
        title, _, text = section.partition("\n")
        tables[slugify(title, "-")] = "\n".join(line for line in text.splitlines() if line.startswith("|"))
    return tables
