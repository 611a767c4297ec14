"""The base class of nonsmooth systems, an equinox module with parameters as float leaves."""

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfil.model import argument
from jaxfil.model.clock import Clocks
from jaxfil.model.fields import Replaceable, check_fields


class System(eqx.Module):
    r"""A set of smooth vector fields glued along surfaces.

    $$\dot x = F(t, x, \mathrm{side}), \qquad \mathrm{side}_j = \mathrm{sgn}\, H_j(t, x)$$

    Write a subclass with `vector_field`, and `switching` unless the system is smooth. Every float
    leaf is a parameter, including arrays, whose entries are named as "a[0,1]". Parameters may be
    swept, differentiated and batched, and new values never recompile. Any other number that the
    functions use, a global one or an attribute of the class, keeps the value of the first call.

    `reset` defines impacts; otherwise no impact code is compiled. `period` is the forcing period.
    A class that wraps another system forwards `slides`, `resets`, `feels_reactions`, `ticks`,
    `period` and `clocks` as properties.

    **Source**: A. F. Filippov, Differential Equations with Discontinuous Righthand Sides, Kluwer
    (1988), for the definition of a solution on a surface.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> class Relay(jf.System):
    ...     omega: jax.Array
    ...
    ...     state_names = "x", "x'"
    ...     symbols = {"omega": "Ω"}
    ...     units = {"x": "m", "x'": "m/s", "omega": "rad/s", "t": "s"}
    ...
    ...     def vector_field(self, t, x, side):
    ...         return jnp.stack([x[1], -x[0] - side + jnp.cos(self.omega * t)])
    ...
    ...     def switching(self, t, x):
    ...         return x[1]
    ...
    ...     @property
    ...     def period(self):
    ...         return 2 * jnp.pi / self.omega
    >>> relay = Relay(jnp.array(1.3))
    >>> sol = jf.solve(relay, jnp.array([3.0, 0.0]), 0.0, 2.0, 0.1, stepper=jf.RK4())
    >>> print(int(sol.mode_final[0]))  # it moves to the left, where x' < 0
    -1
    """

    slides: ClassVar[bool] = True
    """False for a system that only crosses its surfaces. The code for sliding is then not compiled,
    and a sliding region gives the outcome `undeclared_sliding`."""
    state_names: ClassVar[Sequence[str]] = ()
    """Names of components of the state in pictures and named arrays; by default x[0], x[1], …"""
    symbols: ClassVar[Mapping[str, str]] = {}
    """Symbols of parameters in pictures, by their names in the code; by default these names."""
    units: ClassVar[Mapping[str, str]] = {}
    """Units of components, parameters and the time `t`, by name; empty by default."""
    # Whether `vector_field` receives the mode of motion, for observed functions.
    _observes_mode: ClassVar[bool] = False
    # Numbers of `vector_field` whose square is the rate of the motion, taken after the blend of a
    # slide and the reactions of a rest.
    _squared: ClassVar[tuple[int, ...]] = ()

    def __check_init__(self):
        check_fields(self)

    @abc.abstractmethod
    def vector_field(self, t: Float[Array, ""], x: Float[Array, " n"], side: Array) -> Array:
        """F, shape (n,). `side` is exactly +1 or -1: a scalar if `switching` returns a scalar,
        of shape (m,) if it returns (m,).

        A fourth argument, `reaction`, of the shape of `side`, receives the force ≥ 0 with which
        each surface holds the motion while it rests there, and 0 for other surfaces. F must be
        affine in it and defines its effect. For a mass M on a table at y = 0, y″ = −g + reaction/M,
        and for dry friction there x″ = −μ reaction side/M. If y″ does not depend on the reaction,
        it is added there in the direction of the reset, as the acceleration d²H/dt² that it causes.
        """

    def switching(self, t: Float[Array, ""], x: Float[Array, " n"]) -> Array:
        """H, a scalar or shape (m,), whose zeros are the surfaces. By default the system is
        smooth."""
        return jnp.zeros((0,), x.dtype)  # without surfaces, no search for contacts is compiled

    def reset(
        self, t: Float[Array, ""], x: Float[Array, " n"], surface: Int[Array, ""]
    ) -> Float[Array, " n"]:
        """The state, shape (n,), just after an impact on surface number `surface`.

        H and its rates there determine the motion after it. It is reflected, passes through, is
        carried off the surface, or rests on it until its reaction would have to pull. For
        simultaneous contacts resets are applied one at a time, lowest number first, until the
        motion runs into no surface. A reflecting surface bounds the region H ≥ 0. A run that starts
        on it and moves towards H < 0 starts with an impact, one that moves away does not.
        """
        return x  # never called: a system without its own `reset` has no `resets`

    @property
    def resets(self) -> bool:
        """Whether contacts are impacts; by default True if the class defines `reset`. If False, the
        code for impacts is not compiled and `reset` is never called. A wrapper may therefore define
        `reset` for any system and forward that system's `resets`."""
        return type(self).reset is not System.reset

    def tick(
        self, t: Float[Array, ""], x: Float[Array, " n"], clock: Int[Array, ""]
    ) -> Float[Array, " n"]:
        """The state, shape (n,), just after a tick of clock number `clock` of `clocks`.

        It describes changes at known times, such as a sampled controller, a latch, a dose or a
        kick. Simultaneous ticks are applied one at a time, lowest clock number first. A state that
        it carries across a surface has a contact there at that time.
        """
        return x  # never called: a system without its own `tick` has no `ticks`

    @property
    def ticks(self) -> bool:
        """Whether the state changes at ticks; by default True if the class defines `tick`. If
        False, `tick` is never called, as with `resets`."""
        return type(self).tick is not System.tick

    @property
    def feels_reactions(self) -> bool:
        """Whether the field depends on reactions; by default True if `vector_field` has an argument
        `reaction`."""
        return takes_reaction(type(self).vector_field)

    @property
    def period(self) -> Array | float | None:
        """Period of the forcing in units of t; None if the system is autonomous. With several
        forces, the period at which to sample."""
        return None

    @property
    def clocks(self) -> Clocks:
        """The `Clock`s at whose ticks the field, H or the state jumps; () by default."""
        return ()


