"""Systems and ends of `cases` that take a formula: numbers enter, states leave."""

import numpy as np

import jaxfil as jf
from benchmarks.reliability import case_systems as S

G = 9.8
LARGE = 0.8 * np.exp(-5) - 0.3
CRADLE_END = (0, 0, 0, 2, 0, 0, 0, 1)
FALL = np.sqrt(0.2)  # from height 1 with g = 10


def ball(e):
    """A ball above a floor."""
    return jf.systems.BouncingBall(g=G, restitution=e)


def oscillation(amplitude, velocity, s):
    """x'' = -x a time s after (amplitude, velocity)."""
    c, d = np.cos(s), np.sin(s)
    return np.array([amplitude * c + velocity * d, velocity * c - amplitude * d])


def pulled(s):
    """The block a time s after it has begun to slip."""
    w = np.sqrt(0.5)
    return 0.2 * (s - np.sin(w * s) / w), 0.2 * (1 - np.cos(w * s))


def at_the_wall(s):
    """x'' + x = -sin 2s from rest."""
    return (np.sin(2 * s) - 2 * np.sin(s)) / 3, (2 * np.cos(2 * s) - 2 * np.cos(s)) / 3


def leaves_the_table(a=1.5, s=0.5):
    """(time, state) a time s after the table falls faster than the ball."""
    leave = np.arcsin(1 / a)
    end = 1 + a * np.cos(leave) * s - s * s / 2, a * np.cos(leave) - s
    return leave + s, end


def begun(s):
    """A ball from (0, 2)."""
    return 2 * s - G * s * s / 2, 2 - G * s


def slow(contraction):
    """A spiral that shrinks by this part a turn; from (0, 1) it ends at t = 1/2."""
    leg = (1 - contraction) ** 0.25
    return S.spiral((1 + leg) / (1 - leg))
