"""Figures of Santhosh, Narayanan and Padmanabhan (2016), each with a table, one figure a file."""
