"""Lyapunov exponents of one orbit: from its derivative, or from two copies that are coupled.

The words of this room:

- variational equation: what a small displacement of an orbit obeys; solved for n of them at once.
- tangent vector: such a displacement, carried through crossings by the saltation matrix.
- frame: n tangent vectors, orthonormalised at the end of every interval (M Q = Q′R).
- saltation matrix: the jump of a tangent vector at a contact whose time depends on the orbit.
- interval: the time between two orthonormalisations, by default one forcing period.
- batch means: the average in batches of time, whose scatter gives the standard error.
- settled: whether all batches show one and the same motion.
- drive: the system as it is, ẋ = F(t, x).
- response: a copy that is pulled towards the drive, ẏ = F(t, y) + ε(x − y), ε the coupling.
- synchronisation: the response has come to the drive, as it does for ε > λ1.
- transverse exponent: the rate at which a small distance between drive and response grows, λ1 − ε.
"""
