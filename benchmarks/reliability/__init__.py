"""How often jaxfil is right, says that it is not, or is wrong without a word."""