for _name, _own in [*vars(System).items()]:
    if isinstance(_own, property):
        setattr(System, _name, Replaceable(_own))
# Without the class variables, whose places a field of a subclass would take, before other fields.
System.__dataclass_fields__.clear()


def takes_reaction(function: Callable) -> bool:
    """Whether a function has an argument `reaction`."""
    signature = argument.signature_of(function)
    return signature is not None and "reaction" in signature.parameters


def field_of(
    system: System,
    t: Array,
    x: Array,
    side: Array,
    reaction: Array | None = None,
    mode: Array | None = None,
) -> Array:
    """F of a system, (n,), with or without reactions; None stands for no reactions. Only observed
    functions use the mode, of the shape of `side`; None stands for no slide or rest."""
    if not system.feels_reactions and not system._observes_mode:
        return system.vector_field(t, x, side)
    given = (jnp.zeros_like(side) if reaction is None else reaction,)
    if system._observes_mode:
        given += (side if mode is None else mode,)
    return system.vector_field(t, x, side, *given)


class _Piecewise(System):
    f_plus: Callable[[Array, Array], Array]
    f_minus: Callable[[Array, Array], Array]
    surface: Callable[[Array, Array], Array]
    _period: Array | float | None

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        if jnp.size(side) != 1:
            raise ValueError(
                "`switching` must return a scalar, since two fields have one surface, got shape "
                f"{jnp.shape(side)}. Write a jaxfil.System for any other number of surfaces."
            )
        # Both fields are evaluated and one is chosen, because lanes of a batch differ in side.
        return jnp.where(
            jnp.reshape(side, ()) > 0, self._part("f_plus", t, x), self._part("f_minus", t, x)
        )

    def _part(self, name: str, t: Array, x: Array) -> Array:
        out = getattr(self, name)(t, x)
        if not eqx.is_array(out) or out.shape != x.shape:
            was = getattr(out, "shape", type(out).__name__)
            raise ValueError(f"`{name}` must return a jax array of shape {x.shape}, got {was}.")
        return out

    def switching(self, t: Array, x: Array) -> Array:
        return self.surface(t, x)

    @property
    def period(self) -> Array | float | None:
        return self._period


def piecewise(
    f_plus: Callable[[Array, Array], Array],
    f_minus: Callable[[Array, Array], Array],
    switching: Callable[[Array, Array], Array],
    period: Array | float | None = None,
) -> System:
    """The system of two smooth fields on either side of one surface.

        ẋ = f_plus(t, x)  where H(t, x) > 0,    ẋ = f_minus(t, x)  where H(t, x) < 0

    It needs no class. Write a `System` for more surfaces, no surface, impacts or labels.

    **Arguments**

    - `f_plus`, `f_minus`: functions of the time, shape (), and the state, shape (n,), that return
      an array of the state's shape. All functions here may be equinox modules, whose float leaves
      are then parameters of the system, called `f_plus.name`, for example.
    - `switching`: H, a function of the same arguments that returns a scalar.
    - `period`: the period of the forcing in units of t; None if the system is autonomous.

    **Returns** a `System`.

    **Raises** `ValueError` if one of the functions is not callable; their values are checked on
    first use.

    **Source**: A. F. Filippov, Differential Equations with Discontinuous Righthand Sides, Kluwer
    (1988), § 4.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> up, down = lambda t, x: jnp.ones(1), lambda t, x: -jnp.ones(1)
    >>> chatter = jf.piecewise(down, up, lambda t, x: x[0])
    >>> sol = jf.solve(chatter, jnp.ones(1), 0.0, 2.0, 0.1)
    >>> float(sol.xs[-1, 0]), int(sol.modes[-1, 0])
    (0.0, 0)
    """
    for name, value in (("f_plus", f_plus), ("f_minus", f_minus), ("switching", switching)):
        argument.function(name, value, "(t, x)")
    if period is not None:
        argument.leaf("period", period)
    return _Piecewise(f_plus, f_minus, switching, period)
