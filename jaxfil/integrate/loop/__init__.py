"""loop: the iteration, from the first moment to the last.

- start: the mode at t0.
- iterate: one trial step, and what is done with it: accept, refuse, reject, land, switch.
- judge: that decision, or the failure that a trial step has met.
- halving: a step that cannot be trusted is refused, and tried at half its length.
- path: the motion in a step as a polynomial, cut where it first meets a surface.
- free step: a trial step on a lane's own sides, which needs no more if it meets nothing.
- batch: lanes that share a loop; they coast through free steps, and are judged where one is not.
- section search: crossings of sections, located in steps that the loop has made; what a lane knows
  of them is in `section_state`.
- extensions: those of a run, in their order.
- window: the span of a run that is averaged over; `extremes` and `event_sums` are taken in it.
"""
