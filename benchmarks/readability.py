"""Readability of the text that people read in messages, help and screens: Flesch reading ease, sentence length.

    python benchmarks/readability.py                   # the working tree
    python benchmarks/readability.py --commit COMMIT   # the tree of a commit
    python benchmarks/readability.py --list            # every text, with its file and line

A text is a string literal of at least four words in `src/levkas` that is no docstring, a command's help (its
docstring), the text between the tags of a page's template, or a string of at least four words in
`frontend/src`. A value that is put in counts as one word. The documentation is the paragraphs of README.md and
docs/, without code, tables, generated pages and the development pages.

Flesch reading ease = 206.835 - 1.015 * words / sentences - 84.6 * syllables / words (R. Flesch, "A new readability
yardstick", J. Appl. Psychol. 32, 1948, doi:10.1037/h0057532). Syllables are groups of vowels, less a silent final e,
at least one a word. 60 to 70 is plain English, 30 to 50 is the text of a scientific paper.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

LEAST_WORDS = 4
WORD = re.compile(r"[A-Za-z][A-Za-z'’-]*")
SENTENCE_END = re.compile(r"[.!?](?=\s|$)|:\s+(?=[A-Z])|\n{2,}")
NOT_PROSE = re.compile(r"</|/>|\w=\"|\{\{|\\[dwbs(]|\(\?|;\s*\}|=>|CREATE |classDef|@media")
WORD_LISTS = ("words.py", "chart_names.py")
NO_PROSE_PAGES = ("docs/commands.md", "docs/benchmarks.md")
SCRIPT_STRING = re.compile(r'"((?:[^"\\\n]|\\.)*)"|`((?:[^`\\]|\\.)*)`')


class Text(NamedTuple):
    """One text that people read, with its place."""

    kind: str
    place: str
    text: str


class Figures(NamedTuple):
    """Readability of several texts."""

    texts: int
    words: int
    words_per_sentence: float
    reading_ease: float


def syllables(word: str) -> int:
    """Return the number of syllables of an English word, by its groups of vowels.

    >>> [syllables(w) for w in ("map", "window", "reference", "table", "the")]
    [1, 2, 3, 2, 1]
    """
    word = re.sub(r"[^a-z]", "", word.lower())
    groups = len(re.findall(r"[aeiouy]+", word))
    silent = re.search(r"[^aeiouyl]e$|[^aeiouydt]ed$|[^aeiouyscxzh]es$|[aeiouy]le$", word)
    return max(1, groups - bool(silent))


def figures(texts: list[str]) -> Figures:
    """Return the figures of texts taken together; each text ends its last sentence.

    >>> figures(["The cat sat on the mat."]).words_per_sentence
    6.0
    """
    words = sentences = beats = 0
    for text in texts:
        for sentence in SENTENCE_END.split(text):
            found = WORD.findall(sentence)
            words += len(found)
            sentences += bool(found)
            beats += sum(map(syllables, found))
    length = words / sentences
    return Figures(len(texts), words, length, 206.835 - 1.015 * length - 84.6 * beats / words)


def is_prose(text: str) -> bool:
    """Return whether a string has enough words in a row, and no code or markup."""
    return len(WORD.findall(text)) >= LEAST_WORDS and " " in text and not NOT_PROSE.search(text)


def strings_of(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and text of string literals that are no docstrings; values of an f-string become X."""
    if isinstance(tree, ast.JoinedStr):
        parts = [p.value if isinstance(p, ast.Constant) else "X" for p in tree.values]
        yield tree.lineno, "".join(map(str, parts))
        for value in tree.values:
            if isinstance(value, ast.FormattedValue):
                yield from strings_of(value.value)
    elif isinstance(tree, ast.Constant):
        if isinstance(tree.value, str):
            yield tree.lineno, tree.value
    else:
        for child in ast.iter_child_nodes(tree):
            loose = isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)
            if not loose:
                yield from strings_of(child)


