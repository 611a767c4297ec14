"""Compiled programs stored on disk, by JAX's own cache.

A program such as the command line asks for it, so that later processes only have to trace. The
library does not do so by itself, since the setting applies to the whole process.
"""

import os
import sys
from pathlib import Path

import jax


def keep_compiled_programs(name: str) -> None:
    """Store compiled programs in the user's cache folder, under `name`, unless JAX already has a
    folder or this one cannot be created."""
    if jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        return
    folder = user_cache() / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # JAX's default stores only programs that took a second to compile.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def user_cache() -> Path:
    """The platform's folder for caches: `XDG_CACHE_HOME` or ~/.cache, ~/Library/Caches,
    `LOCALAPPDATA`."""
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    name, otherwise = "XDG_CACHE_HOME", Path.home() / ".cache"
    if sys.platform == "win32":
        name, otherwise = "LOCALAPPDATA", Path.home() / "AppData" / "Local"
    return Path(os.environ.get(name) or otherwise)
