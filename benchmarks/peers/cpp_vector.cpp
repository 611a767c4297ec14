// What an expert writes in C++: eight lanes at a time in vector registers, contacts located.
//
// Compiled by cpp_vector.py for one scene (BELT, or the SD oscillator) and one method: STEP, a file
// with the stages of a Runge-Kutta method written out, or the Taylor series of order ORDER.
//
// Lanes of a pack take the next grid step as if they met nothing. Those that did meet something, or
// stick, take that step again one by one, by the rules of numba_scalar.py: a margin, positive while
// the mode lasts (s H off the surface, grip^2 - push^2 in a stick), is looked at by its cubic; where
// that goes below zero the contact is located and the mode chosen anew there.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <thread>
#include <vector>

constexpr int WIDTH = 8;
typedef double Pack __attribute__((vector_size(8 * WIDTH)));
typedef long long Mask __attribute__((vector_size(8 * WIDTH)));

static double whole(double x) { return std::nearbyint(x); }
static Pack whole(Pack x) {
    Pack r;
    for (int i = 0; i < WIDTH; i++) r[i] = std::nearbyint(x[i]);
    return r;
}
static double size(double a) { return std::fabs(a); }
static Pack size(Pack a) { return a < 0 ? -a : a; }
static Pack least(Pack a, Pack b) { return a < b ? a : b; }
static bool none(Mask m) {
    long long any = 0;
    for (int i = 0; i < WIDTH; i++) any |= m[i];
    return !any;
}

template <class T, int N> static inline T series(T z, const double (&terms)[N]) {
    T sum = z * terms[N - 1] + terms[N - 2];
#pragma GCC unroll 20
    for (int k = N - 3; k >= 0; k--) sum = sum * z + terms[k];
    return sum;
}
constexpr double COSINE[] = {1, -1 / 2., 1 / 24., -1 / 720., 1 / 40320., -1 / 3628800., 1 / 479001600.,
                             -1 / 87178291200., 1 / 20922789888000., -1 / 6402373705728000.,
                             1 / 2432902008176640000.};
constexpr double SINE[] = {1, -1 / 6., 1 / 120., -1 / 5040., 1 / 362880., -1 / 39916800., 1 / 6227020800.,
                           -1 / 1307674368000., 1 / 355687428096000., -1 / 121645100408832000.};

// Cosine and sine to 1e-16 for a phase of a few turns. Pi is in two pieces, the first of 40 bits, so
// that its multiples are exact.
template <class T> static inline void turn(T x, T &cosine, T &sine) {
    T turns = whole(x * (1 / M_PI));
    T r = (x - turns * 3.141592653588304) - turns * 1.4891536147466924e-12;
    T z = r * r, sign = 1 - 2 * size(turns - 2 * whole(0.5 * turns));
    cosine = sign * series(z, COSINE);
    sine = sign * series(z, SINE) * r;
}
template <class T> static inline T cosine(T x) {
    T c, s;  // the sine is never computed: nobody asks for it
    turn(x, c, s);
    return c;
}

// A scene: its field on side s, H and dH/dt, a state moved onto the surface, what pushes across it
// there and how fast that changes along a stick, and a stick of length h.
struct Scene {
#ifdef BELT
    double f0, friction, damp, cubic, g1, g2, v;
    template <class T> T field(T force, T x1, T x2, T s) const {
        T u = x2 - v;
        return force + u * (damp - cubic * u * u) - x1 * (g1 + g2 * x1 * x1) - s * friction;
    }
    template <class T> void height(T, T x2, T d2, T &g, T &r) const { g = x2 - v, r = d2; }
    void place(double &, double &x2) const { x2 = v; }
    void hold(double omega, double t, double x1, double, double &push, double &rate, double &grip) const {
        push = f0 * std::cos(omega * t) - x1 * (g1 + g2 * x1 * x1);
        rate = -f0 * omega * std::sin(omega * t) - (g1 + 3 * g2 * x1 * x1) * v;
        grip = friction;
    }
    double slide(double x1, double h) const { return x1 + v * h; }
#else
    double f0, zeta;
    template <class T> T field(T force, T x1, T x2, T s) const { return force - 2 * zeta * x2 - x1 + s; }
    template <class T> void height(T x1, T x2, T, T &g, T &r) const { g = x1, r = x2; }
    void place(double &x1, double &) const { x1 = 0; }
    void hold(double, double, double, double x2, double &push, double &rate, double &grip) const {
        push = x2, rate = grip = 0;
    }
    double slide(double x1, double) const { return x1; }
#endif
};

