"""jaxfil beside what else a user could pick; see `python -m benchmarks.throughput`."""
