"""Lyapunov exponents of one orbit, from its derivative or from two coupled copies.

Terms of this room:

- variational equation: the equation of a small displacement of an orbit; solved for n at once.
- tangent vector: such a displacement, propagated through crossings by the saltation matrix.
- frame: n tangent vectors, orthonormalised at the end of every interval (M Q = Q′R).
- saltation matrix: the jump of a tangent vector at a contact whose time depends on the orbit.
- interval: the time between two orthonormalisations, by default one forcing period.
- batch means: averages over batches of time, whose scatter gives the standard error.
- settled: whether all batches show the same motion.
- drive: the system itself, ẋ = F(t, x).
- response: a copy coupled to the drive, ẏ = F(t, y) + ε(x − y), ε the coupling.
- synchronisation: the response approaches the drive, for ε > λ1.
- transverse exponent: the rate at which a small distance between drive and response grows, λ1 − ε.
"""
