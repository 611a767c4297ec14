"""Bifurcations of periodic orbits: tangencies to surfaces, and smooth ones in two parameters.

Terms of this room:

- Σ: the surface, H = 0; s = ±1 the side from which the orbit comes.
- rate, bend: Ḣ and Ḧ along the field of a side, with time as a state.
- tangency: a point of the surface with a rate of zero.
- visible: a tangency whose bend points away from the surface, so that the orbit leaves it again.
- grazing: a tangency of a motion off the surface.
- sliding region: the part of Σ on which the fields of both sides point to it, with sliding motion.
- flight: the piece of an orbit in one mode around a tangency, followed as if Σ were not there.
- arrival: a contact at the end of the sliding region.
- guard: a function that is positive as long as a mode lasts.
- candidate: a possible origin of a tangency, with the time by which the orbit misses it.
- family: kinds of bifurcation with the same two equations at the tangency.
- placed: system, period, state and phase for given unknowns.
- defining system: closure of the orbit and these two equations, for the orbit and the parameter.
- margin: the smallest guard of a flight, zero where the orbit grazes.
- nearest: the parameters of a grazing orbit at the smallest distance from given ones, in a metric,
  with Lagrange multipliers.
- smooth bifurcation: an orbit with critical multipliers: a fold, a period doubling, a
  Neimark–Sacker or a branch point.
- critical: multipliers on the unit circle, and the vectors that belong to them.
- slopes: derivatives of an orbit's end.
- codimension two: a point on a curve in two parameters where the bifurcation degenerates (a cusp, a
  two-fold), the orbit has a second tangency, or another multiplier is critical.
"""
