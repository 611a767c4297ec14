"""integrate: a system from one state to the next.

The words of this room, in the order in which a step meets them; each folder explains its own:

- side, mode: a surface's side is +1 or −1; the mode of a motion is its side of each surface, 0
  where it slides on it, or twice the side where it rests on it.
- `system`: what the loop sees of a user's system.
- `steppers`: one smooth step.
- `surfaces`: fields and forces on surfaces, of any mode.
- `lane`: the data of one member of a batch.
- `contacts`: where a step meets a surface, and what goes on from there.
- `loop`: the iteration.
- `run`: `solve`, its options and its result.
"""
