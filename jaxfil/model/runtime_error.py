"""Errors at run time that start with their sentence.

Where the flags of failure are known, as under `jax.vmap` and `jax.grad` alone, the message is the
sentence alone. Under `jax.jit` JAX adds its own stack to an error from a callback, but first logs
the failure; this module replaces the logged text by the sentence.
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
    """The same value, or an error with the last of these sentences whose flag is set in any lane of
    a batch."""
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
    """Reduces JAX's log record of a failed callback to one of these sentences."""

    def filter(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        sentence = str(error).partition("\n")[0]
        if sentence in _SENTENCES:
            record.msg, record.args, record.exc_info = sentence, (), None
        return True


# A version of JAX that logs elsewhere shows its own text.
logging.getLogger(jax.__name__ + "._src.callback").addFilter(_SentenceOnly())
