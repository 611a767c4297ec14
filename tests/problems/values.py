"""Reference digits that belong to no single motion: where something happens to an orbit."""

# Values of parameters at which something happens.
SD_GRAZES = 0.866716581971234, 1.117142393133526  # f0 = √((1 - Ω²)² + (2ζΩ)²)
BELT_GRAZES = 0.917012578766336, 10.904975822090772
BELT_ADDS = 1.548910479930516  # a slip of 2 ms splits the stick
BELT_CHANGES = [0.917, 1.398, 1.403, 1.549, 1.914, 2.438, 4.217, 7.952, 10.905]
BELT_HIGHEST = {0.5: 0.512658354900661, 1.55: 1.003236056352910, 1.95: 2.410756102922876}
CUBIC_GRAZES = 4.652570419201206  # not at the paper's 4.565
CUBIC_JUMPS = 4.56382205  # from (0, 0) the motion ends on another attractor
CUBIC_LYAPUNOV = 0.3799  # (4), of sticking chaos at 4.6
WALL_GRAZES = 0.4560701700  # √0.208, amplitude of the impact oscillator's force at 1.2
# The damping alone, αg: the sum of the belt's exponents where nothing sticks or crosses.
BELT_DAMPING, SD_DAMPING = -0.4905, -0.0282
SD_AT_5 = 0.15854311422638651592, -0.93147098153906364592  # of the problem "sd"
SLIP_STICK_PERIOD = 9.230770458083
DEN_HARTOG_AMPLITUDE = 2.6261048757  # at 0.8 with a friction of 0.3
DEN_HARTOG_STICKS = 0.8174063857  # the friction at 0.8 beyond which the orbit sticks
