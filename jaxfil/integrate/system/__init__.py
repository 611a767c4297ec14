"""system: what the loop sees of a user's system.

- components: the numbers of a state one by one, or as one array, as the loop carries them.
- lowered: the system on components, its functions traced once, with what they depend on.
- dependencies: which numbers of the field and of H depend on which side and state.
- grade: whether a program is written out, to run fast, or held in loops, to compile fast.
"""
