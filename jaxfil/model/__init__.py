"""The interface of the library: systems, arguments, outcomes and cards.

Terms of this room:

- system: vector fields glued along surfaces, written by the user as a `System`.
- surface: the zeros of one component H_j of the switching function; `side` is the sign of H_j.
- sliding: motion along a surface, with the convex combination of its two fields that is tangent.
- reset: the jump of the state at an impact.
- parameter: a float leaf of a system, identified by its name, a dotted path for nested modules.
- outcome: the way a lane ended, a member of `RESULTS` with a sentence for the user.
- event: a contact with a surface or a tick, of an `EventKind`.
- card: the short text that a result prints.
- quantity: a number of a motion over a span of time: the mean, an extreme or a sum of a function.
- labels: names of components and parameters in pictures and named arrays, with their units.
- hook: `drawing`, the registry through which a result's `plot()` calls `jaxfil.plot`.
- check: validation of arguments before compilation.
"""
