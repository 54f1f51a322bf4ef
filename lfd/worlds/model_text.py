"""A model's elements as XML text: what `xml.etree` writes, in less than half the time.

Every recorded episode holds its model, so that this is part of the cost of recording.
"""

import re
import xml.etree.ElementTree as ET
from xml.sax.saxutils import escape

SPECIAL = re.compile(r'[&<>"\r\n\t]')
IN_ATTRIBUTES = {'"': "&quot;", "\r": "&#13;", "\n": "&#10;", "\t": "&#09;"}


def xml_text(root: ET.Element) -> str:
    """The text of an element without namespaces, as `xml.etree.ElementTree.tostring` has it."""
    parts: list[str] = []
    _write(root, parts)
    return "".join(parts)


def _write(element: ET.Element, parts: list[str]) -> None:
    parts.append(f"<{element.tag}")
    for key, value in element.items():
        parts.append(f' {key}="{escape(value, IN_ATTRIBUTES) if SPECIAL.search(value) else value}"')
    if element.text or len(element):
        parts.append(">")
        if element.text:
            parts.append(escape(element.text))
        for child in element:
            _write(child, parts)
        parts.append(f"</{element.tag}>")
    else:
        parts.append(" />")
    if element.tail:
        parts.append(escape(element.tail))
