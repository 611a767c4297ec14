"""What each figure of the paper shows, beside what ours does, panel by panel.

Nothing enters; for each figure what it is of and rows (panel, in the paper, here) leave, which
`benchmarks.page` writes above its table. What the paper shows is told in our own words.
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
                "period-1 branch.",
                "The same: the one-sided orbit followed up (black). Added: every Ω from (0.3, 0.1) "
                "below grazing (light), both values at which the orbit grazes, and its harmonic "
                "balance above the second one.",
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
                "a",
                "Largest exponent over Ω; it jumps at 0.8667. By Wolf's algorithm, with sgn "
                "smoothed by arctan.",
                "The same by the variational equation with its saltation, without smoothing. The "
                "one-sided orbit followed has the paper's jump; lanes from (0.3, 0.1) (hollow) are "
                "chaotic from 0.854 on, where chaos is a long transient.",
            ),
            ("b", NONE, "Added: both exponents from (0.3, 0.1)."),
            ("c", NONE, "Added: both exponents of the system smoothed as the paper smooths it."),
        ),
    ),
    "fig6": (
        PARAMETERS,
        (
            (
                "a, b",
                "History and phase plane at Ω = 0.7.",
                "The same: the one-sided orbit. Added, dashed: the symmetric orbit that crosses "
                "x = 0 and coexists with it.",
            ),
            (
                "c, d",
                "The grazing orbit, in two colours.",
                "The orbits about x = 1 and x = −1 at grazing, a colour each.",
            ),
            ("e, f", "Chaotic attractor and Poincaré section at Ω = 0.87.", "The same."),
            (
                "g, h",
                NONE,
                "Added: the part of many initial states that are chaotic still after N periods, "
                "with its standard error: where a diagram shows chaos to begin and to end depends "
                "on N.",
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
                "Nine phase planes, two of them with an enlargement, with Poincaré points; 0.92, "
                "1.55, 1.95, 2.44, 7.85 and 10.9 are among the frequencies.",
                "Nine phase planes with Poincaré points and two enlargements. Slips below and "
                "above the belt's velocity and sticking have a colour each. 1.3, 9.1 and 17 were "
                "chosen between the paper's frequencies, where closed forms are known.",
            ),
        ),
    ),
    "fig10": (
        "belt friction, case 2, γ₁ = 0, γ₂ = 10000",
        (
            (
                "a",
                "Bifurcation diagram over ω; it jumps at 4.565.",
                "The same, every ω from (0, 0), a colour for each of the two attractors.",
            ),
            ("b", NONE, "Added: both attractors followed; they coexist."),
            ("c, d", NONE, "Added: their basins before and after the jump."),
        ),
    ),
    "fig11": (
        "belt friction, case 2, γ₁ = 0, γ₂ = 10000",
        (
            ("a", "Period 1 at ω = 4.56.", "The same."),
            ("b, c", "Chaos and its Poincaré section at ω = 4.565.", "The same, from (0, 0)."),
            ("d", "Largest exponent over ω.", "The same, without smoothing."),
            ("e, f", NONE, "Added: both exponents, exact and smoothed by arctan."),
        ),
    ),
    "section5": (
        "belt friction, case 2, ω = 4.6",
        (
            (
                "a",
                "The largest exponent as the smallest coupling at which two copies synchronise.",
                "The same: how near drive and response came at each coupling.",
            ),
            ("b", NONE, "Added: the exponent by the rate at which a small distance grows."),
        ),
    ),
}
