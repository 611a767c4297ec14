"""Measurements of jaxfil, beside other programs and against answers that come from elsewhere."""

from pathlib import Path

RESULTS = Path(__file__).parent / "results"
"""Where the programs of this folder leave their tables and pictures."""
