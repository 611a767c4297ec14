"""Equilibria of systems, their branches in a parameter, and tangencies in planes.

Terms of this room:

- balance: the equations of an equilibrium in a mode: the field of the mode is zero, and H of each
  surface on which it slides or rests.
- multiplier: the unknown of a surface: the weight w of a sliding one, the reaction of a resting
  one, the side of any other.
- margin: a number of each surface that is positive for an equilibrium of the system.
- virtual: a solution of the balance with a negative margin.
- pseudo-equilibrium: an equilibrium of the sliding flow.
- boundary equilibrium: one with a margin of zero, where a regular equilibrium and a
  pseudo-equilibrium coincide.
- deflated: a Jacobian whose zeros across the surfaces are shifted.
- tangency: the field of one side is tangent to its surface; two-fold: the fields of both sides.
"""
