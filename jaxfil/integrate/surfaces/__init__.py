"""surfaces: fields and forces on surfaces.

- weight: on a surface slid on, the w in [−1, 1] at which the blend of both sides is tangent to it
  (`weights`); the blend is Filippov's convex combination (`filippov`).
- mode series: power series of a mode's field and guards.
- decision: the weights and reactions of all surfaces that a state is on, found together.
- reaction: what holds a motion at rest on a surface with a reset (`unilateral`).
- normal: ∇H, and projection along it (`normals`).
- entering: the derivative of a state that starts on a slide or a rest, or is put there by a map.
- section: a function whose zeros are watched, and its rate along the motion (`sections`).
- second order: what second derivatives of a landing add to Newton's step in time.
"""
