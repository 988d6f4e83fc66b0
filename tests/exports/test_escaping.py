"""Text from outside in generated files: it ends no string and no comment, and is read back."""

import codecs
import html
import json
import re
import string
import subprocess
import xml.etree.ElementTree as ET

from hypothesis import given, settings
from hypothesis import strategies as st

from pinn_dyn.exports.escaping import c_text, xml_comment
from pinn_dyn.exports.exported_function import write
from tests.exports.test_c_file import SINE
from tests.support.c_code import STRICT

TRICKS = [f"??{x}" for x in "=/'()!<>-"] + ["*/", "/*", "//", "--", "-->", "\\", '"', "\\\n"]
TRICKS += ["\r\n", "\0", "\u2028", "\x85", "%s%n", "${HOME}", "`id`", "%:%:", "é", "\U0001f916"]
TEXTS = st.lists(st.sampled_from([*map(chr, range(128)), *TRICKS])).map("".join)
SETTINGS = settings(max_examples=300, derandomize=True, deadline=None, database=None)


@SETTINGS
@given(TEXTS)
def test_text_in_c_has_octal_escapes_and_safe_marks_alone(text):
    escaped = c_text(text)
    assert re.fullmatch(r"(?:[\w .,:;=^+()\[\]{}/-]|\\[0-3][0-7]{2})*", escaped, re.ASCII)
    assert not any(end in escaped for end in ("??", "*/", "/*", '"', "\n", "--"))
    assert codecs.decode(escaped, "unicode_escape").encode("latin-1").decode() == text


@SETTINGS
@given(TEXTS)
def test_text_in_a_comment_of_xml_does_not_end_it(text):
    escaped = xml_comment(text)
    root = ET.fromstring(f"<robot><!-- {escaped} --><link/></robot>")
    assert [child.tag for child in root] == ["link"]
    if not re.search(r"[\0-\x1f\x7f-\x9f]", text):  # control characters are no text of HTML
        assert html.unescape(escaped) == text


def test_labels_do_not_end_the_string_of_a_c_file(tmp_path):
    """Today's attack: ??/ is a backslash in C99, so that the next label would be code."""
    attack = "; } __attribute__((constructor)) static void f(void) { puts(0); } /*"
    labels = ["??/", attack, '"\\', "\\", *TRICKS, string.printable, 'a "quoted" µ']
    path = write([SINE], tmp_path / "f.c", {"q": labels})
    main = '#include <stdio.h>\n#include "f.h"\nint main(void) { puts(f_info()); return 0; }\n'
    (tmp_path / "main.c").write_text(main)
    command = ["cc", *STRICT, "main.c", path.name, "-lm", "-o", "main"]
    subprocess.run(command, cwd=tmp_path, check=True)
    text = subprocess.run(tmp_path / "main", capture_output=True, text=True, check=True).stdout
    assert json.loads(text)["q"] == labels
