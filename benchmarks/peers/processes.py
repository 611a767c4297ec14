"""Processes for the peers whose lanes run one after the other: a number of cores enters, as many
processes leave."""

import concurrent.futures
import functools


@functools.cache
def pool(cores):
    """The processes, one for each core; they stay for later calls."""
    return concurrent.futures.ProcessPoolExecutor(cores)


def prepare(cores):
    """Start the processes, before any clock runs."""
    if cores > 1:
        list(pool(cores).map(abs, range(4 * cores)))


def run(function, jobs, cores):
    """What the function gives for each job, a tuple of arguments, in the order of the jobs."""
    each = map if cores == 1 else pool(cores).map
    return list(each(function, *zip(*jobs, strict=True)))
