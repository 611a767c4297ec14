"""The README as text: its blocks of code and its links."""

import re

from tests import ROOT

README = (ROOT / "README.md").read_text()
LINKS = re.findall(r"\]\(([^)]+)\)", README)


def blocks(language):
    """The blocks of code in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.M | re.S)