// The smooth motion from (t, x1, x2) on side s, where the slope of x2 is d2: `at` gives the state a
// time h later, and the slope of x2 there.
template <class T> struct Motion {
#ifdef STEP
    const Scene &p;
    T omega, t, x1, x2, d2, s;
    Motion(const Scene &p, T omega, T t, T x1, T x2, T d2, T s)
        : p(p), omega(omega), t(t), x1(x1), x2(x2), d2(d2), s(s) {}
    void at(T h, T &y1, T &y2, T &e2) const {
#include STEP
    }
#else
    T a[ORDER + 1], b[ORDER + 1];
    Motion(const Scene &p, T omega, T t, T x1, T x2, T, T s) {
        T force, lag;  // coefficients of f0 cos and f0 sin
        turn(omega * t, force, lag);
        force *= p.f0, lag *= p.f0;
        a[0] = x1, b[0] = x2;
#ifdef BELT
        T u[ORDER], u2[ORDER], a2[ORDER];
#endif
#pragma GCC unroll 20
        for (int k = 0; k < ORDER; k++) {
            const double share = 1. / (k + 1);
#ifdef BELT
            u[k] = k ? b[k] : b[k] - p.v;
            u2[k] = u[0] * u[k] * (k ? 2. : 1.), a2[k] = a[0] * a[k] * (k ? 2. : 1.);
#pragma GCC unroll 20
            for (int i = 1; 2 * i <= k; i++) {
                const double pair = 2 * i == k ? 1. : 2.;
                u2[k] += u[i] * u[k - i] * pair, a2[k] += a[i] * a[k - i] * pair;
            }
            T u3 = u[0] * u2[k], a3 = a[0] * a2[k];
#pragma GCC unroll 20
            for (int i = 1; i <= k; i++) u3 += u[i] * u2[k - i], a3 += a[i] * a2[k - i];
            T slope = force + p.damp * u[k] - p.cubic * u3 - p.g1 * a[k] - p.g2 * a3;
            if (k == 0) slope -= s * p.friction;
#else
            T slope = force - 2 * p.zeta * b[k] - a[k];
            if (k == 0) slope += s;
#endif
            a[k + 1] = b[k] * share, b[k + 1] = slope * share;
            T next = -omega * lag * share;
            lag = omega * force * share, force = next;
        }
    }
    void at(T h, T &y1, T &y2, T &e2) const {
        y1 = a[ORDER], y2 = b[ORDER], e2 = b[ORDER] * double(ORDER);
#pragma GCC unroll 20
        for (int k = ORDER - 1; k >= 0; k--) {
            y1 = y1 * h + a[k], y2 = y2 * h + b[k];
            if (k > 0) e2 = e2 * h + b[k] * double(k);
        }
    }
#endif
};

// Where in (0, 1] the cubic through margins g and rates r is below zero: its minimum, else its end,
// else 2.
static double dip(double g0, double r0, double g1, double r1) {
    double a2 = 3 * (g1 - g0) - 2 * r0 - r1, a3 = 2 * (g0 - g1) + r0 + r1;
    double square = a2 * a2 - 3 * a3 * r0;
    if (square > 0) {
        double root = std::sqrt(square);
        double top = a2 > 0 ? -r0 : root - a2, bottom = a2 > 0 ? a2 + root : 3 * a3;
        if (bottom * top > 0 && std::fabs(top) < std::fabs(bottom)) {
            double theta = top / bottom;
            if (g0 + theta * (r0 + theta * (a2 + theta * a3)) < 0) return theta;
        }
    }
    return g1 < 0 ? 1. : 2.;
}

