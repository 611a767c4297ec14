"""What of the repository a test file needs beside `jaxfil` and `tests`."""

import pytest

from tests import ROOT


def need(*names):
    """Skip the file that asks for this if it is run from a release, whose sources lack a folder."""
    missing = [name for name in names if not (ROOT / name).exists()]
    if missing:
        reason = f"it is about {', '.join(missing)}, which the sources of a release do not have"
        pytest.skip(reason, allow_module_level=True)
