"""MkDocs hooks: generated pages, links into the repository, equations as MathML."""

import html
import os
import re
import sys
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs"))  # hooks are loaded by path, not as a package

from config_reference import config_reference  # noqa: E402

# Pages that are files of the repository; where they lie decides what their links mean.
TOP_LEVEL = {
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "security.md": "SECURITY.md",
    "benchmarks.md": "benchmarks/README.md",
}
PAGES = {source: page for page, source in TOP_LEVEL.items()} | {"README.md": "index.md"}

LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)\s:]+)\)")
# Code, in which nothing is a link.
CODE = re.compile(r"(^```.*?^```|^(?: {4}[^\n]*\n?)+|`[^`\n]*`)", re.MULTILINE | re.DOTALL)
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_files(files, config):
    """Add the pages that are generated, or lie elsewhere in the repository."""
    contents = {page: (ROOT / source).read_text() for page, source in TOP_LEVEL.items()}
    contents["config.md"] = config_reference()
    for page, content in contents.items():
        if stub := files.get_file_from_path(page):  # for readers of the repository
            files.remove(stub)
        files.append(File.generated(config, page, content=content))
    return files


def on_page_markdown(markdown, page, config, files):
    """Links into the repository become links to pages, or the path that they lead to."""
    uri = page.file.src_uri
    folder = (ROOT / TOP_LEVEL.get(uri, f"docs/{uri}")).parent

    def resolve(match):
        text, (path, _, anchor) = match[1], match[2].partition("#")
        if not path or uri.startswith("api/"):
            return match[0]
        target = os.path.relpath(folder / path, ROOT)
        linked = PAGES.get(target, target.removeprefix("docs/"))
        if files.get_file_from_path(linked):
            relative = os.path.relpath(linked, os.path.dirname(uri) or ".")
            return f"[{text}]({relative}{'#' + anchor if anchor else ''})"
        if (ROOT / target).exists():
            return text if target.rstrip("/") in text else f"{text} (`{target}`)"
        return match[0]  # MkDocs complains about it

    parts = CODE.split(f"{markdown}\n")
    # A link whose text is code was cut in pieces: links are found on the whole again.
    whole, codes = [], []
    for index, part in enumerate(parts):
        if index % 2:
            codes.append(part)
            part = f"\0{len(codes) - 1}\0"
        whole.append(part)
    text = LINK.sub(lambda m: resolve(_restored(m, codes)), "".join(whole))
    return re.sub("\0(\\d+)\0", lambda m: codes[int(m[1])], text)


def _restored(match, codes):
    """The match with its code put back."""
    return LINK.match(re.sub("\0(\\d+)\0", lambda m: codes[int(m[1])], match[0]))


def on_page_content(content, page, config, files):
    """Equations as MathML, which browsers draw alone; docstrings without marks of Sphinx."""
    if page.file.src_uri.startswith("api/"):
        content = content.replace("<p>::</p>", "").replace("::</p>", ":</p>")
        content = re.sub(r":(?:class|func|meth):(?=<code>)", "", content)
    return EQUATION.sub(_mathml, content)


def _mathml(match):
    display = "block" if match[2] == "[" else "inline"
    tex = re.sub(r"\\tag\{(.*?)\}", r"\\qquad(\1)", html.unescape(match[3]).strip())
    mathml = convert(tex, display=display)
    # The dots of time derivatives are too faint to read otherwise.
    return re.sub(r"<mo>(&#x002D9;|&#x000A8;)</mo>", r'<mo class="dots">\1</mo>', mathml)
