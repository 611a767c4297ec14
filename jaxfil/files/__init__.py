"""Reading of results from files.

Terms of this room:

- data set: named arrays with their dimensions and attributes, independent of the file format.
- type: the attribute of a data set with the class of its result.
- reader: a function from a data set to its result; the writer is a method of the result.
"""
