"""Errors at run time, their sentence first.

A value, flags of failure and sentences enter; the same value leaves, or the error. Where the flags
are known, as they are under `jax.vmap` and `jax.grad` alone, it is the sentence and nothing else.
Under `jax.jit` JAX puts its own stack around what a callback raises; but before that it logs the
failure, and what is logged is made the sentence here.
"""

import logging
from collections.abc import Sequence
from typing import Any, TypeVar

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from equinox import EquinoxRuntimeError

from jaxfil.xla.known import is_known

_Tree = TypeVar("_Tree")

_SENTENCES: set[str] = set()


def raise_first(value: _Tree, failures: Sequence[tuple[Any, str]]) -> _Tree:
    """The same value, or an error with the last of those sentences whose flag is set, in any lane
    of a batch."""
    _SENTENCES.update(sentence for _, sentence in failures)
    flags = [np.any(v) if is_known(v) else eqxi.unvmap_any(v) for v, _ in failures]
    if is_known(flags):
        failed = np.flatnonzero(flags)
        if failed.size:
            raise EquinoxRuntimeError(failures[failed[-1]][1])
        return value
    several = jnp.stack(flags)
    last = len(flags) - 1 - jnp.argmax(several[::-1])
    return eqxi.branched_error_if(value, jnp.any(several), last, [text for _, text in failures])


class _SentenceOnly(logging.Filter):
    """JAX's record of a failed callback, of one of these sentences made that alone."""

    def filter(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        sentence = str(error).partition("\n")[0]
        if sentence in _SENTENCES:
            record.msg, record.args, record.exc_info = sentence, (), None
        return True


# A version of JAX that logs elsewhere shows its own text.
logging.getLogger(jax.__name__ + "._src.callback").addFilter(_SentenceOnly())
