"""The examples of public docstrings, and the pages of the site, as a reader pastes them, where
nothing is set.

Run as a program; names may be given, as `jaxfil.solve` or `how-to/rest.md`. Each starts with
nothing imported, in JAX's own precision. What fails is printed, and the exit status says whether
something did.
"""

import doctest
import sys
import traceback
import types

import jax
import matplotlib.pyplot as plt

from tests.project.test_docs import PAGES, run
from tests.project.test_docstrings import CLASSES, FUNCTIONS, SYSTEMS


def failed_examples(value, name):
    """How many examples of a docstring fail, without what their modules import."""
    runner = doctest.DocTestRunner(verbose=False)
    for test in doctest.DocTestFinder(exclude_empty=True).find(value, name, globs={}):
        runner.run(test)
    return runner.failures


def failed_page(page, name):
    """Whether a script of a page fails, or prints something else."""
    # What is defined on a page is looked for in its module, by pickle as by Equinox.
    module = sys.modules["page"] = types.ModuleType("page")
    try:
        run(page, module)
    except Exception:
        print(f"{name}:", traceback.format_exc())
        return True
    finally:
        plt.close("all")
    return False


DOCUMENTED = {**FUNCTIONS, **CLASSES, **SYSTEMS}
NAMES = [*DOCUMENTED, *PAGES]


def main():
    """Run the examples that are asked for, by default all."""
    fails, before = False, jax.config.jax_enable_x64
    checks = {name: (failed_examples, value) for name, value in DOCUMENTED.items()}
    checks |= {name: (failed_page, page) for name, page in PAGES.items()}
    for name in sys.argv[1:] or NAMES:
        check, value = checks[name]
        jax.config.update("jax_enable_x64", before)
        fails = bool(check(value, name)) or fails
    sys.exit(fails)


if __name__ == "__main__":
    main()
