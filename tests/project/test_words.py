"""Prose of the package and of its site: how often constructions of a dialect occur.

Each construction has a bound, in occurrences per 10,000 words. The bounds come from diffrax: the docstrings and
comments of its package (version 0.7.2), measured by `counts` below.
"""

import ast
import io
import re
import tokenize

import pytest

from tests import ROOT
from tests.project.repository import need

need("docs", "README.md")

CONSTRUCTIONS = {
    "told, tells": r"\b(?:told|tells?|telling)\b",
    "met, meets": r"\b(?:met|meets?|meeting)\b",
    "led, leads": r"\b(?:led|leads?)\b",
    "kept, keeps": r"\b(?:kept|keeps?|keeping)\b",
    "left": r"\bleft\b(?!-)",
    "owed": r"\bow(?:ed|es?)\b",
    "made": r"\bmade\b",
    "found": r"\bfound\b",
    "besides": r"\b(?:besides|anew|of late)\b",
    "that of": r"\b(?:that|those) of\b",
    "nothing, none": r"\b(?:[Nn]othing|none)\b",
    "so many": r"\bso (?:many|much|few)\b",
    "as it is": r"\bas (?:it|they) (?:is|are|stands?|comes?)\b",
    "comes to its end": r"\bcom(?:es?|ing) to (?:its|their|an) end\b",
    "enters; leaves": r"\b(?:[Ee]nters?|[Ll]eaves?)\b",
    "what": r"\b[Ww]hat\b",
    "and so": r"\band so\b",
    "colon": r"\w: [a-z]",
}


def words(text):
    return len(re.findall(r"[A-Za-z][A-Za-z'-]+", text))


def plain(text):
    """Text without code, formulas and addresses."""
    text = re.sub(r"^ *(`{3,})[^\n]*\n.*?^ *\1 *$", "", text, flags=re.M | re.S)
    text = re.sub(r"\$\$.*?\$\$|\$[^$\n]+\$", "$", text, flags=re.S)
    text = re.sub(r"`[^`]+`", "`", text)
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
        if token.type == tokenize.COMMENT:
            comments.append(token.string.lstrip("# "))
    yield "\n".join(comments)


def counts(texts):
    """Occurrences of each construction per 10,000 words."""
    text = "\n".join(plain(text) for text in texts)
    number = words(text)
    return {
        name: 1e4 * len(re.findall(pattern, text)) / number
        for name, pattern in CONSTRUCTIONS.items()
    }
