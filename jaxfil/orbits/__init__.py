"""Periodic orbits, and their branches as a parameter varies.

Terms of this room:

- orbit: a periodic motion, x(t0 + T) = x(t0).
- flow map: the map from a state to the state after a given time.
- shooting: Newton's method on the flow map over a period; multiple shooting divides it into arcs.
- arc: a piece of an orbit between two of the states that are unknowns.
- closing: the equations of an orbit: every arc ends where the next one starts.
- phase condition: selects one of the states of an autonomous orbit, which may start anywhere.
- setting: a system and a period, for given global unknowns.
- affine: a first-order model in some unknowns, with one program for all unknowns (`affine`).
- monodromy: the derivative of the flow map over a period; its eigenvalues are the multipliers.
- branch: the orbits as a parameter varies; a `Curve` in the space of all unknowns.
- predictor: the guess of the next point on a curve, a step along the tangent.
- corrector: Newton's method from there, back to the curve.
- arclength constraint: the equation that fixes the position of the corrected point on the curve.
- metric: the scales in which that distance is measured.
- test function: a number that is zero where a curve changes its character.
- special point: a zero of a test function or a change of the sequence of contacts.
- corner: a point where a curve continues in another direction, as at a square root of the flow map.
- harmonics: the waves of a Fourier series, which represents an orbit without integration.
"""
