"""The tests. `ROOT` is the folder of the repository."""

from pathlib import Path

from tests.typecheck import inner as inner

ROOT = Path(__file__).parent.parent
