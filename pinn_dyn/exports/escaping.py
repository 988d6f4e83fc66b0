"""Text from outside, such as names of columns, in generated files."""

from __future__ import annotations

import re

_UNSAFE = re.compile(r"[^A-Za-z0-9 _.,:;=^+()\[\]{}/-]|(?<=-)-")
"""Characters other than ASCII letters, digits and a few marks, and the end of ``--``."""


def c_text(text: str) -> str:
    r"""Return text for a string or a comment in C, which it cannot end.

    A character that could be special becomes octal escapes such as ``\042``, one for each byte in
    UTF-8. The string has the bytes of the text, also for a compiler with trigraphs.
    """
    return _escaped(text.encode().decode("latin-1"), "\\{:03o}")


def xml_comment(text: str) -> str:
    """Return text for a comment in XML, with references such as ``&#62;`` for special characters.

    :func:`html.unescape` returns the original.
    """
    return _escaped(text, "&#{};")


def _escaped(text: str, form: str) -> str:
    return _UNSAFE.sub(lambda match: form.format(ord(match[0])), text)
