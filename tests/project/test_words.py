"""Prose of the package, of its messages and of its site: how often it is hard to read.

Each construction has a bound, in occurrences per 10,000 words. `MEASURED` has the values of diffrax
0.7.2, by `counts` of all docstrings and comments of its package (19,232 words). Bounds are a little
higher, and a short text may have one occurrence more.
"""

import ast
import io
import re
import tokenize

import pytest

from tests import ROOT
from tests.project.repository import need

need("docs", "README.md")
PACKAGE = ROOT / "jaxfil"

CONSTRUCTIONS = {
    "told, tells": r"\b(?:told|tells?|telling)\b",
    "met, meets": r"\b(?:met|meets?|meeting)\b",
    "led, leads": r"\b(?:led|leads?)\b",
    "kept, keeps": r"\b(?:kept|keeps?|keeping)\b",
    "left": r"(?<!from )(?<!\()\bleft\b(?!-|, right)",
    "owed": r"\bow(?:ed|es?)\b",
    "made": r"\bmade\b",
    "found": r"\bfound\b",
    "besides": r"\b(?:besides|anew|of late)\b",
    "that of": r"\b(?:that|those) of\b",
    "nothing, none": r"\b(?:[Nn]othing|none)\b",
    "so many": r"\bso (?:many|much|few)\b",
    "as it is": r"(?<!soon )\bas (?:it|they) (?:is|are|stands?|comes?)\b",
    "comes to its end": r"\bcom(?:es?|ing) to (?:its|their|an) end\b",
    "enters; leaves": r"\b[Ee]nters?\b|(?<![Ff]loat )\b[Ll]eaves?(?=[.,;:])",
    "what": r"\b[Ww]hat\b",
    "and so": r"\band so\b(?! (?:do|does|is|are|has|did)\b)",
    "colon": r"\w: [a-z]",
}
MEASURED = {
    "told, tells": 0.0,
    "met, meets": 0.0,
    "led, leads": 0.5,
    "kept, keeps": 5.7,
    "left": 3.6,
    "owed": 0.0,
    "made": 7.3,
    "found": 1.6,
    "besides": 0.5,
    "that of": 0.0,
    "nothing, none": 1.6,
    "so many": 0.5,
    "as it is": 2.6,
    "comes to its end": 0.0,
    "enters; leaves": 0.5,
    "what": 9.9,
    "and so": 0.5,
    "colon": 36.4,
}
BOUNDS = {
    "told, tells": 2,
    "met, meets": 2,
    "led, leads": 2,
    "kept, keeps": 8,
    "left": 5,
    "owed": 1,
    "made": 9,
    "found": 3,
    "besides": 2,
    "that of": 3,
    "nothing, none": 3,
    "so many": 2,
    "as it is": 4,
    "comes to its end": 1,
    "enters; leaves": 2,
    "what": 12,
    "and so": 2,
    "colon": 45,
}

ROOMS = sorted(file.parent.name for file in PACKAGE.glob("*/__init__.py"))


def words(text):
    return len(re.findall(r"[A-Za-z][A-Za-z'-]+", text))


def plain(text):
    """Text without code, formulas, addresses, headings and the terms that lists explain."""
    text = re.sub(r"^ *(`{3,})[^\n]*\n.*?^ *\1 *$", "", text, flags=re.M | re.S)
    text = re.sub(r"\$\$.*?\$\$|\$[^$\n]+\$", "$", text, flags=re.S)
    text = re.sub(r"`[^`]+`", "`", text)
    text = re.sub(r"^#+ .*$|^ *- [^:\n]{1,40}(?=: )", "", text, flags=re.M)
    text = re.sub(r"^ *(?:>>>|\.\.\.) .*$|^:::.*(?:\n +.*)*", "", text, flags=re.M)
    text = re.sub(r"\]\([^)]*\)|\]\[[^]]*\]", "]", text)
    return re.sub(r"\s+", " ", text)


def docstrings_and_comments(source):
    """All docstrings of a file, and runs of comment lines joined."""
    for node in ast.walk(ast.parse(source)):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            yield node.value.value
    comments = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not re.match(r"# ?(pyright|noqa):", token.string):
            comments.append(token.string.lstrip("# "))
    yield "\n".join(comments)


def messages(source):
    """All literals of a file that a user may read as a sentence, with `x` in place of values."""
    tree = ast.parse(source)
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    formatted = [node for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)]
    parts = {id(part) for node in formatted for part in node.values}
    texts = [
        "".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in node.values)
        for node in formatted
    ]
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            texts += [node.value] if id(node) not in docstrings | parts else []
    for text in texts:
        if " must " in text or (text.endswith(".") and text.count(" ") > 2):
            yield text


def occurrences(texts):
    """The number of each construction in texts, and the number of words."""
    text = "\n".join(plain(text) for text in texts)
    found = {name: len(re.findall(pattern, text)) for name, pattern in CONSTRUCTIONS.items()}
    return found, words(text)


def counts(texts):
    """Occurrences of each construction per 10,000 words."""
    found, number = occurrences(texts)
    return {name: 1e4 * n / number for name, n in found.items()}


def too_many(texts):
    """Constructions above their bound by more than one occurrence."""
    found, number = occurrences(texts)
    return {name: n for name, n in found.items() if n > BOUNDS[name] * number / 1e4 + 1}


def test_bounds_are_those_of_plain_prose():
    assert [*BOUNDS] == [*MEASURED] == [*CONSTRUCTIONS]
    assert all(MEASURED[name] <= BOUNDS[name] <= MEASURED[name] + 9 for name in BOUNDS)


def test_a_construction_is_seen():
    dialect = "What it is told enters; none leaves. It is met, and so kept as it is: nothing more."
    assert {"what", "told, tells", "met, meets", "colon"} <= {*too_many([dialect, dialect])}
    plain_text = "# What `is` it?\n- term: an explanation\n```python\nwhat: none\n```\n$what: is$"
    assert too_many([plain_text + " The solver raises an error."]) == {}


def test_the_site_is_in_plain_words():
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    # Generated tables of benchmarks.
    pages = [page for page in pages if "measured" not in page.parts]
    assert too_many(page.read_text() for page in pages) == {}


def prose(folder, texts=docstrings_and_comments):
    for file in sorted(folder.rglob("*.py")):
        yield from texts(file.read_text())


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_is_in_plain_words(room):
    assert too_many(prose(PACKAGE / room)) == {}


def test_messages_are_in_plain_words():
    assert too_many(prose(PACKAGE, messages)) == {}


def test_a_message_is_seen():
    source = """def f(x):
    "It must be a docstring."
    raise ValueError(f"`x` must be None: what is {x} left for?" if x else "Try a larger `x`.")"""
    assert sorted(messages(source)) == [
        "Try a larger `x`.",
        "`x` must be None: what is x left for?",
    ]
