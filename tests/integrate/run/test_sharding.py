"""Lanes spread over two CPU devices, in a process that has two, give what one device gives."""

import json
import os
import subprocess
import sys

import pytest

SCRIPT = """
import json

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import jaxfil as jf

jax.config.update("jax_enable_x64", True)
mesh, lanes = Mesh(np.array(jax.devices()), ("lanes",)), PartitionSpec("lanes")
omegas = jnp.linspace(0.6, 1.1, 16)


def end(omega, max_events):
    system = jf.systems.SDOscillator(omega=omega)
    options = dict(stepper=jf.RK4(), max_events=max_events, throw=False)
    return jf.solve(system, jnp.array([0.3, 0.1]), 0.0, 4.0, 0.2, **options).x_final


found = {}
for max_events in (8, None):
    run = jax.vmap(lambda omega: end(omega, max_events))
    one = jax.jit(run)(omegas)
    spread = jax.device_put(omegas, NamedSharding(mesh, lanes))
    several = jax.jit(run)(spread)
    mapped = jax.shard_map(run, mesh=mesh, in_specs=lanes, out_specs=lanes, check_vma=False)
    apart = jax.jit(mapped)(spread)
    found[str(max_events)] = [bool(jnp.allclose(v, one, rtol=1e-12)) for v in (several, apart)]
try:
    mapped = jax.shard_map(run, mesh=mesh, in_specs=lanes, out_specs=lanes)
    jax.jit(mapped)(spread)
except ValueError as error:
    found["refused"] = str(error)
print(json.dumps(found))
"""


@pytest.mark.release
def test_a_batch_spread_over_devices_is_that_of_one_or_refused_by_name():
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        env={**os.environ, "XLA_FLAGS": flags},
        capture_output=True,
        text=True,
        check=True,
    )
    found = json.loads(done.stdout)
    assert found.pop("refused").startswith("`check_vma` of `jax.shard_map` must be False")
    assert found == {"8": [True, True], "None": [True, True]}
