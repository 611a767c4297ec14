"""Every kind of picture looks as it did when somebody last looked at it.

`python -m tests.pictures` draws the references in `tests/references` anew; look at each before it
is committed. The pictures are compared without words, and the words as text.
"""

import inspect
import json

import pytest
from matplotlib.testing.compare import compare_images

import jaxfil as jf
from tests.pictures import FOLDER, PICTURES, WORDS, draw

# Root mean square over the pixels, of 255. Another rasteriser's edges stay below; a marker that is
# missing or a line of another width does not.
TOLERANCE = 1.0


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_is_the_one_that_was_looked_at(name, tmp_path):
    told = draw(name, tmp_path / f"{name}.png")
    assert told == json.loads(WORDS.read_text())[name]
    reference, drawn = (str(folder / f"{name}.png") for folder in (FOLDER, tmp_path))
    assert compare_images(reference, drawn, TOLERANCE) is None


def test_every_picture_has_a_reference():
    drawing = {name for name, value in vars(jf.plot).items() if inspect.isfunction(value)}
    # `explore` shows the pictures of others.
    assert drawing - {"page", "explore"} == set(PICTURES)
    assert {file.stem for file in FOLDER.glob("*.png")} == set(PICTURES)