// The cubic's root in (0, high), at whose end it is negative; a root at the start is divided out.
static double first_root(double g0, double r0, double g1, double r1, double high) {
    double a2 = 3 * (g1 - g0) - 2 * r0 - r1, a3 = 2 * (g0 - g1) + r0 + r1;
    double low = 0, theta = 0.5 * high, guess = theta;
    for (int n = 0; n < 40; n++) {
        double value = r0 + theta * (a2 + theta * a3), slope = a2 + 2 * theta * a3;
        if (g0 > 0) slope = value + theta * slope, value = g0 + theta * value;
        (value < 0 ? high : low) = theta;
        guess = slope != 0 ? theta - value / slope : low;
        if (!(low < guess && guess < high)) guess = 0.5 * (low + high);
        if (std::fabs(guess - theta) < 1e-7) break;
        theta = guess;
    }
    return guess;
}

// Mode, state, slope of x2, margin and its rate.
struct Lane {
    double s, x1, x2, d2, g, r;
};

// A lane that may meet something.
struct Single {
    const Scene &p;
    double omega;

    Lane later(const Motion<double> &m, Lane a, double t, double h) const {
        if (a.s == 0) {
            double push, rate, grip;
            a.x1 = p.slide(a.x1, h);
            p.hold(omega, t + h, a.x1, a.x2, push, rate, grip);
            a.g = grip * grip - push * push, a.r = -2 * push * rate;
            return a;
        }
        m.at(h, a.x1, a.x2, a.d2);
        p.height(a.x1, a.x2, a.d2, a.g, a.r);
        a.g *= a.s, a.r *= a.s;
        return a;
    }
    Lane choose(double t, double x1, double x2, double s) const {
        double push, rate, grip, g, r;
        p.place(x1, x2);
        p.hold(omega, t, x1, x2, push, rate, grip);
        // A stick that ends does end, whatever rounding says of a push that equals the grip.
        if (s != 0 && std::fabs(push) < grip)
            return {0, x1, x2, 0, grip * grip - push * push, -2 * push * rate};
        s = push > 0 ? 1 : -1;
        double d2 = p.field(p.f0 * cosine(omega * t), x1, x2, s);
        p.height(x1, x2, d2, g, r);
        return {s, x1, x2, d2, 0, std::max(s * r, 0.)};
    }
    Lane begin(double x1, double x2) const {
        double g, r;
        p.height(x1, x2, 0., g, r);
        if (g == 0) return choose(0, x1, x2, 1);
        double s = g > 0 ? 1 : -1, d2 = p.field(p.f0, x1, x2, s);
        p.height(x1, x2, d2, g, r);
        return {s, x1, x2, d2, s * g, s * r};
    }
    // The lane, and the time, moved up to the first contact in (0, theta dt] or to a minimum of the
    // margin that stays clear.
    void locate(const Motion<double> &m, Lane &a, double &t, double dt, const Lane &c, double theta) const {
        double high = theta * dt, low = 0, move = dt;
        if (theta < 1) {
            Lane bottom = later(m, a, t, high);
            if (bottom.g >= 0) {
                t += high, a = bottom;
                return;
            }
        }
        double tau = first_root(a.g, a.r * dt, c.g, c.r * dt, theta) * dt;
        Lane z = a;
        for (int n = 0; n < 60; n++) {
            z = later(m, a, t, tau);
            (z.g < 0 ? high : low) = tau;
            move = z.r < 0 ? -z.g / z.r : dt;
            if (std::fabs(move) < 1e-7 * dt || high - low < 1e-14 * dt) break;
            double guess = tau + move;
            tau = low < guess && guess < high ? guess : 0.5 * (low + high);
        }
        if (std::fabs(move) < 1e-7 * dt) {
            tau += move;
            z.x1 = a.s == 0 ? p.slide(z.x1, move) : z.x1 + move * z.x2;
            z.x2 += a.s == 0 ? 0 : move * z.d2;
        }
        t += tau, a = choose(t, z.x1, z.x2, a.s);
    }
    // From grid point k of a period to the next.
    Lane go(double h, int k, Lane a) const {
        double t = k * h;
        for (int budget = 1000; budget > 0; budget--) {
            double dt = (k + 1) * h - t, third = dt / 3;
            Motion<double> m(p, omega, t, a.x1, a.x2, a.d2, a.s);
            Lane c = later(m, a, t, dt);
            // The cubic's Bezier points: where none is negative, neither is the cubic.
            bool near = c.g < 0 || a.g + third * a.r < 0 || c.g - third * c.r < 0;
            double theta = near ? dip(a.g, a.r * dt, c.g, c.r * dt) : 2;
            if (theta <= 1) {
                locate(m, a, t, dt, c, theta);
                continue;
            }
            // A step too short to leave the surface by more than rounding has not left it.
            if (a.g == 0 && dt < 1e-6 * h) c.g = 0;
            return c;
        }
        a.x1 = a.x2 = 1e300;
        return a;
    }
};

