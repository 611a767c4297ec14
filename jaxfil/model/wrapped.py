"""Systems made of another system."""

from jaxtyping import Array

from jaxfil.model.clock import Clocks
from jaxfil.model.system import System


class Wrapped(System):
    """A system made of another one, with its period, its clocks and its kinds of events."""

    system: System

    @property
    def slides(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.system.slides

    @property
    def resets(self) -> bool:
        return self.system.resets

    @property
    def ticks(self) -> bool:
        return self.system.ticks

    @property
    def feels_reactions(self) -> bool:
        return self.system.feels_reactions

    @property
    def period(self) -> Array | float | None:
        return self.system.period

    @property
    def clocks(self) -> Clocks:
        return self.system.clocks
