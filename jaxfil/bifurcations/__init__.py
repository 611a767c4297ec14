"""Bifurcations of periodic orbits: tangencies to surfaces, and in two parameters smooth ones too.

The words of this room:

- Σ: the surface, H = 0; s = ±1 the side from which the orbit comes.
- rate, bend: Ḣ and Ḧ along the field of a side, time counted as a state.
- tangency: where the rate is zero on the surface.
- visible: of a tangency whose bend points away from the surface: the orbit leaves it again.
- grazing: a tangency of a motion off the surface.
- sliding region: the part of Σ on which the fields of both sides point to it; a slide moves there.
- flight: the piece of an orbit in one mode around a tangency, followed as if Σ were not there.
- arrival: a contact at the end of the sliding region.
- guard: what stays positive as long as a mode lasts.
- candidate: where a tangency may come from, with the time by which the orbit misses it.
- family: kinds of bifurcation with the same two equations at the tangency.
- placed: system, period, state and phase, as the unknowns have them.
- defining system: closing of the orbit and these two equations, for the orbit and the parameter.
- margin: the smallest guard of a flight, zero where the orbit grazes.
- nearest: of the parameters with a grazing orbit those at the smallest distance from given ones,
  in a metric; multipliers are those of Lagrange there.
- smooth bifurcation: of an orbit with critical multipliers: a fold, a period doubling, a
  Neimark–Sacker or a branch point.
- critical: of multipliers on the unit circle, and of the vectors that belong to them.
- slopes: derivatives of an orbit's end.
- codimension two: of a point on a curve in two parameters where the bifurcation degenerates (a
  cusp, a two-fold), the orbit has a second tangency, or another multiplier of it is critical.
"""
