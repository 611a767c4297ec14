"""system: the loop's view of a user's system.

- components: the numbers of a state, one by one or as one array.
- lowered: the system on components, with its functions traced once, and their dependencies.
- dependencies: which numbers of the field and of H depend on which sides and states.
- grade: whether a program is written out, to run fast, or uses loops, to compile fast.
"""
