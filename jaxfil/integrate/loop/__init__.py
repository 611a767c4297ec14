"""loop: the iteration, from t0 to the end of a run.

- start: the mode at t0.
- iterate: one trial step and its consequence: accept, refuse, reject, land, switch.
- trial: the trial step and its end.
- judge: the choice between these, or the failure of a trial step.
- halving: refusal of a step that cannot be trusted, which is repeated at half its length.
- path: the motion in a step as a polynomial, cut at its first contact; with a tolerance also at
  the first kink of the field, and where its tail, the terms beyond the last ones, is unknown.
- free step: a trial step on a lane's current sides, which is enough where there is no contact.
- batch: lanes that share a loop; they coast through free steps, and are judged at other steps.
- section search: crossings of sections, located in steps that the loop has accepted; the state of
  the search is in `section_state`.
- extensions: the extensions of a run, in their order.
- window: the span of a run that is averaged over; `extremes` and `event_sums` are taken in it.
"""
