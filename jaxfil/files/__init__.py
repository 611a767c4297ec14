"""Results read back from files.

The words of this room:

- data set: named arrays with their dimensions and attributes, whatever the file.
- type: the attribute of a data set that says which result it is.
- reader: what makes a result of its data set; the writer stands beside the result itself.
"""
