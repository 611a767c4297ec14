"""surfaces: fields and forces on surfaces.

- weight: on a sliding surface, the w in [−1, 1] at which the blend of both sides is tangent to it
  (`weights`); the blend is Filippov's convex combination (`filippov`).
- mode series: power series of a mode's field and guards.
- decision: the weights and reactions of all surfaces that a state is on, determined together.
- next derivative: the second and third derivatives of H, which decide where the first is zero and
  no weight can change it.
- reaction: the force on a motion at rest on a surface with a reset (`unilateral`), and its effect
  on each combination of sides (`reactions`).
- normal: ∇H, and projection along it (`normals`).
- entering: the derivative of a state at which a slide or a rest starts, or which a map puts there.
- section: a function whose zeros are recorded, and its rate along the motion (`sections`).
- second order: the second derivatives of a landing beyond Newton's step in time.
"""
