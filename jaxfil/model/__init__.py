"""What a user writes and reads: a system enters the library, outcomes and cards come back.

The words of this room:

- system: vector fields glued along surfaces, written by the user as a `System`.
- surface: the zeros of one component H_j of the switching function; `side` is the sign of H_j.
- sliding: motion along a surface, with the convex combination of its two fields that is tangent.
- reset: the jump of the state at an impact.
- parameter: a float leaf of a system, known by its name, a dotted path for nested modules.
- outcome: how a lane ended, a member of `RESULTS`; its sentence is what the user reads.
- event: what happened at a contact with a surface, an `EventKind`.
- card: the few lines that a result prints of itself.
- quantity: a number of a motion over a span of time: the mean, an extreme or a sum of a function.
- labels: what pictures and named arrays call the components and parameters, with their units.
- hook: `drawing`, where `jaxfil.plot` registers what it draws and where a result's `plot()` looks.
- check: the door at which bad arguments are named before anything is compiled.
"""
