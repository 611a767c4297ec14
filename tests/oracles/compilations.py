"""How often JAX traces and compiles anything, as JAX itself reports it."""

EVENTS = {
    "/jax/core/compile/jaxpr_trace_duration": "traces",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lowerings",
    "/jax/core/compile/backend_compile_duration": "compilations",
}


class Counter:
    """How often JAX traced and compiled anything, and the seconds that took in all."""

    def __init__(self):
        self.counts = dict.fromkeys((*EVENTS.values(), "seconds"), 0)

    def watch(self):
        """Begin to count."""
        # A process of the benchmarks may not use JAX at all.
        import jax

        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def _heard(self, event, duration, **_):
        """Count one event of JAX."""
        if event in EVENTS:
            self.counts[EVENTS[event]] += 1
            self.counts["seconds"] += duration

    def since(self, before):
        """What has been counted since a copy of `counts`."""
        return {name: count - before[name] for name, count in self.counts.items()}