// A pack of lanes; time starts anew in each period, so that no digits are lost.
static void run(const Scene &p, const double *omegas, const double *spans, int steps, const double *start,
                int transient, int samples, double *out) {
    Pack omega, h, s, x1, x2, d2, g, r;
    auto put = [&](int i, const Lane &a) { s[i] = a.s, x1[i] = a.x1, x2[i] = a.x2, d2[i] = a.d2, g[i] = a.g, r[i] = a.r; };
    for (int i = 0; i < WIDTH; i++) {
        omega[i] = omegas[i], h[i] = spans[i] / steps;
        put(i, Single{p, omegas[i]}.begin(start[0], start[1]));
    }
    for (int j = 0; j < transient + samples; j++) {
        for (int k = 0; k < steps; k++) {
            Pack y1, y2, e2, end, rate, third = h * (1 / 3.);
            Motion<Pack>(p, omega, double(k) * h, x1, x2, d2, s).at(h, y1, y2, e2);
            p.height(y1, y2, e2, end, rate);
            end *= s, rate *= s;
            Pack lowest = least(end, least(g + third * r, end - third * rate));
            Mask met = (lowest < 0) | (size(s) < 0.5);
            Pack s0 = s, u1 = x1, u2 = x2, u3 = d2, u4 = g, u5 = r;
            x1 = y1, x2 = y2, d2 = e2, g = end, r = rate;
            if (none(met)) continue;
            for (int i = 0; i < WIDTH; i++)
                if (met[i]) put(i, Single{p, omega[i]}.go(h[i], k, {s0[i], u1[i], u2[i], u3[i], u4[i], u5[i]}));
        }
        for (int i = 0; i < WIDTH && j >= transient; i++) {
            double *sample = out + 2L * (i * samples + j - transient);
            sample[0] = x1[i], sample[1] = x2[i];
        }
    }
}

extern "C" void lanes(const double *constants, const double *omegas, const double *spans, int packs, int steps,
                      const double *start, int transient, int samples, double *out, int cores) {
    const Scene &p = *reinterpret_cast<const Scene *>(constants);
    std::atomic<int> next{0};
    auto work = [&] {
        for (int n; (n = next++) < packs;)
            run(p, omegas + n * WIDTH, spans + n * WIDTH, steps, start, transient, samples, out + 2L * n * WIDTH * samples);
    };
    std::vector<std::thread> others;
    for (int i = 1; i < cores; i++) others.emplace_back(work);
    work();
    for (auto &other : others) other.join();
}