def texts_of(root: Path) -> Iterator[Text]:
    """Yield every text of a source tree."""
    package = root / "src" / "levkas"
    for path in sorted(package.rglob("*.py")):
        if path.name in WORD_LISTS:
            continue
        tree, name = ast.parse(path.read_text()), str(path.relative_to(root))
        for line, text in strings_of(tree):
            if is_prose(text):
                yield Text("messages", f"{name}:{line}", text)
        if path.parent.name == "cli":
            for node in ast.walk(tree):
                if isinstance(node, ast.FunctionDef) and node.decorator_list:
                    help_text = (ast.get_docstring(node) or "").split("\f")[0]
                    if is_prose(help_text):
                        yield Text("help", f"{name}:{node.lineno}", help_text)
    for path in sorted(package.rglob("*.html")):
        text = re.sub(r"(?s)<(style|script).*?</\1>|{#.*?#}|<!--.*?-->", " ", path.read_text())
        text = re.sub(r"(?s){{.*?}}", "X", re.sub(r"(?s){%.*?%}", "", text))
        text = re.sub(r"</?(?:b|i|em|a|code|strong|sub|sup|span)\b[^>]*>", "", text)
        for part in re.split(r"<[^>]*>", text):
            if len(WORD.findall(part)) >= LEAST_WORDS:
                yield Text("pages", str(path.relative_to(root)), " ".join(part.split()))
    for path in sorted((root / "frontend" / "src").rglob("*.ts")):
        for found in SCRIPT_STRING.finditer(
            re.sub(r"(?m)^\s*(//|\*|/\*).*$", "", path.read_text())
        ):
            text = re.sub(r"\$\{[^}]*\}", "X", found[1] or found[2] or "")
            if is_prose(text) and not text.startswith((".", "#", "M")):
                yield Text("screens", str(path.relative_to(root)), text)


def paragraphs_of(page: str) -> Iterator[str]:
    """Yield the paragraphs and list items of a Markdown page, without code, tables, headings and addresses of links.

    >>> list(paragraphs_of("# Title\\n\\nA map has two [parts](a.md) here.\\n\\n| a | b |\\n"))
    ['A map has two parts here.']
    """
    page = re.sub(r"(?ms)^\s*(```|~~~).*?^\s*\1\s*$", "", page)
    page = re.sub(r"(?ms)^\$\$.*?^\$\$|<!--.*?-->|\{[a-z:]+\}(?=`)", "", page)
    page = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", page)
    page = re.sub(r"(?m)^\s*([|#<(]|:::).*$", "\n", page)
    for part in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.)\s", page):
        if len(WORD.findall(part)) >= LEAST_WORDS:
            yield " ".join(re.sub(r"`[^`]*`", "X", part).replace("*", "").split())


def documentation_of(root: Path) -> Iterator[Text]:
    """Yield every paragraph of the documentation of a source tree."""
    for path in [root / "README.md", *sorted((root / "docs").rglob("*.md"))]:
        name = path.relative_to(root).as_posix()
        if path.is_file() and name not in NO_PROSE_PAGES and "docs/development/" not in name:
            for text in paragraphs_of(path.read_text()):
                yield Text("documentation", name, text)


def main() -> None:
    """Print the figures of each kind of text, and of all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--commit", help="a commit to measure instead of the working tree")
    parser.add_argument("--list", action="store_true", help="print every text instead")
    options = parser.parse_args()
    root = Path(__file__).resolve().parent.parent
    with tempfile.TemporaryDirectory() as folder:
        if options.commit:
            packed = subprocess.run(
                [
                    "git",
                    "archive",
                    options.commit,
                    "src/levkas",
                    "frontend/src",
                    "docs",
                    "README.md",
                ],
                cwd=root,
                check=True,
                capture_output=True,
            ).stdout
            with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
                archive.extractall(folder, filter="data")
            root = Path(folder)
        texts = [*texts_of(root), *documentation_of(root)]
    if options.list:
        for one in texts:
            print(f"{one.kind}\t{one.place}\t{one.text!r}")
        return
    print(
        "| text | texts | words | words per sentence | Flesch reading ease |\n|---|---:|---:|---:|---:|"
    )
    for kind in (*dict.fromkeys(one.kind for one in texts), "all"):
        f = figures([one.text for one in texts if kind in (one.kind, "all")])
        print(
            f"| {kind} | {f.texts} | {f.words} | {f.words_per_sentence:.1f} | {f.reading_ease:.1f} |"
        )


if __name__ == "__main__":
    main()
