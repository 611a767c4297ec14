"""Compiled programs kept on disk, by JAX's own cache.

The name of a program that runs on its own enters; JAX then keeps what it compiles in a folder of
the user's, so that a later process only has to trace. A library does not do so by itself: the
setting is the whole process's.
"""

import os
import sys
from pathlib import Path

import jax


def keep_compiled_programs(name: str) -> None:
    """Keep compiled programs in the user's folder for caches, under `name`, unless JAX has been
    told of a folder or none can be made."""
    if jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        return
    folder = user_cache() / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # By default JAX keeps only what took a second.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def user_cache() -> Path:
    """Where this platform has caches: `XDG_CACHE_HOME` or ~/.cache, ~/Library/Caches,
    `LOCALAPPDATA`."""
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    name, otherwise = "XDG_CACHE_HOME", Path.home() / ".cache"
    if sys.platform == "win32":
        name, otherwise = "LOCALAPPDATA", Path.home() / "AppData" / "Local"
    return Path(os.environ.get(name) or otherwise)
