"""Equilibria: finding them, following them as a parameter varies, and what bounds their planes.

The words of this room:

- balance: the equations of an equilibrium in a mode: the field of the mode is zero, and H of each
  surface slid or rested on.
- multiplier: the unknown that a surface brings with it: the weight w of one slid on, the reaction
  of one rested on; of others it is the side.
- margin: what is positive of each surface where an equilibrium is one of the system.
- virtual: of a solution of the balance with a negative margin.
- pseudo-equilibrium: one of the sliding flow.
- boundary equilibrium: one with a margin of zero, where a regular one and a pseudo-equilibrium are
  one and the same.
- deflated: of a Jacobian whose zeros across the surfaces have been moved out of the way.
- tangency: where the field of one side is tangent to its surface; two-fold: those of both sides.
"""
