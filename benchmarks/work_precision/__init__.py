"""Work against precision: one trajectory of eight problems by jaxfil and by other programs."""
