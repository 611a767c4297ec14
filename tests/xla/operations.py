"""The operations of a program: its jaxpr enters, their names leave."""

from jaxfil.xla.program import programs


def names(jaxpr):
    """The operations of a program, those inside of others included, each as often as it occurs."""
    for eqn in jaxpr.eqns:
        yield eqn.primitive.name
        yield from (name for inner in programs(eqn.params) for name in names(inner))
