"""integrate: the integration of a system from one state to the next.

The words of this room, in the order in which a step uses them; each folder has its own list:

- side, mode: a surface's side is +1 or −1; the mode of a motion is, for each surface, the side, 0
  for a slide, or twice the side for a rest.
- `system`: the loop's view of a user's system.
- `steppers`: one smooth step.
- `surfaces`: fields and forces on surfaces, of any mode.
- `lane`: the data of one member of a batch.
- `contacts`: where a step reaches a surface, and how the motion continues from there.
- `loop`: the iteration.
- `run`: `solve`, its options and its result.
"""
