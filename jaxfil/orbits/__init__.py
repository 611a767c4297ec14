"""Periodic orbits: finding them, following them as a parameter varies, and what happens on the way.

The words of this room:

- orbit: a periodic motion, x(t0 + T) = x(t0).
- flow map: a state to the state a while later.
- shooting: Newton's method on the flow map over a period; multiple shooting cuts that into arcs.
- arc: a piece of an orbit between two of the states that are unknowns.
- closing: the equations of an orbit, every arc ends where the next one starts.
- phase condition: picks one of the states of an autonomous orbit, which may start anywhere.
- setting: a system and a period, for given global unknowns.
- affine: what depends on some unknowns, to first order: one program whatever they are (`affine`).
- monodromy: the derivative of the flow map over a period; its eigenvalues are the multipliers.
- branch: the orbits as a parameter varies; a `Curve` in the space of all unknowns.
- predictor: the guess of the next point on a curve, a step along the tangent.
- corrector: Newton's method from there, back to the curve.
- arclength constraint: the equation that fixes how far along the curve the corrected point lies.
- metric: the scales in which that distance is measured.
- test function: a number that is zero where a curve changes its character.
- special point: where a test function is zero or the sequence of contacts changes.
- corner: where a curve goes on in another direction, as at a square root of the flow map.
- harmonics: the waves of a Fourier series, by which an orbit is found without integration.
"""
