"""Pieces of HTML for the page; what comes from files or people goes through `text`."""

from html import escape as text

__all__ = ["block", "hint", "text"]

MARGIN = "margin:0.25em 0.75em;overflow-wrap:anywhere"


def block(name: str, inner: str, style: str = "") -> str:
    """A block that tests and scripts find as [data-lfd-NAME]."""
    return f'<div data-lfd-{name} style="{MARGIN};{style}">{inner}</div>'


def hint(inner: str) -> str:
    """What a mode is about."""
    return f'<div style="{MARGIN};font-size:0.85em;opacity:0.8">{inner}</div>'
