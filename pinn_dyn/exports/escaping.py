"""Escape text from outside, such as names of columns, for generated files."""

from __future__ import annotations

import re

_UNSAFE = re.compile(r"[^A-Za-z0-9 _.,:;=^+()\[\]{}/-]|(?<=-)-")
"""All characters except ASCII letters, digits and a few marks; and the second ``-`` of ``--``."""


def c_text(text: str) -> str:
    r"""Escape text for a string or a comment in C. The result cannot end the string or comment.

    A character that may be special becomes octal escapes such as ``\042``, one per byte in UTF-8.
    The string has the bytes of the text, also for a compiler with trigraphs.
    """
    return _escaped(text.encode().decode("latin-1"), "\\{:03o}")


def xml_comment(text: str) -> str:
    """Escape text for a comment in XML, by references such as ``&#62;`` for special characters.

    :func:`html.unescape` returns the original.
    """
    return _escaped(text, "&#{};")


def _escaped(text: str, form: str) -> str:
    return _UNSAFE.sub(lambda match: form.format(ord(match[0])), text)
