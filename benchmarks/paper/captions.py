"""What each figure of the paper shows, beside what ours does, panel by panel.

Nothing enters; for each figure what it is of and rows (panel, in the paper, here) leave, which
`benchmarks.page` writes above its table. What the paper shows is described in our own words.
"""

PARAMETERS = "SD oscillator, α = 0, f₀ = 0.25, ζ = 0.0141"
NONE = "—"
CAPTIONS = {
    "fig4": (
        PARAMETERS,
        (
            (
                "a",
                "Bifurcation diagram over Ω, with the points of harmonic balance as circles on the "
                "period-1 branch. The text speaks of a period-1 motion of large amplitude and of "
                "narrow windows of higher order. Initial states are not stated.",
                "The one-sided orbit followed up (black), from (1.4, 0), with the period of each "
                "window. Harmonic balance as circles: about x = 1, and its mirror image about "
                "x = −1. Which of the two the motion settles on after chaos is chance. Added "
                "(light blue): every Ω from (0.3, 0.1) below grazing. The branch with x from 2.5 "
                "to 4.6 is the large symmetric orbit that crosses x = 0 and coexists; the points "
                "at x = −0.6 are the mirror image. Dotted: the one-sided orbit grazes.",
            ),
            (
                "b, c",
                NONE,
                "Added: phase portraits of the one-sided orbit, harmonic balance as circles on "
                "integration as lines.",
            ),
        ),
    ),
    "fig5": (
        PARAMETERS,
        (
            (
                "—",
                "Lyapunov spectrum with Ω by its caption; the text speaks of the Lyapunov "
                "exponent, so whether one or two were drawn is not certain. It jumps at 0.8667. "
                "By Wolf's algorithm, with sgn smoothed by arctan; neither the width nor the "
                "initial states are stated.",
                "(a) The largest exponent by the variational equation with its saltation, without "
                "smoothing, on the one-sided orbit where there is one. Hollow: from (0.3, 0.1), "
                "where chaos is a long transient. (b) Both exponents from (0.3, 0.1).",
            ),
            (
                "c, d",
                NONE,
                "Added: (c) both exponents of the smoothed system, with an assumed width of 0.05, "
                "from (0.3, 0.1). (d) The Ω at which the smoothed one-sided orbit gives way to "
                "chaos, against the width. With no width of these is it 0.8667: a layer meets the "
                "orbit before the surface does.",
            ),
        ),
    ),
    "fig6": (
        PARAMETERS,
        (
            (
                "a, b",
                "Time histories and phase plane at Ω = 0.7.",
                "The same: displacement and velocity of the one-sided orbit. Added, dashed: the "
                "symmetric orbit that crosses x = 0 and coexists with it.",
            ),
            (
                "c",
                "Phase plane just before grazing (black) and at grazing (red).",
                "The same, with Ω = 0.85 for “just before”, which is not stated. Added, dashed: "
                "the mirror image.",
            ),
            (
                "d",
                "Histories of displacement and velocity at grazing, where both are zero at once.",
                "The same.",
            ),
            ("e, f", "Chaotic attractor and Poincaré section at Ω = 0.87.", "The same."),
            (
                "g, h",
                NONE,
                "Added: the part of many initial states that are chaotic still after N periods, "
                "with its standard error: where a diagram shows chaos to begin and to end depends "
                "on N. Dotted: grazing, and the crisis. Dashed: the end that the paper prints.",
            ),
        ),
    ),
    "fig8": (
        "belt friction, case 1, γ₁ = 10, γ₂ = 0",
        (
            (
                "—",
                "Largest velocity of the period-1 orbit over ω from 0 to 20, with the points a "
                "(0.92), b (1.55), c (7.85) and d (10.9).",
                "The same, with the paper's letters at the points that jaxfil locates. Added: five "
                "more bifurcations, hollow and numbered i to v, each by its kind, and an "
                "enlargement where three are close together.",
            ),
        ),
    ),
    "fig9": (
        "belt friction, case 1, γ₁ = 10, γ₂ = 0",
        (
            (
                "a–i",
                "Phase planes with Poincaré points at nine frequencies, 0.92, 1.3, 1.55, 1.95, "
                "2.44, 7.85, 9.1, 10.9 and 17, two of them with an enlargement. At 0.92 and 10.9 "
                "the orbit just grazes.",
                "The same at the paper's nine frequencies. Slips below and above the belt's "
                "velocity and sticking have a colour each. At 0.92 and 10.9 the orbit is past its "
                "grazing already, at 0.917013 and 10.904976, and sticks for a moment.",
            ),
        ),
    ),
    "fig10": (
        "belt friction, case 2, γ₁ = 0, γ₂ = 10000",
        (
            (
                "a",
                "Bifurcation diagram over ω; it jumps at 4.565. The initial state is not stated.",
                "Every ω from (0, 0), a colour for each of the two attractors. Of the initial "
                "states that we tried, (0, 0) jumps nearest to the paper's value, at 4.5638; the "
                "enlargement has both.",
            ),
            ("b", NONE, "Added: both attractors followed, from 4.45 on; they coexist."),
            ("c, d", NONE, "Added: their basins before and after the jump."),
        ),
    ),
    "fig11": (
        "belt friction, case 2, γ₁ = 0, γ₂ = 10000",
        (
            (
                "a",
                "Period 1 at ω = 4.56, which grazes with a slight increase.",
                "Period 1. Its largest velocity is 0.918, and the belt's is 1: a slight increase "
                "makes no grazing. The orbit grazes at 4.6526.",
            ),
            (
                "b",
                "Chaos with its Poincaré points at ω = 4.565.",
                "The same, from (0, 0); the initial state is not stated.",
            ),
            (
                "c",
                "Exponent over ω.",
                "The largest exponent, from (0, 0), without smoothing.",
            ),
            (
                "d, e, f",
                NONE,
                "Added: (d) the section enlarged; (e, f) both exponents, exact and smoothed by "
                "arctan with a width of 0.01. Triangles: λ₂ = −∞.",
            ),
        ),
    ),
    "section5": (
        "largest exponent by synchronisation, belt friction, case 2",
        (
            (
                NONE,
                "A scheme, in which the largest exponent is the smallest coupling at which two "
                "copies synchronise. No parameters, no number and no figure of results; Fig. 12 is "
                "a sketch of the intersection of two surfaces.",
                "Added: (a) the scheme at ω = 4.6, a frequency of our choice: how near drive and "
                "response came at each coupling. (b) The exponent by the rate at which a small "
                "distance grows.",
            ),
        ),
    ),
}
